"""A whole virtual robot: bus, board, IMU, and what a laboratory does to it by hand."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hardware_agent.virtual.bno055 import Bno055
from hardware_agent.virtual.board import Board
from hardware_agent.virtual.bus import Bus
from hardware_agent.virtual.imu import roll_pitch_yaw
from hardware_agent.virtual.plant import Hold, Plant
from hardware_agent.virtual.servo import Servo, Servo1, Servo2
from hardware_agent.virtual.skeleton import STEP
from pup.errors import InputError
from pup.robot import RobotDescription

Array = NDArray[np.float64]

LOOK = 20  # steps between looks at what may be wrong with a servo
PATIENCE = 1.5  # s of full duty until a servo calls it overload
FULL = 0.98  # share of the allowed duty that counts as full


@dataclass(frozen=True)
class Pose:
    """What a motion capture sees of the torso.

    Attributes:
      time: simulated, s.
      position: m, shape (3,).
      tilt: roll, pitch and yaw, Z-Y-X, rad, shape (3,).
      forward: way since the robot was put down, along where it looked then, m.
      left: the same to its left, m.
      held: how it is held: "not", "hand" or "rope".
    """

    time: float
    position: tuple[float, ...]
    tilt: tuple[float, ...]
    forward: float
    left: float
    held: str


class VirtualRobot:
    """A robot that is not there.

    Args:
      robot: its description; all joints have servo ids.
      seed: decides on its physics.
      protocol: of its servos, 1 or 2.

    Raises:
      InputError: the description lacks servo ids.
    """

    def __init__(self, robot: RobotDescription, seed: int, protocol: int = 1) -> None:
        kind = {1: Servo1, 2: Servo2}[protocol]
        self.robot = robot
        self.plant = Plant.of(robot, [seed])
        self.servos: list[Servo] = []
        for index, joint in enumerate(robot.joints):
            if joint.servo_id is None:
                raise InputError(
                    f"{robot.folder / 'robot.toml'}: joint {joint.name!r} has no servo_id; a "
                    "virtual robot needs one for each"
                )
            self.servos.append(kind(joint.servo_id, self.plant, index))
        self.board = Board(self.plant, self.servos)
        self.bus = Bus([*self.servos, self.board])
        self.imu = Bno055(self.plant)
        self._full = np.zeros(len(self.servos))
        self._put_down = 0.0, 0.0, 0.0
        self.reset()

    @property
    def time(self) -> float:
        """Simulated time, s."""
        return self.plant.time

    def reset(self, hold: Hold = Hold.HAND, draw: int | None = None) -> None:
        """Put the robot down in its start pose, as a person would; servos stay as they are told.

        Args:
          hold: how it is held there.
          draw: makes what follows the same whatever came before: a fresh battery, cold motors, and
            noise drawn from this number and the seed. None leaves all as it is.
        """
        if draw is not None:
            self.plant.renew(draw)
            self._full[:] = 0.0
        self.plant.place([0], hold)
        if self.robot.floating:
            x, y, *_ = map(float, self.plant.qpos[0, :2])
            self._put_down = x, y, roll_pitch_yaw(self.plant.qpos[0, 3:7])[2]

    def release(self) -> None:
        """Let go."""
        self.plant.release(0)

    def battery(self) -> None:
        """Put a fresh battery in."""
        drives = self.plant.drives
        drives.charge = drives.fresh.copy()
        drives.refresh()

    def cool(self) -> None:
        """Wait until the motors are cold, without the time passing."""
        self.plant.drives.cool()

    def advance(self, duration: float) -> None:
        """Let time pass.

        Args:
          duration: s.
        """
        left = round(duration / STEP)
        while left > 0:
            count = min(left, LOOK - self.plant.steps % LOOK)
            self.plant.step(count)
            left -= count
            if self.plant.steps % LOOK == 0:
                self._look()

    def _look(self) -> None:
        """See to servos that are overloaded, hot, out of their voltage or cut off."""
        drives = self.plant.drives
        duty, most = np.abs(drives.moving.duty[0]), drives.most[0]
        pushing = (duty >= FULL * most) & (most > 0) & (drives.orders.power[0] > 0)
        self._full = np.where(pushing, self._full + LOOK * STEP, 0.0)
        for servo, full in zip(self.servos, self._full, strict=True):
            servo.protect(bool(full > PATIENCE))
            servo.watch(self.time)

    def pose(self) -> Pose:
        """What a motion capture would see; of a bench, nothing but the time."""
        held = Hold(self.plant.held[0]).name.lower()
        if not self.robot.floating:
            return Pose(self.time, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, 0.0, held)
        x, y, z = map(float, self.plant.qpos[0, :3])
        x_then, y_then, yaw = self._put_down
        way, ahead = np.array([x - x_then, y - y_then]), np.array([np.cos(yaw), np.sin(yaw)])
        forward, left = float(way @ ahead), float(way @ np.array([-ahead[1], ahead[0]]))
        tilt = roll_pitch_yaw(self.plant.qpos[0, 3:7])
        return Pose(self.time, (x, y, z), tilt, forward, left, held)
