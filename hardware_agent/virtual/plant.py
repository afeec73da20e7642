"""Robots in motion: their servos at 1 kHz on MuJoCo's bodies.

Robots stand side by side as lanes of one batch, so that an experiment runs many at the price of
few; what hangs on a bus is one lane. Joint vectors are in the robot's order.
"""

from collections import deque
from collections.abc import Sequence

import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from hardware_agent.virtual.character import Character, draw
from hardware_agent.virtual.drives import HEAT, Drives
from hardware_agent.virtual.imu import Imus
from hardware_agent.virtual.skeleton import STEP, bodies_of, build, standing
from pup.robot import RobotDescription

Array = NDArray[np.float64]
GRIP = 0.5  # s for which a hand still holds a robot whose servos have all got torque


class Plant:
    """Robots that move as their servos are told.

    Args:
      robot: their description.
      characters: one per lane.
    """

    def __init__(self, robot: RobotDescription, characters: Sequence[Character]) -> None:
        self.robot = robot
        self.characters = tuple(characters)
        models = [build(robot, character) for character in characters]
        self.batch = Batch(models[0], len(models), nthread=1)
        self.batch.set_models(models)
        self.qpos, self.qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self._force = self.batch.bind("qfrc_applied")
        joints = [models[0].joint(name) for name in robot.joint_names]
        self.at = _stretch([int(joint.qposadr[0]) for joint in joints])
        self.dofs = _stretch([int(joint.dofadr[0]) for joint in joints])
        gait = robot.gait
        pose = np.zeros(len(joints)) if gait is None or gait.start is None else np.array(gait.start)
        self.start = np.stack([standing(robot, model, pose) for model in models])
        self.drives = Drives(self.characters, len(joints))
        self.imus = Imus(self.characters) if robot.floating else None
        self.steps = 0
        self.ordered = 0  # goals ever given
        self.held = np.zeros(len(models), dtype=bool)
        self._grip = np.zeros(len(models), dtype=int)
        self._late: deque[tuple[int, int, int, float]] = deque()
        self.place(range(len(models)))

    @classmethod
    def of(cls, robot: RobotDescription, seeds: Sequence[int]) -> "Plant":
        """Robots drawn from seeds, one each."""
        pitch = robot.gait.imu_pitch_offset if robot.gait else 0.0
        joints, bodies = len(robot.joints), bodies_of(robot)
        return cls(robot, [draw(seed, joints, bodies, pitch) for seed in seeds])

    @property
    def time(self) -> float:
        """Simulated time, s."""
        return self.steps * STEP

    @property
    def angles(self) -> Array:
        """True angles of the joints, rad, shape (n_lanes, n_joints)."""
        return np.asarray(self.qpos[:, self.at])

    @property
    def speeds(self) -> Array:
        """True speeds of the joints, rad/s, shape (n_lanes, n_joints)."""
        return np.asarray(self.qvel[:, self.dofs])

    def place(self, lanes: Sequence[int], hold: bool = False) -> None:
        """Put robots down at rest in their start pose; what their servos were told stays.

        Args:
          lanes: which robots.
          hold: whether a hand keeps them there until their servos hold them.
        """
        rows = np.array(lanes, dtype=np.intp)
        self.qpos[rows], self.qvel[rows] = self.start[rows], 0.0
        self.drives.rest(rows, self.angles)
        self.held[rows], self._grip[rows] = hold, round(GRIP / STEP)
        if self.imus is not None:
            self.imus.rest(rows, self.qpos, self.qvel)

    def order(self, lane: int, joint: int, goal: float) -> None:
        """Give one servo a goal, ticks; it takes effect after the servo's latency."""
        due = self.steps + round(self.characters[lane].motors.latency / STEP)
        self.ordered += 1
        self._late.append((due, lane, joint, goal))

    def encoders(self) -> Array:
        """What the encoders say now, ticks, shape (n_lanes, n_joints)."""
        return self.drives.read(self.angles)

    def step(self, count: int = 1) -> None:
        """Let some steps of time pass."""
        for _ in range(count):
            while self._late and self._late[0][0] <= self.steps:
                _, lane, joint, goal = self._late.popleft()
                self.drives.orders.goal[lane, joint] = goal
            self._force[:, self.dofs] = self.drives.tick(self.angles, self.speeds)
            self.batch.step()
            self.steps += 1
            if self.steps % HEAT == 0:
                self.drives.heat(HEAT * STEP)
            if self.held.any():
                self._hold()
            if self.imus is not None:
                self.imus.sample(self.steps, self.qpos, self.qvel)

    def _hold(self) -> None:
        """Hands that hold robots: all of a limp one, the torso of a stiff one."""
        power = self.drives.orders.power
        for lane in np.flatnonzero(self.held):
            if not power[lane].any():
                self.qpos[lane], self.qvel[lane] = self.start[lane], 0.0
            elif self.robot.floating:
                self.qpos[lane, :7], self.qvel[lane, :6] = self.start[lane, :7], 0.0
            self._grip[lane] -= int(power[lane].all())
            self.held[lane] = self._grip[lane] > 0


def _stretch(addresses: list[int]) -> slice | list[int]:
    """Addresses as a slice where they are neighbours, which NumPy reads faster."""
    first = addresses[0]
    if addresses == list(range(first, first + len(addresses))):
        return slice(first, first + len(addresses))
    return addresses
