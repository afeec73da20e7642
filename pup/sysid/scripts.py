"""Scripts for a robot that is not here: motions, and the ways to where they begin and home."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.robot import RobotDescription
from pup.script import Script
from pup.sysid.clearance import Clearance
from pup.sysid.excitation import Motion, script

Array = NDArray[np.float64]

HOME = ("home", "stand")
"""Named poses in which a robot waits between scripts, the first that it has; else its zero."""
DRAWS = 20
"""Of motions, before one that no free way leads to is given up."""


def scripts(
    robot: RobotDescription, kinds: Sequence[str], rng: np.random.Generator
) -> tuple[Script, ...]:
    """Make scripts for `pup-agent play`; a motion without a free way there or home is drawn anew.

    Args:
      robot: who is to play them.
      kinds: see `excitation.script`.
      rng: source of all that is random.

    Raises:
      InputError: a kind that is unknown or that the robot cannot play, or one without such ways.
    """
    clearance, home = Clearance(robot), _home(robot)
    made: dict[str, Script] = {}
    left: list[str] = []
    for _ in range(DRAWS):
        motions = script(robot, kinds, rng)
        for motion in motions:
            whole = _whole(robot, clearance, home, motion)
            if whole is not None:
                made.setdefault(motion.id, whole)
        left = [motion.id for motion in motions if motion.id not in made]
        if not left:
            return tuple(made[motion.id] for motion in motions)
    raise InputError(
        f"robot {robot.name!r}: it would touch itself on every way from the pose in which it waits "
        f"to {left[0]} and back; add a pose on the way to [poses] of robot.toml, or exclude the "
        "contact of links that overlap in model.xml"
    )


def _whole(
    robot: RobotDescription, clearance: Clearance, home: Array, made: Motion
) -> Script | None:
    """A motion with its ways; None where one of them is not free."""
    way = clearance.way(home, made.target[0])
    back = () if made.motion == "fall" else clearance.way(made.target[-1], home)
    if way is None or back is None:
        return None
    return Script(
        id=made.id,
        robot=robot.name,
        motion=made.motion,
        support=made.support,
        joints=robot.joint_names,
        way=np.array([home, *way]),
        time=made.time,
        target=made.target,
        back=np.array(back).reshape(-1, len(home)),
    )


def _home(robot: RobotDescription) -> Array:
    named = [robot.poses[name] for name in HOME if name in robot.poses]
    return np.asarray(named[0] if named else np.clip(0.0, *robot.limits), dtype=np.float64)
