"""The prompt of whoever stands at the robot: starts trials, stops the robot, types distances."""

import os
import select
import signal
import sys
import termios
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NoReturn

from hardware_agent.control import Talk, attending
from pup.errors import InputError

LOOK = 0.2  # s between two looks at the agent
HELP = (
    "SPACE or any other key, Ctrl-C too, STOPS the robot; e enables, d disables, q leaves "
    "(the agent goes on)"
)
ASKED = "distance in m, then ENTER (nothing: the trial does not count); other keys STOP: "
MOVING = ("posing", "placing", "settling", "running")
ENTER, RUBOUT = ("\n", "\r"), ("\x7f", "\b")


class LeftError(Exception):
    """The terminal is gone, and with it whoever could stop the robot."""


def operate(socket: Path) -> int:
    """Talk to the agent until the operator leaves.

    A robot that moves when the terminal is lost, or this process, is stopped: nobody could any
    more.

    Args:
      socket: of the agent.

    Returns:
      0 where the operator left, 1 where the terminal did.

    Raises:
      InputError: no agent answers, or this is no terminal.
    """
    if not sys.stdin.isatty():
        raise InputError("this is no terminal; use `pup-agent arm`, `stop` and `distance`")
    try:
        with leaving(), attending(socket) as agent, keys():
            print(HELP, flush=True)
            while trial := _watch(agent):
                _measure(agent, trial)
        return 0
    except (LeftError, OSError):
        return 1


def _watch(agent: Talk) -> str:
    """Show what happens and do what keys say; the trial whose distance to type, none to leave."""
    shown = ""
    while True:
        told = agent.say({"do": "health"})
        asked = told["waiting"] if told["stage"] not in MOVING else ""
        line = f"{told['state']} {told['reason']} trial {told['trial']}: {told['stage']} {asked}"
        if line != shown:
            print(line)
            shown = line
            if asked == "arm":
                print("ENTER starts the trial, s skips it")
        if asked == "distance":
            return str(told["trial"])
        key = key_pressed()
        if key == "q":
            return ""
        if key:
            _press(agent, key, asked)


def _press(agent: Talk, key: str, asked: str) -> None:
    """Do what a key means."""
    meaning = {"e": "enable", "d": "disable"}
    if asked == "arm":
        meaning |= dict.fromkeys(ENTER, "arm") | {"s": "skip"}
    do = meaning.get(key, "stop")
    try:
        told = agent.say({"do": do, "reason": "by the operator"})
    except InputError as error:
        print(error)
        return
    if do == "stop" and not told["limp"]:
        print("NOT EVERY SERVO SAYS THAT IT IS LIMP: use the power switch")


def _measure(agent: Talk, trial: str) -> None:
    """Let a distance be typed; a key that is no part of one stops the robot, as ever."""
    print(ASKED, end="", flush=True)
    typed = ""
    while (key := key_pressed()) not in ENTER:
        told = agent.say({"do": "health"})
        if not key:
            if told["waiting"] != "distance" or told["trial"] != trial:  # told elsewhere
                print()
                return
        elif key in "0123456789.,-+":
            typed += key
            print(key, end="", flush=True)
        elif key in RUBOUT:
            typed = typed[:-1]
            print("\b \b", end="", flush=True)
        else:
            print()
            _press(agent, " ", "")
            print(f"{ASKED}{typed}", end="", flush=True)
    print()
    try:
        if typed:
            metres = float(typed.replace(",", "."))
            agent.say({"do": "distance", "distance": metres, "trial": trial})
        else:
            agent.say({"do": "skip", "reason": "not measured"})
    except InputError as error:
        print(error)
    except ValueError:
        print(f"{typed!r} is no number of metres; 30 cm are 0.3")


def key_pressed() -> str:
    """A key that is pressed within a moment; empty for none.

    Raises:
      LeftError: the terminal is gone.
    """
    ready, _, _ = select.select([sys.stdin.fileno()], [], [], LOOK)
    if not ready:
        return ""
    read = os.read(sys.stdin.fileno(), 1)
    if not read:
        raise LeftError
    return read.decode(errors="replace")


def _leave(*_: object) -> NoReturn:
    raise LeftError


@contextmanager
def leaving() -> Iterator[None]:
    """A hangup or an end of the process is told as LeftError."""
    before = {n: signal.signal(n, _leave) for n in (signal.SIGHUP, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def keys() -> Iterator[None]:
    """Keys come one by one, as they are pressed, Ctrl-C, Ctrl-Z and Ctrl-S among them.

    None must get lost that should stop the robot.
    """
    before = termios.tcgetattr(sys.stdin)
    try:
        tty.setcbreak(sys.stdin)
        now = termios.tcgetattr(sys.stdin)
        now[0] &= ~termios.IXON
        now[3] &= ~(termios.ISIG | termios.IEXTEN)
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, now)
        yield
    finally:
        with suppress(termios.error):  # of a terminal that is gone
            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)
