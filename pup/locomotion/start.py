"""Where episodes start: standing in the gait's start pose, slightly disturbed."""

import mujoco
import mujoco.batch
import numpy as np
from numpy.typing import NDArray

from pup.locomotion.reference import Reference
from pup.locomotion.settings import TaskSettings
from pup.physics.model import Model, compile_model, lowest_point, standing_qpos
from pup.physics.rotations import multiply, rotation
from pup.robot import RobotDescription

Array = NDArray[np.float64]


class Starts:
    """Draws the states that episodes start in.

    The torso is at the origin, facing along x; its pitch, the joints and all velocities are off by
    a little; the lowest point of the robot touches the floor.

    Args:
      robot: has a free torso and a gait.
      pose: angles of the joints, shape (n_joints,), rad.
      settings: say how much is off.
      most: episodes that may start at once.
    """

    def __init__(
        self, robot: RobotDescription, pose: Array, settings: TaskSettings, most: int
    ) -> None:
        self.settings = settings
        self.model = compile_model(robot, "ground")
        self.qpos = _start(robot, self.model, pose)
        self._batch = mujoco.batch.Batch(self.model.compiled, most, 1)
        self._places, self._axes = self._batch.bind("geom_xpos"), self._batch.bind("geom_xmat")

    def draw(self, rng: np.random.Generator, count: int) -> tuple[Array, Array]:
        """States of new episodes: qpos, shape (count, nq), and qvel, shape (count, nv)."""
        settings, model = self.settings, self.model

        def off(size: float, *shape: int) -> Array:
            return rng.uniform(-size, size, (count, *shape))

        qpos = np.tile(self.qpos, (count, 1))
        turn = np.zeros((count, 3))
        turn[:, 1] = off(settings.start_pitch_noise)
        qpos[:, 3:7] = multiply(rotation(turn), qpos[:, 3:7])
        joints = qpos[:, model.qpos].shape[1]
        qpos[:, model.qpos] += off(settings.start_position_noise, joints)
        qpos[:, 2] -= self._lowest(qpos)
        return qpos, off(settings.start_velocity_noise, model.compiled.nv)

    def _lowest(self, qpos: Array) -> Array:
        ids = np.arange(len(qpos), dtype=np.int32)
        self._batch.qpos[ids] = qpos
        self._batch.forward(ids=ids, stage=mujoco.mjtStage.mjSTAGE_POS)
        return lowest_point(self.model.compiled, self._places[ids], self._axes[ids])


def torso_height(robot: RobotDescription) -> float:
    """How high the torso's centre of mass is where episodes start, m, on a floor at height 0.

    Args:
      robot: has a free torso and a gait.
    """
    assert robot.gait is not None and robot.torso is not None
    model = compile_model(robot, "ground")
    data = mujoco.MjData(model.compiled)
    data.qpos[:] = _start(robot, model, Reference(robot.gait).start)
    mujoco.mj_kinematics(model.compiled, data)
    return float(data.body(robot.torso).xipos[2])


def _start(robot: RobotDescription, model: Model, pose: Array) -> Array:
    """The configuration that episodes start in, without what is drawn, shape (nq,)."""
    assert robot.gait is not None
    torso = np.full(4, np.nan)
    if robot.gait.start_pitch is not None:
        torso = rotation(np.array([0.0, robot.gait.start_pitch, 0.0]))
    return standing_qpos(robot, model, pose, torso)
