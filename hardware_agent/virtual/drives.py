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

from hardware_agent.virtual import kernels
from hardware_agent.virtual.character import Character
from hardware_agent.virtual.skeleton import STEP

Array = NDArray[np.float64]

TICK = 2 * np.pi / 4096  # rad
CENTRE = 2048  # ticks at an angle of 0
NOMINAL = 12.0  # V, of the motors' constants
EMPTY, FULL = 9.9, 12.6  # V of three cells
SETTLING = STEP / 0.003  # per tick, of the supply with its capacitors
IDLE = 0.1  # A that a servo draws anyway
AMBIENT = 25.0  # degrees C
COPPER = 0.0039  # resistance of a winding per K
WINDING, CASE = 4.0, 70.0  # J/K
AIRED = 0.12  # W/K from the case to the air
HEAT = 20  # ticks between updates of the temperatures
LARGE = 1e12


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
            told = np.array([np.atleast_1d(getattr(motor, name)) for motor in motors], dtype=float)
            return np.broadcast_to(told, self.shape).copy()

        self.zero = each("bias") / TICK + CENTRE
        self._gain, self._damping = each("gain") * TICK, each("damping") / STEP
        self._clip = each("clip")
        self._cold = each("stall") / NOMINAL  # N m/V
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
        self._capacity = np.array([[s.capacity * 3600.0] for s in supplies])  # A s
        self.fresh = np.array([[s.charge] for s in supplies])
        self.charge = self.fresh.copy()
        self.drawn = np.zeros((lanes, 1))
        self.refresh()
        self.volts = self._open.copy()

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

    def engage(self, place: tuple[int, int], ticks: float) -> None:
        """Begin to regulate: a limited goal sets out from where the servo is.

        Args:
          place: lane and joint.
          ticks: what its encoder says.
        """
        self.moving.goal[place], self.moving.pace[place], self.moving.built[place] = ticks, 0.0, 0.0

    def read(self, angle: Array) -> Array:
        """What the encoders say of the joints' angles, rad: ticks."""
        ticks = np.rint(angle * (1 / TICK) + self.zero)
        for place, kept in self.stuck.items():
            ticks[place] = kept
        return ticks

    def order(self, what: str, place: tuple[int, int], value: float) -> None:
        """Change what the registers of one servo say.

        Args:
          what: name of a field of Orders.
          place: lane and joint.
          value: the new one.
        """
        getattr(self.orders, what)[place] = value
        self.refresh()

    def refresh(self) -> None:
        """Derive what follows from the orders, the temperatures and the charge."""
        orders = self.orders
        hot = 1 + COPPER * (self.winding - AMBIENT)
        self._strength = orders.power * self._cold / hot  # N m/V
        self._brake = self._strength * self._back  # N m s/rad
        self._p = self._gain * orders.kp
        self._d = self._gain * orders.kd * self._damping
        self.most = self._clip * orders.limit
        self._open = EMPTY + (FULL - EMPTY) * self.charge
        self._open -= self._resistance * IDLE * self.joints
        self._shaped = bool(np.isfinite([orders.speed, orders.acceleration]).any())

    def tick(self, angle: Array, speed: Array) -> Array:
        """One loop of the firmware and the motors.

        Args:
          angle: of the joints, rad.
          speed: rad/s.

        Returns:
          Torques on the links, N m.
        """
        now, orders = self.moving, self.orders
        if self._shaped:
            self._shape_goal()
        else:
            np.copyto(now.goal, orders.goal)
        kernels.command(
            *(now.duty, now.seen, now.trend, now.built, self.read(angle), now.goal),
            *(self._p, orders.ki, self._d, self._gain, self.most, orders.power, STEP),
        )
        kernels.gear(
            *(now.drive, now.torque, now.rotor, now.lash, now.bristle, self.drawn),
            *(now.duty, self.volts, speed, self._strength, self._brake, self._kinetic),
            *(self._static, self._stribeck, self._loaded, self._viscous, self._grip),
            *(self._kick, self._play, self._amperes, STEP),
        )
        self.volts += SETTLING * (self._open - self._resistance * self.drawn - self.volts)
        return now.torque

    def _shape_goal(self) -> None:
        """Move the goals that the firmware holds at the speed and acceleration asked for."""
        now, orders = self.moving, self.orders
        way = orders.goal - now.goal
        at_once = np.isinf(orders.speed)
        change = np.minimum(orders.acceleration * STEP, LARGE)
        braking = np.sqrt(2 * np.minimum(orders.acceleration, LARGE) * np.abs(way))
        fastest = np.minimum(np.minimum(orders.speed, braking), np.abs(way) / STEP)
        wanted = np.sign(way) * fastest
        now.pace = np.where(at_once, 0.0, now.pace + np.clip(wanted - now.pace, -change, change))
        now.goal = np.where(at_once, orders.goal, now.goal + STEP * now.pace)

    def cool(self) -> None:
        """Everything is as warm as the room."""
        self.winding[:] = self.case[:] = AMBIENT
        self.refresh()

    def renew(self) -> None:
        """Motors are cold and batteries as at first; registers stay."""
        self.charge = self.fresh.copy()
        self.drawn = np.zeros_like(self.drawn)
        self.cool()
        self.volts = self._open.copy()

    def heat(self, time: float) -> None:
        """Warm windings and cases up, and drain the battery.

        Args:
          time: since the last call, s.
        """
        current = self.moving.drive * self._amperes
        hot = self._ohm * (1 + COPPER * (self.winding - AMBIENT))
        through = (self.winding - self.case) * self._warmth
        self.winding += time / WINDING * (hot * current**2 - through)
        self.case += time / CASE * (through - AIRED * (self.case - AMBIENT))
        self.charge -= time * (self.drawn + IDLE * self.joints) / self._capacity
        self.refresh()
