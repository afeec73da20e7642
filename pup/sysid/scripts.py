"""Scripts for a robot that is not here: motions, and the ways to where they begin and home."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pup.robot import RobotDescription
from pup.script import Script
from pup.sysid.clearance import Clearance
from pup.sysid.excitation import Motion, script

Array = NDArray[np.float64]

HOME = ("home", "stand")
"""Named poses in which a robot waits between scripts, the first that it has; else its zero."""


def scripts(
    robot: RobotDescription, kinds: Sequence[str], rng: np.random.Generator
) -> tuple[Script, ...]:
    """Make scripts for `pup-agent play`.

    Args:
      robot: who is to play them.
      kinds: see `excitation.script`.
      rng: source of all that is random.

    Raises:
      InputError: a kind that is unknown or that the robot cannot play.
    """
    clearance, home = Clearance(robot), _home(robot)
    return tuple(_whole(robot, clearance, home, made) for made in script(robot, kinds, rng))


def _whole(robot: RobotDescription, clearance: Clearance, home: Array, made: Motion) -> Script:
    first, last = made.target[0], made.target[-1]
    back = [] if made.motion == "fall" else clearance.way(last, home)
    return Script(
        id=made.id,
        robot=robot.name,
        motion=made.motion,
        support=made.support,
        joints=robot.joint_names,
        way=np.array([home, *clearance.way(home, first)]),
        time=made.time,
        target=made.target,
        back=np.array(back).reshape(-1, len(home)),
    )


def _home(robot: RobotDescription) -> Array:
    named = [robot.poses[name] for name in HOME if name in robot.poses]
    return np.asarray(named[0] if named else np.clip(0.0, *robot.limits), dtype=np.float64)
