"""What a physics term is: an effect the nominal model leaves out, with continuous parameters.

A term's magnitudes are zero in the nominal model, and at zero it changes no bit of a simulation.
Its shapes (a speed, an angle, a number of teeth) say how it acts when it does, and mean nothing at
zero. A term acts on a batch of simulations at once, at any of its places, through the hooks of
`Term`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray

from pup.physics.model import Model
from pup.physics.writer import FieldWriter
from pup.robot import RobotDescription
from pup.robot_parts import PlaceKind

Array = NDArray[np.float64]
Kind = PlaceKind
Parts = tuple[Array, ...]


@dataclass(frozen=True)
class Quantity:
    """One parameter of a term.

    Attributes:
      name: such as `torque`.
      unit: its unit; `1` for a plain number.
      typical: size of a magnitude that a lab meets, or the usual value of a shape.
      limit: largest size to try; a signed quantity is tried down to its negative.
      signed: whether it may be negative.
      grid: values of a shape among which a first search chooses; empty for a magnitude.
    """

    name: str
    unit: str
    typical: float
    limit: float
    signed: bool = False
    grid: tuple[float, ...] = ()

    @property
    def shape(self) -> bool:
        """Whether it only says how the term acts, not how much."""
        return bool(self.grid)

    @property
    def nominal(self) -> float:
        """Its value in the nominal model."""
        return self.typical if self.shape else 0.0

    @property
    def lower(self) -> float:
        """Smallest value to try."""
        if self.signed:
            return -self.limit
        return min(self.grid) / 3 if self.shape else 0.0


@dataclass(frozen=True)
class Scene:
    """What the terms of one batch know of their simulations; those that change it do in `fields`.

    Attributes:
      robot: the robot.
      model: its compiled model.
      timestep: sub-step, s; where simulations have one each, shape (n_simulations, 1), and all of
        them are always active.
      inertia: what each servo moves in the model's own pose, kg m²; like the others of shape
        (n_simulations, n_joints).
      armature: the rotors' share of it, kg m².
      limit: largest torque of the servos, N m.
    """

    robot: RobotDescription
    model: Model
    timestep: float | Array
    inertia: Array
    armature: Array
    limit: Array

    def steps(self) -> Array:
        """The sub-step of each simulation, shape (n_simulations, 1), s."""
        return np.ones((len(self.inertia), 1)) * self.timestep

    def renew(self, rows: NDArray[np.int64], other: "Scene") -> None:
        """Give some simulations what another scene, which has one row for each, says.

        The limit is the torque law's and changes with it.
        """
        self.inertia[rows], self.armature[rows] = other.inertia, other.armature
        np.asarray(self.timestep)[rows] = other.timestep


@dataclass
class Drive:
    """A servo's static law in the making; arrays of shape (n_active, n_joints).

    Attributes:
      error: target minus sensed position, rad.
      velocity: sensed, rad/s.
      torque: of the proportional part, N m.
      damping: against the velocity, off the limits, N m s/rad.
      upper: largest torque of the servo, N m.
      lower: smallest one.
      slope: by how much both limits fall with the velocity, N m s/rad; it holds for the velocity
        at the sub-step's end.
    """

    error: Array
    velocity: Array
    torque: Array
    damping: Array
    upper: Array
    lower: Array
    slope: Array


@dataclass
class Flow:
    """A torque on its way from the servo to the link; arrays of shape (n_active, n_joints).

    What it moves is the motor at first, and the link from where motors of their own engage it.

    Attributes:
      time: since the recording's start, s, negative while a robot settles before it; or since each
        simulation's own, shape (n_active, 1).
      position: of the link, rad.
      link: its velocity, rad/s.
      angle: of what the torque moves, rad.
      velocity: of what the torque moves, rad/s.
      coming: what it will be at the sub-step's end if it goes on as it did, rad/s.
      law_damping: the servo's damping off its torque limit, N m s/rad; only where a term asks.
      torque: applied as it is, N m.
      damping: applied times the velocity at the sub-step's end, N m s/rad.
      brake: against the torque, by damping outside the servo, N m.
      viscous: the part of that damping applied times the velocity at the end, N m s/rad.
    """

    time: float | Array
    position: Array
    link: Array
    angle: Array
    velocity: Array
    coming: Array
    law_damping: Array | None
    torque: Array
    damping: Array
    brake: Array
    viscous: Array

    def carried(self) -> Array:
        """The torque that is applied, N m: damping is, by the velocity at the end."""
        return self.torque - self.damping * self.coming


@dataclass(frozen=True)
class Outcome:
    """What a sub-step has come to at the servos.

    Attributes:
      time: see Flow.
      error: the controller's, (n_active, n_joints), rad.
      torque: of the servo, same shape, N m.
      on: share of the sub-step with the torque on, broadcastable to them.
    """

    time: float | Array
    error: Array
    torque: Array
    on: float | Array


class Term:
    """An omitted effect, bound to the simulations of one batch.

    Attributes:
      effect: its name, of docs/physics.md.
      kinds: places it can act at.
      quantities: its parameters, magnitudes first.
      source: where the typical sizes come from.
      layout: what the columns of the values are: the joints, the joints that carry a body, the
        model's bodies, the feet and the floor, or one for all.
      constant: whether it is a number that the robot has, as a mass or a delay, and not a law whose
        real form may be another.
      starts: sizes, in typical ones, from which a fit may find others of its minima than from
        where slopes lead: what bounces has one at many a stiffness.
      one_way: whether a negative size is no opposite of a positive one, as a brake of one direction
        is none of the other's.
      telling: shapes that tell it from other forms of its class: at an end of their range it does
        as one of those does.
      least: share of its typical size below which it is another thing, whatever it explains: what
        gives way as a spring does is no stop.
      rarity: logarithm of how much rarer it is than others of its class: of two laws that explain
        as much, the usual one is meant.
      needs_law_damping: whether it needs `Flow.law_damping`.
      state: attributes that carry over from sub-step to sub-step, rows of simulations; NaN where
        one has just started and a first sub-step says what they begin with.

    Args:
      values: each quantity, shape (n_simulations, n_places), see `layout`.
      scene: what it acts on.
    """

    effect: ClassVar[str]
    kinds: ClassVar[tuple[Kind, ...]] = ("joint", "group", "robot")
    quantities: ClassVar[tuple[Quantity, ...]]
    source: ClassVar[str]
    layout: ClassVar[Literal["joints", "carried", "bodies", "feet", "one"]] = "joints"
    constant: ClassVar[bool] = False
    starts: ClassVar[tuple[float, ...]] = ()
    one_way: ClassVar[bool] = False
    telling: ClassVar[tuple[str, ...]] = ()
    least: ClassVar[float] = 0.0
    rarity: ClassVar[float] = 0.0
    needs_law_damping: ClassVar[bool] = False
    state: ClassVar[tuple[str, ...]] = ()

    def __init__(self, values: Mapping[str, Array], scene: Scene) -> None:
        self.values = values
        self.scene = scene
        self.prepare()

    def prepare(self) -> None:
        """Make the term's state."""

    def renew(self, rows: NDArray[np.int64], other: Self) -> None:
        """Give some simulations the values and the state of another term, one row for each."""
        for name, theirs in vars(other).items():
            own = getattr(self, name)
            if isinstance(own, np.ndarray):
                own[rows] = theirs
        for name, values in other.values.items():
            self.values[name][rows] = values

    def fields(self, writer: FieldWriter) -> None:
        """Write model fields."""

    def start(self, position: Array, torso: Array) -> None:
        """Change, in place, the start from what was read to what was.

        Args:
          position: of the joints, (n_simulations, n_joints), rad.
          torso: its orientation by the IMU, (n_simulations, 4); NaN where none was read.
        """

    # The hooks below raise: a term overrides those it has, and `answers` keeps the others uncalled.

    def held(self, load: Array, gravity: Array) -> Array:
        """Take note, at the start, of what joints at rest need beside all torques told.

        Args:
          load: what they need, shape (n_simulations, n_joints), N m.
          gravity: what they need with no torque told, 0 where the torque is off, same shape.

        Returns:
          What this term does not hold of the load.
        """
        raise NotImplementedError

    def parts(self) -> Parts:
        """The arrays that a term's kernels take beside a sub-step's own, rows of simulations.

        They stay the same arrays from `prepare` on. A term whose hooks in a sub-step are kernels
        has them, and can be in the loop of `pup.physics.loop`, which names them in this order.
        """
        raise NotImplementedError

    def lateness(self, time: float | Array, n: int) -> Array:
        """By how much commands come late, (n, n_joints) or (n, 1), s."""
        raise NotImplementedError

    def pace(self) -> Array:
        """How fast the clock goes that commands come by, (n_simulations, 1); 1 for right.

        A term that has it is late by nothing else: where commands are told as time goes by, its
        `lateness` is left out and the time between two of them is divided by this.
        """
        raise NotImplementedError

    def command(self, now: Array, before: Array, share: Array) -> tuple[Array, Array]:
        """Change the targets that reach the controller.

        Args:
          now: at the sub-step's end, (n_active, n_joints), rad.
          before: at its beginning.
          share: of the sub-step for which `now` holds, broadcastable to them.
        """
        raise NotImplementedError

    def sense(self, position: Array, velocity: Array) -> tuple[Array, Array]:
        """What the encoder tells of the position, and the velocity of the motor."""
        raise NotImplementedError

    def error(self, error: Array) -> Array:
        """Change the controller's error."""
        raise NotImplementedError

    def drive(self, drive: Drive) -> None:
        """Change the servo's torque and its limits, in place; keeps no state."""
        raise NotImplementedError

    def settle(self, outcome: Outcome) -> None:
        """Take note of what a sub-step has come to."""
        raise NotImplementedError

    def flow(self, flow: Flow) -> None:
        """Change what reaches the link, in place."""
        raise NotImplementedError

    def push(self, xfrc: Array) -> None:
        """Add to the wrenches on the bodies, (n_simulations, n_bodies, 6), once at the start."""
        raise NotImplementedError

    def delay(self) -> Array:
        """By how much readings of positions are old, (n_simulations, n_joints), s."""
        raise NotImplementedError

    def tilt(self, quaternion: Array, rows: NDArray[np.int64]) -> Array:
        """Change the torso's orientation, (n, 4), as the IMU tells it, of some simulations."""
        raise NotImplementedError

    def tilt_delay(self) -> Array:
        """By how much the IMU's readings are old, (n_simulations, 1), s."""
        raise NotImplementedError

    @classmethod
    def answers(cls, hook: str) -> bool:
        """Whether the term has a hook of its own."""
        return getattr(cls, hook) is not getattr(Term, hook)

    @classmethod
    def magnitudes(cls) -> tuple[Quantity, ...]:
        """The quantities that are zero in the nominal model."""
        return tuple(q for q in cls.quantities if not q.shape)


def begin(kept: Array, value: Array) -> None:
    """Let what is NaN in a state, for its simulation has just started, begin with a value."""
    np.copyto(kept, value, where=np.isnan(kept))
