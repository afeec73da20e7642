"""Who tells how far the robot came: somebody with a tape, a command, or the virtual robot.

The paper measures by hand, the distance alone, and notes that any other measure would do.
"""

import hashlib
import math
import os
import subprocess
from pathlib import Path
from typing import Any, Protocol

from hardware_agent.config import DistanceSettings
from hardware_agent.control import Unreachable, say
from pup.errors import InputError
from pup.wire import FASTEST, Assign, farthest, without_mark

AXES = {"forward": (1.0, 0.0), "backward": (-1.0, 0.0), "sideways": (0.0, -1.0)}
"""Directions of a walk in the frame of the start: x forward, y left."""
BRISK = 1.0
"""Speed above which whoever typed a distance is asked for it again, m/s: a biped of the OP2's size
has to run for it, and 30 cm typed as 30 is far above."""


class DistanceError(Exception):
    """The distance could not be measured; told in one line."""


class Distance(Protocol):
    """A way to measure."""

    asks: bool
    """Whether a person has to be asked at the end."""

    def start(self, assign: Assign, direction: str) -> None:
        """The robot stands in its start pose and may be put on its feet; may take its time."""

    def now(self) -> float | None:
        """So far, m; None where that is not known. Quick."""

    def end(self) -> float | None:
        """At the end, m; None where a person is asked. May take its time."""


def distance_of(settings: DistanceSettings) -> Distance:
    """The way that the settings name."""
    if settings.kind == "hook":
        return Hook(settings)
    return Virtual(settings) if settings.kind == "virtual" else Operator()


def check_typed(distance: float, walked: float, horizon: float, sure: bool) -> None:
    """Refuse a distance that somebody mistyped, in centimetres say, or a program told so.

    Args:
      distance: that was told, m.
      walked: time until the fall or the end, s.
      horizon: longest walk, s.
      sure: whether nobody is to be asked again: it was typed before, or a program tells it.

    Raises:
      InputError: no robot comes so far, or hardly one.
    """
    most = farthest(horizon, walked)
    told = f"{distance:g} m in a walk of {walked:.1f} s"
    if not abs(distance) <= most:
        raise InputError(f"{told} cannot be ({most:g} m at most); tell it in metres")
    if abs(distance) > most * BRISK / FASTEST and not sure:
        raise InputError(
            f"{told} is far: tell it in metres (30 cm are 0.3), or the same again if it is right"
        )


class Operator:
    """Somebody at the robot, who is asked."""

    asks = True

    def start(self, assign: Assign, direction: str) -> None:
        """See Distance."""

    def now(self) -> float | None:
        """See Distance."""
        return None

    def end(self) -> float | None:
        """See Distance."""
        return None


class Hook:
    """A command, such as one that asks a motion capture.

    It is run with `start` when the robot stands in its start pose, and with `end` after the walk,
    when its last line is the distance in metres. PUP_STUDY, PUP_TRIAL, PUP_ATTEMPT and
    PUP_DIRECTION tell what it is about.

    Args:
      settings: of the configuration.
    """

    asks = False

    def __init__(self, settings: DistanceSettings) -> None:
        self._settings = settings
        self._environment: dict[str, str] = {}

    def start(self, assign: Assign, direction: str) -> None:
        """See Distance."""
        told = {"STUDY": assign.study, "TRIAL": assign.trial, "ATTEMPT": str(assign.attempt)}
        told["DIRECTION"] = direction
        self._environment = {f"PUP_{name}": value for name, value in told.items()}
        self._run("start")

    def now(self) -> float | None:
        """See Distance."""
        return None

    def end(self) -> float | None:
        """See Distance."""
        lines = self._run("end").splitlines()
        try:
            distance = float(lines[-1]) if lines else math.nan
        except ValueError:
            distance = math.nan
        if not math.isfinite(distance):
            told = lines[-1][:80] if lines else "nothing"
            raise DistanceError(f"the distance hook printed {told!r}, not a number of metres")
        return distance

    def _run(self, what: str) -> str:
        command = [*self._settings.command, what]
        try:
            done = subprocess.run(
                command,
                env=os.environ | self._environment,
                capture_output=True,
                text=True,
                timeout=self._settings.timeout,
                stdin=subprocess.DEVNULL,
            )
        except (OSError, UnicodeDecodeError, subprocess.TimeoutExpired) as error:
            raise DistanceError(f"the distance hook failed ({error})") from error
        if done.returncode:
            last = (done.stderr.strip().splitlines() or [""])[-1][:200]
            raise DistanceError(f"the distance hook ended with {done.returncode}: {last}")
        return done.stdout.strip()


class Virtual:
    """The virtual robot's side door, which also puts it on its feet.

    Args:
      settings: of the configuration.
    """

    asks = False

    def __init__(self, settings: DistanceSettings) -> None:
        self._path, self._renew = Path(settings.side), settings.renew
        self._axis = AXES["forward"]

    def start(self, assign: Assign, direction: str) -> None:
        """See Distance."""
        self._axis = AXES[direction]
        self._say({"cmd": "reset"} | ({"draw": _number(assign.trial)} if self._renew else {}))

    def now(self) -> float | None:
        """See Distance."""
        pose = self._say({"cmd": "pose"})
        return float(self._axis[0] * pose["forward"] + self._axis[1] * pose["left"])

    def end(self) -> float | None:
        """See Distance."""
        return self.now()

    def _say(self, command: dict[str, Any]) -> dict[str, Any]:
        try:
            return say(self._path, command)
        except Unreachable as error:
            raise DistanceError(f"{self._path}: the virtual robot does not answer") from error
        except InputError as error:
            raise DistanceError(f"{self._path}: {error}") from error


def _number(trial: str) -> int:
    """A number that a trial's name stands for, whichever attempt and study of this name it is."""
    return int.from_bytes(hashlib.sha256(without_mark(trial).encode()).digest()[:8], "big")
