"""The robot as the control loop sees it: its senses, its goals, and being made safe."""

import math
import time

import numpy as np
from numpy.typing import NDArray

from hardware_agent.bus import Answers, Bus
from hardware_agent.config import BusSettings, Settings
from hardware_agent.imu import Orientation, imu_of
from hardware_agent.limits import Applied, Limiter
from hardware_agent.mounting import Mounting
from hardware_agent.port import BusError
from hardware_agent.registers import REGISTERS
from hardware_agent.safety import Guard
from hardware_agent.senses import Response, Senses, Trip
from pup.errors import InputError
from pup.robot import RobotDescription

Array = NDArray[np.float64]

TILT = 1.0  # rad, of a robot without a gait
SILENT = 1.0  # s, after which an IMU or all servos are seen to while the robot is limp
MISSED = 0.01  # rad of a joint's range that nobody misses
DOUBT = 2.0  # s, from which on a servo that does not say that it is limp is a problem


class Body:
    """Bus, IMU and rules of safety together.

    Args:
      settings: of the agent.
      robot: its description, with a servo for every joint.

    Raises:
      InputError: a joint has no servo, or one that is mounted as none of this robot can be, or
        the board has a servo's id.
    """

    def __init__(self, settings: Settings, robot: RobotDescription) -> None:
        self.settings = settings
        self.names = robot.joint_names
        ids = [joint.servo_id for joint in robot.joints]
        if None in ids:
            lacking = self.names[ids.index(None)]
            raise InputError(f"{robot.folder / 'robot.toml'}: joint {lacking!r} has no servo_id")
        self.ids = [number for number in ids if number is not None]
        board = settings.bus.board
        if board and board in self.ids:  # what makes a board give current makes a servo hold
            joint = self.names[self.ids.index(board)]
            raise InputError(f"bus.board: {board} is the servo of {joint}; a CM-740 has 200")
        self.imu = imu_of(settings.imu)
        self._robot = robot
        mountings = _mountings(settings.bus, robot)
        senses = settings.imu.kind == "cm740"
        self.bus = Bus(settings.bus, self.ids, senses, mountings)
        tilt = robot.gait.tilt_limit if robot.gait else TILT
        self.guard = Guard(settings.safety, tilt, _gain(settings.bus))
        self._limit()
        self.torque = self.ready = False
        self.repeated = self.lost = 0
        self._forget()

    def _limit(self) -> list[str]:
        """Keep targets where the servos take them; tells what these hold back, and who is weak."""
        reach, (lower, upper) = self.bus.reach, self._robot.limits
        self.limiter = Limiter(self.names, *_reached(self._robot, reach), self.settings.safety)
        ranges = [
            f"servo {self.ids[j]} takes {self.names[j]} from {low:.2f} to {high:.2f} rad only"
            for j, (low, high) in enumerate(reach)
            if low > lower[j] + MISSED or high < upper[j] - MISSED
        ]
        weak = [
            f"servo {self.ids[j]} gives {self.names[j]} {share:.0%} of its power at most"
            for j, share in enumerate(self.bus.strength)
            if share < 1
        ]
        return ranges + weak

    def _forget(self) -> None:
        n = len(self.names)
        self._known = {
            kind: np.full(n, math.nan)
            for kind in ("position", "velocity", "load", "voltage", "temperature")
        }
        self._seen = np.full(n, -math.inf)
        self._imu: Orientation | None = None
        self._imu_seen = self._mended = self._sensed = self._lit = -math.inf
        self._written = -math.inf
        self.goal = np.full(n, math.nan)
        self._doubt()

    def _doubt(self) -> None:
        """Any servo may hold."""
        self._doubted = set(range(len(self.names)))
        self._limp_since = time.monotonic()

    def open(self) -> list[str]:
        """Take the bus and the IMU; the servos are limp afterwards.

        Returns:
          What was put right in the servos, how far they go where that is not all of a joint's
          range, and who has not all of its power.

        Raises:
          BusError: something does not answer.
          InputError: something else is there than was configured, or a servo does not take its
            joint's angles.
        """
        self.torque = self.ready = False
        self._forget()
        told = self.bus.open() + self._limit()
        if self.imu is not None:
            self.imu.close()
            self.imu.open()
        self.ready = True
        return told

    def close(self) -> None:
        """Give everything up, limp."""
        self.limp()
        self.bus.close()
        if self.imu is not None:
            self.imu.close()

    def sense(self, now: float, walking: bool, alone: bool) -> Senses:
        """Ask all sensors.

        Args:
          now: of the tick, s.
          walking: whether a rollout is under way.
          alone: whether the robot is on its own feet.

        Raises:
          BusError: the bus or the IMU is gone.
        """
        lockstep = self.settings.control.clock == "lockstep"
        if self.imu is not None and not lockstep:
            self.imu.ask()
        answers = self.bus.read()
        alarms = self._take(answers, now)
        if self.imu is not None:
            if lockstep:  # only now it is sure that what the bus was told before has passed
                self.imu.ask()
            sample = self.imu.take(answers.board, now)
            if sample is not None:
                self._imu, self._imu_seen = sample, now
        return Senses(
            time=now,
            names=self.names,
            **{kind: values.copy() for kind, values in self._known.items()},
            alarms=alarms,
            seen=self._seen.copy(),
            imu=self._imu,
            imu_seen=self._imu_seen,
            has_imu=self.imu is not None,
            goal=self.goal,
            written=self._written,
            walking=walking,
            alone=alone,
        )

    def _take(self, answers: Answers, now: float) -> dict[str, str]:
        """Keep what the servos told; returns their complaints."""
        self.repeated += answers.tries - 1
        self.lost += len(self.ids) - len(answers.servos)
        alarms = {}
        for j, number in enumerate(self.ids):
            status = answers.servos.get(number)
            if status is None:
                continue
            if not self.torque and self._seen[j] < self._sensed:
                self._doubted.add(j)  # it was away, and did not hear that it shall be limp
            self._seen[j] = now
            for kind, values in self._known.items():
                told = getattr(status, kind)
                if told is not None:
                    values[j] = told
            if status.alarm:
                alarms[self.names[j]] = self.bus.alarm(number) or status.alarm
        self._sensed = now
        return alarms

    def enable(self, senses: Senses) -> Trip | None:
        """Let the servos hold the pose that they are in.

        Returns:
          Why not, if so.
        """
        stale = senses.time - senses.seen > self.settings.safety.stale
        blind = senses.has_imu and senses.time - senses.imu_seen > self.settings.safety.stale
        if stale.any() or np.isnan(senses.position).any() or blind:
            silent = ", ".join(self.names[j] for j in np.flatnonzero(stale)[:3]) or "the IMU"
            return Trip("enable", f"the pose is not known: {silent} does not answer")
        if beyond := self._beyond(senses.position):
            return Trip("enable", beyond)
        self.guard.reset()
        self._doubt()  # from here on, whatever comes of it; some come on by a goal alone
        self.goal, self._written = senses.position.copy(), senses.time
        untaken = self.bus.prepare(self.goal, self.settings.safety.late)
        if untaken:
            self.limp()
            told = [f"{self.names[self.ids.index(n)]} {what}" for n, what in untaken.items()]
            more = f" and {len(told) - 3} more" if len(told) > 3 else ""
            return Trip("enable", f"not taken: {', '.join(told[:3])}{more}")
        self.bus.torque(True)
        self.torque = True
        self._doubted.clear()
        return None

    def _beyond(self, position: Array) -> str:
        """Which joint is where its servo cannot be told to stay, in words; empty for none.

        It would go to the end of what the servo takes, at once and at full speed.
        """
        least, largest = self.bus.reach.T
        for j in np.flatnonzero((position < least - MISSED) | (position > largest + MISSED)):
            return (
                f"{self.names[j]} is at {position[j]:.2f} rad, and servo {self.ids[j]} takes "
                f"{least[j]:.2f} to {largest[j]:.2f} rad only; turn it back by hand"
            )
        return ""

    def command(self, target: Array, now: float) -> Applied | Trip:
        """Send a target, as far as the limits let it.

        Args:
          target: rad, shape (n_joints,).
          now: of the tick, s.
        """
        applied = self.limiter.apply(target, self.goal, 1 / self.settings.control.rate)
        if isinstance(applied, Applied):
            self.bus.write(applied.goal)
            self.goal, self._written = applied.goal, now
        return applied

    def full_power(self) -> None:
        """End the softness of a fallen robot."""
        self.bus.soften(1.0)

    def make_safe(self, response: Response, senses: Senses | None, now: float) -> None:
        """Make the robot safe; whatever happens, it is not left as it is.

        Args:
          response: how.
          senses: of the tick; without them a robot is made limp.
          now: s.
        """
        if response is Response.SOFT and senses is not None and self.torque:
            try:
                self.bus.soften(self.settings.safety.fallen_power)
                self.goal, self._written = senses.position.copy(), now
                self.bus.write(self.goal)
                return
            except (BusError, ValueError):  # a position that is not known is no goal
                pass
        self.limp()

    @property
    def doubted(self) -> bool:
        """Whether a servo may still hold, though all shall be limp."""
        return bool(self._doubted)

    @property
    def long_doubted(self) -> tuple[str, ...]:
        """Joints of those that have not told of it for long."""
        if self.torque or time.monotonic() - self._limp_since < DOUBT:
            return ()
        return tuple(self.names[j] for j in sorted(self._doubted))

    def confirm_limp(self, senses: Senses) -> None:
        """Ask one servo a tick whether it is limp, and tell all once more where it is not.

        Torque off is told by packets that nobody answers: noise may have spoilt them, and a servo
        whose cable was out has never got them.

        Raises:
          BusError: the bus is gone.
        """
        there = [j for j in sorted(self._doubted) if senses.seen[j] == senses.time]
        if not there:
            return
        holds = self.bus.torque_enabled(self.ids[there[0]])
        if holds:
            self.bus.torque(False)
        elif holds is not None:
            self._doubted.discard(there[0])

    def mend(self, senses: Senses) -> None:
        """Set an IMU up anew that is silent: its supply may have broken down and reset it.

        Only while the robot is known to be limp: it takes longer than a tick.

        Raises:
          BusError: its port is gone.
        """
        if self.imu is None or self.doubted:
            return
        if senses.time - max(senses.imu_seen, self._mended) > SILENT:
            self._mended = senses.time
            self.imu.configure()

    def dark(self, senses: Senses) -> bool:
        """Whether the servos of a limp robot have no current, for the board was reset.

        Opening the body anew switches it on. The board is asked where all servos are silent.

        Raises:
          BusError: the bus is gone.
        """
        if senses.time - max(float(senses.seen.max()), self._lit) <= SILENT:
            return False
        self._lit = senses.time
        return self.bus.dark()

    def limp(self) -> bool:
        """Torque off; False when the bus does not take it.

        Told again, it doubts no servo that has said so since: a stop may be sent twice a second.
        """
        if self.torque:
            self._doubt()
        self.torque = False
        try:
            self.bus.torque(False)
        except BusError:
            return False
        return True


