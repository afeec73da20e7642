"""The reference motion of an episode: from the start pose into the periodic gait."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.physics.model import compile_model
from pup.robot import Gait, RobotDescription

Array = NDArray[np.float64]


class Reference:
    """Joint angles over the time of an episode.

    The angles of the start turn linearly into the gait's first within the blend time, then the gait
    runs. The authors play a recorded motion so, in rows of 0.03 s; `Gait` is its Fourier series.

    Args:
      gait: of a robot.
    """

    def __init__(self, gait: Gait) -> None:
        self.gait = gait
        self.first = gait.angles(0.0)
        self.start = self.first if gait.start is None else np.array(gait.start)
        # All joints share the sines and cosines: series are padded to one length.
        most = max(len(series.a) for series in gait.joints.values())
        self._harmonics = 2 * np.pi / gait.period * np.arange(1, most + 1)
        self._mean = np.array([series.c0 for series in gait.joints.values()])
        self._waves = np.zeros((2 * most, len(gait.joints)))
        for joint, series in enumerate(gait.joints.values()):
            self._waves[: len(series.a), joint] = series.a
            self._waves[most : most + len(series.b), joint] = series.b

    def phase(self, time: Array) -> Array:
        """Cosine and sine of where the gait is at times, (n,) s; shape (n, 2)."""
        turn = 2 * np.pi / self.gait.period * np.maximum(time - self.gait.blend, 0.0)[:, None]
        return np.concatenate([np.cos(turn), np.sin(turn)], axis=1)

    def angles(self, time: Array) -> Array:
        """Angles at times since the start of an episode, (n,) s, shape (n, n_joints), rad."""
        into = np.maximum(time - self.gait.blend, 0.0)[:, None] * self._harmonics
        gait = self._mean + np.concatenate([np.cos(into), np.sin(into)], axis=1) @ self._waves
        share = np.ones_like(time)
        if self.gait.blend > 0:
            share = np.minimum(time / self.gait.blend, 1.0)
        return np.asarray(self.start + share[:, None] * (gait - self.start))


def gait_of(robot: RobotDescription) -> Gait:
    """The robot's gait, if it can walk.

    Raises:
      InputError: it cannot; the message says what it lacks.
    """
    file = robot.folder / "robot.toml"
    if robot.gait is None:
        raise InputError(
            f"{file}: robot {robot.name!r} has no [gait] to learn walking from; add one"
        )
    if not robot.floating or not robot.feet:
        raise InputError(
            f"{file}: robot {robot.name!r} cannot walk: it needs a free joint in model.xml and feet"
        )
    model = compile_model(robot, "ground").compiled
    kinds = {name: model.joint(name).type[0] for name in robot.joint_names}
    slides = [name for name, kind in kinds.items() if kind == mujoco.mjtJoint.mjJNT_SLIDE]
    if slides:
        raise InputError(
            f"{file}: robot {robot.name!r} cannot learn to walk: {', '.join(slides)} slide, and "
            "the task's reach, noise and costs are of angles; leave [gait] out"
        )
    return robot.gait
