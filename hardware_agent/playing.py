"""Scripts one after the other, with whoever stands at the robot at the keys."""

import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

from hardware_agent.control import Talk, attending
from hardware_agent.prompt import ENTER, LOOK, LeftError, key_pressed, keys, leaving
from pup.errors import InputError
from pup.script import Script

HELP = "ENTER goes on, s skips a script, q leaves; any other key, Ctrl-C too, STOPS the robot"
GROUND = "put the robot on its feet in this pose and let go; ENTER plays"
STOPPED = "stopped by the operator"


class _Ended(Exception):  # noqa: N818
    """The operator ends it: by leaving, or by a stop."""


def play(
    socket: Path, files: Sequence[Path], repeats: int, auto: bool, setup: Mapping[str, float]
) -> int:
    """Play scripts and tell where their recordings are.

    A robot that moves when the terminal is lost, or this process, is stopped: nobody could any
    more.

    Args:
      socket: of the agent.
      files: of the scripts.
      repeats: how often each is played.
      auto: whether nobody is asked: for robots that are not there; the agent refuses others.
      setup: what was changed on the robot, by its knobs; kept with the recordings.

    Returns:
      0 where all were played or skipped, 1 where the operator ended it or one was stopped.

    Raises:
      InputError: no agent answers, it refuses, a file is no script, or this is no terminal.
    """
    if not auto and not sys.stdin.isatty():
        raise InputError("this is no terminal; --auto plays without questions")
    scripts = [Script.read(file) for file in files]
    with _attended(socket) as agent, nullcontext() if auto else keys():
        if not auto:
            print(HELP, flush=True)
        try:
            for script in scripts:
                first: str | None = None
                for _ in range(repeats):
                    first = _one(agent, script, first, auto, setup) or first
        except _Ended as error:
            print(error, file=sys.stderr)
            return 1
    return 0


def _one(
    agent: Talk, script: Script, repeat_of: str | None, auto: bool, setup: Mapping[str, float]
) -> str | None:
    """Play a script; the recording's id, None where it was skipped."""
    print(f"{script.id}: {script.motion}, {script.support}, {script.duration:.1f} s", flush=True)
    if not auto and not _agreed(agent, moved=False):
        return None
    wanted = {"script": script.document(), "repeat_of": repeat_of, "setup": dict(setup)}
    agent.say({"do": "pose", "agreed": not auto, **wanted})
    told = _until(agent, ("ready", ""), auto)
    if told["stage"] == "ready":
        if not auto and script.support == "ground":
            print(GROUND, flush=True)
            _agreed(agent, moved=True)
        agent.say({"do": "play", "agreed": not auto})
        told = _until(agent, ("",), auto)
    result = told["result"]
    if "recording" not in result:
        raise _Ended(f"{script.id}: {result.get('reason', 'it ended')}")
    print(result["recording"], flush=True)
    return Path(result["recording"]).stem


def _agreed(agent: Talk, moved: bool) -> bool:
    """Wait for ENTER; false where the script is to be skipped. Any other key stops the robot.

    Args:
      agent: that plays.
      moved: whether the robot is in the script's first pose by now, and no longer to be left.
    """
    while (key := key_pressed()) not in ENTER:
        agent.say({"do": "health"})  # who is silent is taken for gone
        if key == "s" and not moved:
            return False
        if key == "q" and not moved:
            raise _Ended("left")
        if key:
            _stop(agent)
    return True


def _until(agent: Talk, stages: Sequence[str], auto: bool) -> dict[str, Any]:
    """Wait for a stage; any key stops the robot meanwhile."""
    while True:
        told: dict[str, Any] = agent.say({"do": "health"})["script"]
        if told["stage"] in stages:
            return told
        if auto:
            time.sleep(LOOK)
        elif key_pressed():
            _stop(agent)


def _stop(agent: Talk) -> None:
    told = agent.say({"do": "stop", "reason": "by the operator"})
    if not told["limp"]:
        raise _Ended("NOT EVERY SERVO SAYS THAT IT IS LIMP: use the power switch")
    raise _Ended(STOPPED)


@contextmanager
def _attended(socket: Path) -> Iterator[Talk]:
    """A robot that moves by a script is stopped when whoever plays it is gone."""
    try:
        with leaving(), attending(socket) as agent:
            yield agent
    except (LeftError, OSError) as error:
        raise KeyboardInterrupt from error
