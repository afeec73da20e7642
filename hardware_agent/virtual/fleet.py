"""Virtual robots side by side without buses, for experiments of many rollouts.

Servos, bodies and IMUs are those behind the bus, and all numbers are rounded as its registers
round them; only the packets are left out.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hardware_agent.virtual.bno055 import lean
from hardware_agent.virtual.drives import CENTRE, TICK
from hardware_agent.virtual.plant import Plant
from hardware_agent.virtual.servo import damping
from hardware_agent.virtual.skeleton import STEP
from pup.robot import RobotDescription

Array = NDArray[np.float64]

SETTLING = 1.0  # s that a robot stands before it is left alone
LARGEST = 4095  # ticks


class Fleet:
    """Robots that are told goals and tell what their sensors say.

    Args:
      robot: their description; it stands on its feet and has a gait.
      seeds: of their physics, one each; a seed may come several times.
      gains: registers P and D of Protocol 1.0; the paper's by default.
    """

    def __init__(
        self, robot: RobotDescription, seeds: Sequence[int], gains: tuple[int, int] = (32, 16)
    ) -> None:
        assert robot.floating
        assert robot.gait is not None
        self.robot = robot
        self.plant = Plant.of(robot, seeds)
        self._pose = np.array(robot.gait.start or robot.gait.angles(0.0))
        orders = self.plant.drives.orders
        orders.kp[:], orders.kd[:], orders.power[:] = gains[0], damping(gains[1]), 1.0
        self.plant.drives.refresh()
        self._put_down = self.plant.qpos[:, :2].copy()

    def __len__(self) -> int:
        return len(self.plant.characters)

    @property
    def way(self) -> Array:
        """How far forward and to the left each has come since the reset, m, shape (n, 2)."""
        return np.asarray(self.plant.qpos[:, :2] - self._put_down)

    def reset(self) -> None:
        """Put all down in the start pose, stiff, and let them settle."""
        self.plant.drives.orders.goal[:] = _ticks(self._pose)
        self.plant.place(range(len(self)))
        self._put_down = self.plant.qpos[:, :2].copy()
        self.plant.step(round(SETTLING / STEP))

    def observe(self) -> tuple[Array, Array]:
        """What the sensors say.

        Returns:
          Positions, rad, shape (n, n_joints), and the torso's roll and pitch, rad, shape (n, 2).
        """
        imus = self.plant.imus
        assert imus is not None
        tilt = np.array([lean(imus.read(lane)[0]) for lane in range(len(self))])
        return (self.plant.encoders() - CENTRE) * TICK, tilt

    def command(self, targets: Array, period: float) -> None:
        """Write goals and let a control period pass.

        Args:
          targets: rad, shape (n, n_joints).
          period: s.
        """
        for lane, goal in enumerate(_ticks(targets)):
            self.plant.order(lane, slice(None), goal)
        self.plant.step(round(period / STEP))


def _ticks(angles: Array) -> Array:
    return np.asarray(np.clip(np.rint(CENTRE + angles / TICK), 0, LARGEST))
