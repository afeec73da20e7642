"""When a joint runs into the end of its range: what follows is not held against the model.

How hard a mechanical stop is and how much it gives back, no motion tells, and no robot description
knows. A limb that drops onto its stops would have its errors blamed on whatever moves the moment of
the blow, such as an encoder's bias.
"""

import numpy as np
from numpy.typing import NDArray

from pup.physics.model import compile_model
from pup.physics.terms.scale import Scale
from pup.recording import Recording
from pup.recording_cuts import between
from pup.robot import RobotDescription

Array = NDArray[np.float64]

BEYOND, FAST = 0.005, 0.5
"""A joint that is so far beyond its range, rad, and was so fast on its way, rad/s, has met it."""
SHAKEN = 0.3
"""Time after that until the limb has forgotten it, s."""
MOST = 0.2
"""Share of a recording above which the range is wrong, not the motion."""


def knocked(robot: RobotDescription, recording: Recording) -> NDArray[np.bool_]:
    """Which ticks come just after a joint met its stop in model.xml, shape (n_ticks,)."""
    angle = Scale.of(robot).angle
    lower, upper = _stops(robot, recording.support)
    columns = [recording.joints.index(name) for name in robot.joint_names]
    position, time = recording.position[:, columns], recording.time
    position = between(time, position)
    outside = (position < lower - BEYOND * angle) | (position > upper + BEYOND * angle)
    speed = np.abs(np.diff(position, axis=0)) / np.diff(time)[:, None]
    met = np.flatnonzero((outside[1:] & ~outside[:-1] & (speed > FAST * angle)).any(axis=1))
    shaken = np.zeros(len(time), dtype=bool)
    for tick in met:
        shaken |= (time >= time[tick]) & (time <= time[tick + 1] + SHAKEN)
    return shaken if shaken.mean() <= MOST else np.zeros_like(shaken)


def _stops(robot: RobotDescription, support: str) -> tuple[Array, Array]:
    """Where the joints' ranges end, rad, shape (n_joints,) each; infinite where they do not."""
    model = compile_model(robot, support).compiled
    joints = [int(model.joint(name).id) for name in robot.joint_names]
    limited = model.jnt_limited[joints].astype(bool)
    lower, upper = model.jnt_range[joints].T
    return np.where(limited, lower, -np.inf), np.where(limited, upper, np.inf)
