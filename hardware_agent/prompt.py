"""The prompt of whoever stands at the robot: starts trials, stops the robot, types distances."""

import os
import select
import sys
import termios
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hardware_agent.control import say
from pup.errors import InputError

LOOK = 0.2  # s between two looks at the agent
HELP = "SPACE or any other key STOPS the robot; e enables, d disables, q leaves (the agent goes on)"
MOVING = ("posing", "placing", "settling", "running")


def operate(socket: Path) -> int:
    """Talk to the agent until the operator leaves.

    Args:
      socket: of the agent.

    Raises:
      InputError: no agent answers, or this is no terminal.
    """
    if not sys.stdin.isatty():
        raise InputError("this is no terminal; use `pup-agent arm`, `stop` and `distance`")
    while True:
        with _keys():
            print(HELP, flush=True)
            if not _watch(socket):
                return 0
        _measure(socket)


def _watch(socket: Path) -> bool:
    """Show what happens and do what keys say; True for a distance to type, False to leave."""
    shown = ""
    while True:
        told = say(socket, {"do": "health"})
        asked = told["waiting"] if told["stage"] not in MOVING else ""
        line = f"{told['state']} {told['reason']} trial {told['trial']}: {told['stage']} {asked}"
        if line != shown:
            print(line)
            shown = line
            if asked == "arm":
                print("ENTER starts the trial, s skips it")
        if asked == "distance":
            return True
        key = _key()
        if key and _press(socket, key, asked):
            return False


def _press(socket: Path, key: str, asked: str) -> bool:
    """Do what a key means; True to leave."""
    meaning = {"e": "enable", "d": "disable"}
    if asked == "arm":
        meaning |= {"\n": "arm", "\r": "arm", "s": "skip"}
    if key == "q":
        return True
    try:
        say(socket, {"do": meaning.get(key, "stop"), "reason": "by the operator"})
    except InputError as error:
        print(error)
    return False


def _measure(socket: Path) -> None:
    try:
        typed = input("distance in m (nothing: the trial does not count): ").strip()
    except EOFError:  # Ctrl-D; it is asked for again
        print()
        return
    try:
        if typed:
            say(socket, {"do": "distance", "distance": float(typed.replace(",", "."))})
        else:
            say(socket, {"do": "skip", "reason": "not measured"})
    except (InputError, ValueError) as error:
        print(error)


def _key() -> str:
    """A key that is pressed within a moment; empty for none."""
    ready, _, _ = select.select([sys.stdin.fileno()], [], [], LOOK)
    return os.read(sys.stdin.fileno(), 1).decode(errors="replace") if ready else ""


@contextmanager
def _keys() -> Iterator[None]:
    """Keys come one by one, as they are pressed: none must get lost that should stop the robot."""
    before = termios.tcgetattr(sys.stdin)
    try:
        tty.setcbreak(sys.stdin)
        yield
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)
