"""Whether a robot touches itself in a pose or on the way from one to another."""

from copy import copy

import mujoco
import numpy as np
from numpy.typing import NDArray

from pup.physics.model import compile_model
from pup.robot import RobotDescription

Array = NDArray[np.float64]

STRIDE = 0.05  # rad (or m) of the joint that moves furthest, between poses that are checked


class Clearance:
    """Self-collision of one robot, by MuJoCo's contacts between its bodies.

    Pairs that the model excludes may touch, and what the base stands on does not count while the
    base is free.

    Args:
      robot: the robot.
      distance: bodies nearer than this count as touching, m.
    """

    def __init__(self, robot: RobotDescription, distance: float = 0.0) -> None:
        compiled = compile_model(robot, "ground" if robot.floating else "bench")
        self._model = copy(compiled.compiled)
        self._model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        self._model.geom_margin[:] = distance / 2  # the margins of the two geoms add up
        self._data = mujoco.MjData(self._model)
        self._qpos = compiled.qpos
        self._named = [np.zeros(len(robot.joints)), *map(np.array, robot.poses.values())]
        fixed = self._model.body_weldid == 0
        self._fixed_geom = fixed[self._model.geom_bodyid] & robot.floating

    def free(self, pose: Array) -> bool:
        """Whether nothing touches in a pose of shape (n_joints,)."""
        self._data.qpos[self._qpos] = pose
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_collision(self._model, self._data)
        touching = self._data.contact.geom[: self._data.ncon]
        return not (~self._fixed_geom[touching]).all(axis=1).any()

    def path_free(self, start: Array, end: Array) -> bool:
        """Whether nothing touches on the straight line between two poses, both included."""
        count = 1 + int(np.ceil(np.abs(end - start).max() / STRIDE))
        return all(self.free(start + s * (end - start)) for s in np.linspace(0, 1, count + 1))

    def way(self, start: Array, end: Array) -> tuple[Array, ...] | None:
        """Poses on the way to the end, which is the last of them; None where no way is free.

        Straight where nothing touches, else by zero or a named pose of the robot.
        """
        if self.path_free(start, end):
            return (end,)
        for between in self._named:
            if self.path_free(start, between) and self.path_free(between, end):
                return between, end
        return None
