"""Scripts that whoever stands at the robot lets it play, and their recordings."""

import itertools
import logging
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from hardware_agent.activities import Played, Ready
from hardware_agent.motion import Motion
from hardware_agent.rollout import columns_of
from hardware_agent.status import brief
from pup.errors import InputError
from pup.recording import Recording
from pup.robot import RobotDescription
from pup.script import Script

log = logging.getLogger("pup-agent")

SLACK = 0.02
"""Rad (m) beyond a joint's range that a script may ask for; the limits hold it back there."""
LARGEST = 1e300
"""Of a number that becomes a float; JSON knows larger ones, and NaN."""


class Stage(StrEnum):
    """Where the script is that was asked for last."""

    NONE = ""
    POSING = "posing"
    READY = "ready"
    PLAYING = "playing"


class Scripts:
    """Plays scripts, in the agent's main thread.

    Args:
      robot: who plays them.
      motion: the control loop.
      folder: of the recordings.
      source: of them, `hardware` or `simulation`.
    """

    def __init__(self, robot: RobotDescription, motion: Motion, folder: Path, source: str) -> None:
        self._robot, self._motion = robot, motion
        self._folder, self._source = folder, source
        self._script: Script | None = None
        self._stage = Stage.NONE
        self._repeat_of: str | None = None
        self._setup: dict[str, float] = {}
        self._result: dict[str, str] = {}

    @property
    def told(self) -> dict[str, Any]:
        """The script's name and stage, and what became of the one before, for `health`."""
        name = None if self._script is None else self._script.name
        return {"name": name, "stage": str(self._stage), "result": self._result}

    def pose(
        self, told: object, repeat_of: object, setup: object, stopped: Callable[[], bool]
    ) -> None:
        """Let the robot go to a script's first pose.

        Args:
          told: the script, as JSON values.
          repeat_of: id of the recording that this one shall repeat, None for the first.
          setup: what was changed on the robot, by its knobs, as JSON values.
          stopped: whether somebody has stopped the robot since this was asked for.

        Raises:
          InputError: it is no script of this robot, or cannot be played now.
        """
        script = Script.of(told)
        self._check(script)
        first = script.name if repeat_of is None else repeat_of
        if not isinstance(first, str) or not first.startswith(script.name):
            raise InputError(f"{repeat_of!r} is no recording of {script.name}")
        changed = self._changed(setup)
        self._repeat_of = None if repeat_of is None else first
        refused = self._motion.pose(script, stopped)
        if refused is not None:
            raise InputError(refused.reason)
        self._script, self._stage, self._result = script, Stage.POSING, {}
        self._setup = changed

    def _check(self, script: Script) -> None:
        robot = self._robot
        if script.robot != robot.name or script.joints != robot.joint_names:
            raise InputError(f"{script.id}: is for {script.robot!r}, or for other joints than here")
        poses = np.concatenate([script.way, script.target, script.back])
        lower, upper = robot.limits
        beyond = ((poses < lower - SLACK) | (poses > upper + SLACK)).any(axis=0)
        if beyond.any():
            joint = script.joints[int(np.argmax(beyond))]
            raise InputError(f"{script.id}: moves {joint} beyond its range; are these radians?")

    def _changed(self, told: object) -> dict[str, float]:
        """What was changed on the robot, where its knobs know it."""
        if not isinstance(told, dict):
            raise InputError("setup: is no object of knobs and numbers")
        for knob, value in told.items():
            number = isinstance(value, int | float) and not isinstance(value, bool)
            if not number or not abs(value) <= LARGEST:
                raise InputError(f"setup: {knob!r} is {brief(repr(value))}; use a finite number")
        setup = {knob: float(value) for knob, value in told.items()}
        self._robot.setup(setup)
        return setup

    def play(self, stopped: Callable[[], bool]) -> None:
        """Play it.

        Raises:
          InputError: none waits for that.
        """
        refused = self._motion.play(stopped)
        if refused is not None:
            raise InputError(refused.reason)
        self._stage = Stage.PLAYING

    def handle(self, event: Ready | Played) -> None:
        """Something happened in the control loop."""
        if isinstance(event, Ready):
            self._stage = Stage.READY if self._stage is Stage.POSING else self._stage
            return
        self._result = {"reason": event.reason} if event.reason else self._keep(event)
        self._script, self._stage = None, Stage.NONE  # last: who waits for it reads the result
        log.info("script %s: %s", event.script.name, ", ".join(self._result.values()))

    def _keep(self, event: Played) -> dict[str, str]:
        """Write the recording; names go on where the script was recorded before."""
        script, rows = event.script, np.array([row.values for row in event.rows])
        if len(rows) < 2:
            return {"reason": "it was over before it began"}
        names = itertools.chain([script.name], (f"{script.name}_{n}" for n in itertools.count(2)))
        name = next(name for name in names if not self._file(name).exists())
        try:
            made = Recording(
                id=name,
                robot=script.robot,
                motion=script.motion,
                support=script.support,
                source=self._source,
                **columns_of(rows, script.joints),
                setup=self._setup,
                repeat_of=self._repeat_of,
                notes="played by pup-agent",
            )
            made.write(self._file(name))
        except (OSError, InputError) as error:
            return {"reason": f"the recording is lost: {brief(str(error))}"}
        return {"recording": str(self._file(name))}

    def _file(self, name: str) -> Path:
        return self._folder / f"{name}.parquet"