def _gain(settings: BusSettings) -> float:
    """The servos' P gain as a share of the paper's."""
    return settings.gains[0] / REGISTERS[settings.protocol].paper[0] if settings.gains else 1.0


def _mountings(settings: BusSettings, robot: RobotDescription) -> list[Mounting]:
    """How the servo of each joint is mounted, in the order of the joints."""
    for name in settings.joints:
        if name not in robot.joint_names:
            known = ", ".join(robot.joint_names)
            raise InputError(
                f"bus.joints.{name}: robot {robot.name!r} has no such joint; it has {known}"
            )
    return [settings.joints.get(name, Mounting()) for name in robot.joint_names]


def _reached(robot: RobotDescription, reach: Array) -> tuple[Array, Array]:
    """The joints' ranges as far as their servos reach, rad.

    A target beyond that is held back here already: so the recording tells what the servo was told.
    """
    lower, upper = robot.limits
    least, largest = np.maximum(lower, reach[:, 0]), np.minimum(upper, reach[:, 1])
    for j in np.flatnonzero(least >= largest):
        raise InputError(
            f"bus.joints.{robot.joint_names[j]}: the servo reaches {reach[j, 0]:.2f} to "
            f"{reach[j, 1]:.2f} rad only, the joint's range is {lower[j]:.2f} to {upper[j]:.2f}"
        )
    return least, largest
