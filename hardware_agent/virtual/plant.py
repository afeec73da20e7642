"""Robots in motion: their servos at 1 kHz on MuJoCo's bodies.

Robots stand side by side as lanes of one batch, so that an experiment runs many at the price of
few; what hangs on a bus is one lane. Joint vectors are in the robot's order.
"""

from collections import deque
from collections.abc import Sequence
from enum import IntEnum

import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from hardware_agent.virtual.character import Character, draw
from hardware_agent.virtual.drives import HEAT, Drives
from hardware_agent.virtual.imu import EVERY, Imus
from hardware_agent.virtual.skeleton import STEP, bodies_of, build, standing
from pup.robot import RobotDescription

Array = NDArray[np.float64]
Joints = int | slice
HEIGHT = 0.5  # m by which a robot hangs higher than it stands
BEAT = 20  # steps after which all that happens every so many steps is in step again
STILL = 0.3  # rad/s below which all joints count as still
GRIP, TIRED = 0.5, 2.0  # s of a stiff and still robot, and of a stiff one, until a hand lets go


class Hold(IntEnum):
    """How a robot is held.

    NOT: it stands or lies by itself.
    HAND: a hand keeps it in its start pose until it has been stiff and still for a moment.
    ROPE: it hangs in the air by its torso.
    """

    NOT = 0
    HAND = 1
    ROPE = 2


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
        self._warmstart = self.batch.bind("qacc_warmstart")
        if robot.floating:
            self._welds = self.batch.bind("eq_active")
            self._hand, self._palm = self.batch.bind("mocap_pos"), self.batch.bind("mocap_quat")
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
        self.held = np.full(len(models), Hold.NOT)
        self._stiff, self._still = np.zeros((2, len(models)))
        self._late: list[deque[tuple[int, Joints, float | Array]]] = [deque() for _ in models]
        self.place(range(len(models)))

    @classmethod
    def of(cls, robot: RobotDescription, seeds: Sequence[int]) -> "Plant":
        """Robots drawn from seeds, one each."""
        joints, bodies = len(robot.joints), bodies_of(robot)
        return cls(robot, [draw(seed, joints, bodies) for seed in seeds])

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

    def place(self, lanes: Sequence[int], hold: Hold = Hold.NOT) -> None:
        """Put robots down at rest in their start pose; what their servos were told stays.

        Args:
          lanes: which robots.
          hold: how they are held there.
        """
        rows = np.array(lanes, dtype=np.intp)
        self.qpos[rows], self.qvel[rows] = self.start[rows], 0.0
        if self.robot.floating:
            self.qpos[rows, 2] += HEIGHT * (hold is Hold.ROPE)
            self._hand[rows, 0] = self.qpos[rows, :3]
            self._palm[rows, 0] = self.qpos[rows, 3:7]
        self._read = -1
        self.drives.rest(rows, self.angles)
        self._hold(rows, hold)
        self._stiff[rows] = self._still[rows] = 0.0
        if self.imus is not None:
            self.imus.rest(rows, self.qpos, self.qvel)

    def renew(self, number: int) -> None:
        """Leave nothing of the past but what registers say: full batteries, cold motors.

        Args:
          number: that the noise of what comes is drawn from, beside the robots' seeds.
        """
        self.steps += -self.steps % BEAT
        for lane, late in enumerate(self._late):
            for _, joints, goal in late:
                self.drives.orders.goal[lane, joints] = goal
            late.clear()
        self._warmstart[:] = 0.0
        self.drives.renew()
        if self.imus is not None:
            self.imus.renew(number)

    def release(self, lane: int) -> None:
        """Let go of a robot that is held."""
        self._hold(np.array([lane]), Hold.NOT)

    def order(self, lane: int, joints: Joints, goal: float | Array) -> None:
        """Give servos a goal; it takes effect after their latency.

        Args:
          lane: of which robot.
          joints: which of them, or all.
          goal: ticks.
        """
        due = self.steps + round(self.characters[lane].motors.latency / STEP)
        self.ordered += 1
        self._late[lane].append((due, joints, goal))

    def encoders(self) -> Array:
        """What the encoders say now, ticks, shape (n_lanes, n_joints)."""
        if self._read != self.steps:
            self._read, self._ticks = self.steps, self.drives.read(self.angles)
        return self._ticks

    def step(self, count: int = 1) -> None:
        """Let some steps of time pass."""
        for _ in range(count):
            for lane, late in enumerate(self._late):
                while late and late[0][0] <= self.steps:
                    _, joints, goal = late.popleft()
                    self.drives.orders.goal[lane, joints] = goal
            self._force[:, self.dofs] = self.drives.tick(self.angles, self.speeds)
            self.batch.step()
            self.steps += 1
            if self.steps % HEAT == 0:
                self.drives.heat(HEAT * STEP)
            if self._by_hand:
                self._feel()
            if self.imus is not None and self.steps % EVERY == 0:
                self.imus.sample(self.qpos, self.qvel)

    def _hold(self, rows: NDArray[np.intp], hold: Hold) -> None:
        self.held[rows] = hold
        if self.robot.floating:
            self._welds[rows, 0] = float(hold is not Hold.NOT)
        self._by_hand = bool((self.held == Hold.HAND).any())

    def _feel(self) -> None:
        """Hands keep all of a limp robot in place, and let go of one that is stiff."""
        power = self.drives.orders.power
        for lane in np.flatnonzero(self.held == Hold.HAND):
            if not power[lane].any():
                self.qpos[lane], self.qvel[lane] = self.start[lane], 0.0
            if power[lane].all():
                still = np.abs(self.speeds[lane]).max() < STILL
                self._stiff[lane] += STEP
                self._still[lane] = self._still[lane] + STEP if still else 0.0
            if self._still[lane] > GRIP or self._stiff[lane] > TIRED:
                self.release(int(lane))


def _stretch(addresses: list[int]) -> slice | list[int]:
    """Addresses as a slice where they are neighbours, which NumPy reads faster."""
    first = addresses[0]
    if addresses == list(range(first, first + len(addresses))):
        return slice(first, first + len(addresses))
    return addresses
