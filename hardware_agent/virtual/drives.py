"""The servos' insides, tick by tick: firmware, motor, gear and supply.

The firmware compares ticks and commands a duty cycle; the motor's back-EMF takes its share; the
gear has dry friction with a presliding range, and play, in which the rotor runs free of the link;
all servos draw on one battery; windings and cases warm up. Arrays are of shape (n_lanes, n_joints),
those of a whole robot (n_lanes, 1).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from hardware_agent.virtual.character import Character
from hardware_agent.virtual.skeleton import STEP

Array = NDArray[np.float64]

TICK = 2 * np.pi / 4096  # rad
CENTRE = 2048  # ticks at an angle of 0
NOMINAL = 12.0  # V, of the motors' constants
EMPTY, FULL = 9.9, 12.6  # V of three cells
BUFFER = 0.003  # s, of the capacitors at the servos' supply
IDLE = 0.1  # A that a servo draws anyway
AMBIENT = 25.0  # degrees C
COPPER = 0.0039  # resistance of a winding per K
WINDING, CASE = 4.0, 70.0  # J/K
AIRED = 0.12  # W/K from the case to the air
HEAT = 20  # ticks between updates of the temperatures
BUILT_UP = 10.0  # the most that the integral part counts for, as an error in ticks x P
FILTER = 0.5  # share of a new sample in the speed that the D gain sees


@dataclass
class Orders:
    """What the registers of the servos say.

    Attributes:
      goal: ticks.
      power: 1 where torque is on, else 0.
      limit: share of the duty that may be used.
      kp: the P gain in units of Protocol 1.0.
      ki: P per s.
      kd: P s.
      speed: limit of the goal's motion, ticks/s; infinite for none.
      acceleration: of the goal's motion, ticks/s2; infinite for no limit.
    """

    goal: Array
    power: Array
    limit: Array
    kp: Array
    ki: Array
    kd: Array
    speed: Array
    acceleration: Array

    @classmethod
    def blank(cls, shape: tuple[int, int]) -> "Orders":
        """Torque off, gains from the factory."""
        values = (CENTRE, 0.0, 1.0, 32.0, 0.0, 0.0, np.inf, np.inf)
        return cls(*(np.full(shape, float(value)) for value in values))


@dataclass
class Moving:
    """What moves inside the servos.

    Attributes:
      seen: ticks in the last loop of the firmware.
      trend: their filtered change per loop.
      built: of the integral part.
      goal: that the firmware holds now, ticks.
      pace: at which it moves, ticks/s.
      duty: -1 to 1.
      rotor: speed of the rotor at the joint, rad/s.
      lash: by which the rotor is ahead of the link, rad.
      bristle: dry friction, N m.
      torque: on the link, N m.
      drive: torque of the motor before the gear, N m.
    """

    seen: Array
    trend: Array
    built: Array
    goal: Array
    pace: Array
    duty: Array
    rotor: Array
    lash: Array
    bristle: Array
    torque: Array
    drive: Array

    @classmethod
    def still(cls, shape: tuple[int, int]) -> "Moving":
        """Nothing moves."""
        return cls(*(np.zeros(shape) for _ in fields(cls)))


@dataclass
class Drives:
    """The servos of some robots.

    Args:
      characters: of the robots.
      joints: servos of each.
    """

    characters: Sequence[Character]
    joints: int
    orders: Orders = field(init=False)
    moving: Moving = field(init=False)
    stuck: dict[tuple[int, int], float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        lanes = len(self.characters)
        self.shape = (lanes, self.joints)
        self.orders, self.moving = Orders.blank(self.shape), Moving.still(self.shape)
        self.winding = np.full(self.shape, AMBIENT)
        self.case = np.full(self.shape, AMBIENT)
        motors = [character.motors for character in self.characters]

        def each(name: str) -> Array:
            return np.array([np.atleast_1d(getattr(motor, name)) for motor in motors])

        self.zero = each("bias") / TICK + CENTRE
        self._gain, self._damping = each("gain") * TICK, each("damping") / STEP
        self._clip = each("clip")
        self._cold = each("stall") / NOMINAL  # N m/V
        self._strength = self._cold.copy()
        self._back = NOMINAL / each("free_speed")  # V s/rad
        self._amperes = each("current") / each("stall")  # A/(N m)
        self._ohm = NOMINAL / each("current")
        self._kinetic = each("dry") * each("kinetic")
        self._static = each("dry") - self._kinetic
        self._stribeck = -1 / each("stribeck")
        self._loaded, self._viscous = each("loaded"), each("viscous")
        self._grip = each("dry") / each("give") * STEP  # N m s/rad
        self._kick, self._play = STEP / each("rotor"), each("play")
        self._warmth = 1 / each("warmth")
        supplies = [character.supply for character in self.characters]
        self._resistance = np.array([[s.resistance] for s in supplies])
        self._drain = STEP / np.array([[s.capacity * 3600.0] for s in supplies])  # 1/A
        self.fresh = np.array([[s.charge] for s in supplies])
        self.charge = self.fresh.copy()
        self.volts = EMPTY + (FULL - EMPTY) * self.charge

    def rest(self, rows: NDArray[np.intp], angle: Array) -> None:
        """Stop what moves in some lanes; goals and temperatures stay.

        Args:
          rows: the lanes.
          angle: of all joints, rad.
        """
        for part in fields(Moving):
            getattr(self.moving, part.name)[rows] = 0.0
        self.moving.seen[rows] = self.read(angle)[rows]
        self.moving.goal[rows] = self.orders.goal[rows]

    def read(self, angle: Array) -> Array:
        """What the encoders say of the joints' angles, rad: ticks."""
        ticks = np.rint(angle * (1 / TICK) + self.zero)
        for place, kept in self.stuck.items():
            ticks[place] = kept
        return ticks

    def tick(self, angle: Array, speed: Array) -> Array:
        """One loop of the firmware and the motors.

        Args:
          angle: of the joints, rad.
          speed: rad/s.

        Returns:
          Torques on the links, N m.
        """
        self._command(self.read(angle))
        self._gear(speed)
        self._supply()
        return self.moving.torque

    def _command(self, ticks: Array) -> None:
        """The firmware: from ticks to duty."""
        now, orders = self.moving, self.orders
        self._advance_goal()
        error = now.goal - ticks
        now.trend += FILTER * (ticks - now.seen - now.trend)
        now.seen = ticks
        wanted = orders.kp * error - orders.kd * self._damping * now.trend
        if orders.ki.any():
            now.built += STEP * orders.ki * error * orders.power
            bound = BUILT_UP * CENTRE
            np.clip(now.built, -bound, bound, out=now.built)
            wanted += now.built
        most = self.most
        duty = np.minimum(np.maximum(self._gain * wanted, -most), most)
        now.duty = duty * orders.power

    def _advance_goal(self) -> None:
        """Move the goals that the firmware holds, at the speed that was asked for."""
        now, orders = self.moving, self.orders
        if np.isinf(orders.speed.min()):
            now.goal = orders.goal
            return
        way = orders.goal - now.goal
        braking = np.sqrt(2 * np.minimum(orders.acceleration, 1e12) * np.abs(way))
        wanted = np.sign(way) * np.minimum(np.minimum(orders.speed, np.abs(way) / STEP), braking)
        change = np.minimum(orders.acceleration * STEP, 1e12)
        now.pace = now.pace + np.clip(wanted - now.pace, -change, change)
        now.goal = now.goal + STEP * np.where(np.isinf(orders.speed), way / STEP, now.pace)

    def _gear(self, speed: Array) -> None:
        """Motor, friction and play: from duty to the torque on the link."""
        now = self.moving
        rotor = now.rotor
        current = (now.duty * self.volts - self._back * rotor) * self.orders.power
        now.drive = self._strength * current
        level = self._kinetic + self._static * np.exp(np.abs(rotor) * self._stribeck)
        level += self._loaded * np.abs(now.torque)
        now.bristle = np.minimum(np.maximum(now.bristle + self._grip * rotor, -level), level)
        net = now.drive - now.bristle - self._viscous * rotor
        forward = np.where(now.lash >= self._play, np.maximum(net, 0.0), 0.0)
        backward = np.where(now.lash <= -self._play, np.minimum(net, 0.0), 0.0)
        now.torque = forward + backward
        now.rotor = np.where(now.torque == 0.0, rotor + self._kick * net, speed)
        lash = now.lash + STEP * (now.rotor - speed)
        now.lash = np.minimum(np.maximum(lash, -self._play), self._play)

    def _supply(self) -> None:
        """The battery sags under what the servos draw, and drains."""
        drawn = (self.moving.duty * self.moving.drive * self._amperes).sum(axis=1, keepdims=True)
        drawn += IDLE * self.joints
        self.charge -= self._drain * drawn
        open_circuit = EMPTY + (FULL - EMPTY) * self.charge
        self.volts += STEP / BUFFER * (open_circuit - self._resistance * drawn - self.volts)

    @property
    def most(self) -> Array:
        """The duty that each servo may use."""
        return self._clip * self.orders.limit

    def cool(self) -> None:
        """Everything is as warm as the room."""
        self.winding[:] = self.case[:] = AMBIENT
        self._strength = self._cold.copy()

    def heat(self, time: float) -> None:
        """Warm windings and cases up.

        Args:
          time: since the last call, s.
        """
        current = self.moving.drive * self._amperes
        hot = self._ohm * (1 + COPPER * (self.winding - AMBIENT))
        through = (self.winding - self.case) * self._warmth
        self.winding += time / WINDING * (hot * current**2 - through)
        self.case += time / CASE * (through - AIRED * (self.case - AMBIENT))
        self._strength = self._cold / (1 + COPPER * (self.winding - AMBIENT))
