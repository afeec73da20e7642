"""A script as a file: what a robot is to play while it is recorded, and how it gets there.

It is made where the robot is simulated and played where the robot is (`pup-agent play`), which
needs no simulator for it.
"""

import hashlib
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.files import read_json, write_json
from pup.recording_rules import SUPPORTS, check_id

Array = NDArray[np.float64]

SCHEMA = 1
LIMIT = 2**19  # bytes; an agent reads it while it holds a robot
LONGEST = 60.0  # s
POSES = 16  # on the way, at most
FALLEN = 1.0
"""Rad of roll or pitch; there the authors switch their robot off, and a fall ends."""
DIGITS = 6  # after the point, of rad and s
NAME = 80  # characters of an id, to which the digest and a number are added
SHOWN = 8
"""Digits of its digest that tell a script from another of the same name."""


@dataclass(frozen=True, eq=False)
class Script:
    """What to send when.

    Attributes:
      id: its name.
      robot: whose it is.
      motion: motion type, as in a recording.
      support: `suspended`, `ground` or `bench`.
      joints: names, in the order of the columns.
      way: poses from home to the first target, straight between which the robot does not touch
        itself, shape (n_poses, n_joints), rad (m for a slide); home is the first of them.
      time: shape (n_ticks,), s, from 0.
      target: shape (n_ticks, n_joints); each holds until the next.
      back: poses from the last target home again; none where the robot has fallen by then.
    """

    id: str
    robot: str
    motion: str
    support: str
    joints: tuple[str, ...]
    way: Array
    time: Array
    target: Array
    back: Array

    @property
    def duration(self) -> float:
        """Of the motion, s."""
        return float(self.time[-1])

    @property
    def falls(self) -> bool:
        """Whether the robot lies at the end."""
        return not len(self.back)

    @cached_property
    def name(self) -> str:
        """Its id and the beginning of its digest: what is recorded of it is called so."""
        told = json.dumps(self.document(), sort_keys=True).encode()
        return f"{self.id}-{hashlib.sha256(told).hexdigest()[:SHOWN]}"

    def at(self, time: float) -> Array:
        """The target that holds at a time since the beginning, shape (n_joints,)."""
        row = int(np.searchsorted(self.time, time + 1e-9, side="right")) - 1
        return np.asarray(self.target[max(row, 0)])

    def document(self) -> dict[str, Any]:
        """As JSON values, rounded."""
        told: dict[str, Any] = {"schema": SCHEMA, "id": self.id, "robot": self.robot}
        told |= {"motion": self.motion, "support": self.support, "joints": list(self.joints)}
        return told | {name: getattr(self, name).round(DIGITS).tolist() for name in NUMBERS}

    def write(self, file: Path) -> None:
        """Write it."""
        write_json(file, self.document())

    @classmethod
    def read(cls, file: Path) -> "Script":
        """Read one.

        Raises:
          InputError: it is none, or holds what no robot can play.
        """
        told = read_json(file, LIMIT)
        try:
            return cls.of(told)
        except InputError as error:
            raise InputError(f"{file}: {error}; `pup record --scripts` makes scripts") from error

    @classmethod
    def of(cls, told: object) -> "Script":
        """What JSON values say.

        Raises:
          InputError: as `read`.
        """
        return _checked(told)


NUMBERS = ("way", "time", "target", "back")


def _checked(told: object) -> Script:
    if not isinstance(told, dict) or told.get("schema") != SCHEMA:
        raise InputError(f"is no script of schema {SCHEMA}")
    for key in ("id", "robot", "motion"):
        if not isinstance(told.get(key), str) or not told[key]:
            raise InputError(f"{key!r} is {told.get(key)!r}; it must be a text")
    check_id(told["id"])
    if len(told["id"]) > NAME:
        raise InputError(f"'id' has {len(told['id'])} characters; {NAME} are the most")
    if told.get("support") not in SUPPORTS:
        raise InputError(f"'support' is {told.get('support')!r}; use {', '.join(SUPPORTS)}")
    joints = told.get("joints")
    if not isinstance(joints, list) or not joints or not all(isinstance(j, str) for j in joints):
        raise InputError("'joints' is no list of names")
    time = _numbers(told, "time", 1)
    way, target, back = (_numbers(told, k, 2, len(joints)) for k in ("way", "target", "back"))
    if len(time) < 2 or len(target) != len(time):
        raise InputError("'time' and 'target' need as many rows, two at least")
    if time[0] != 0 or (np.diff(time) <= 0).any() or time[-1] > LONGEST:
        raise InputError(f"'time' does not go on from 0, to {LONGEST:g} s at most")
    if not 1 <= len(way) <= POSES or len(back) > POSES:
        raise InputError(f"'way' has no pose, or it or 'back' more than {POSES}")
    robot, motion, support = told["robot"], told["motion"], told["support"]
    return Script(told["id"], robot, motion, support, tuple(joints), way, time, target, back)


def _numbers(told: dict[str, Any], key: str, dimensions: int, columns: int = 0) -> Array:
    try:
        values = np.array(told.get(key), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{key!r} holds no rows of numbers") from error
    if values.size == 0 and dimensions == 2:
        values = np.empty((0, columns))
    if values.ndim != dimensions or not np.isfinite(values).all():
        raise InputError(f"{key!r} holds no rows of finite numbers")
    if dimensions == 2 and values.shape[1] != columns:
        raise InputError(f"{key!r} has rows of {values.shape[1]} numbers for {columns} joints")
    return values
