"""Between motor and link: play, give, springs and stops."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pup.physics.implicit import implicit_share
from pup.physics.model import Model
from pup.physics.terms import kernels
from pup.physics.terms.base import Flow, Parts, Quantity, Scene, Term, begin
from pup.physics.writer import FieldWriter

Array = NDArray[np.float64]

LEAST = 1e-7
"""Inertia of a rotor or a link, kg m², below which all are the same."""
LIGHT = 0.08
"""Share of its rotor's inertia from which a link swings so fast on what gives that a sub-step has
to go by the link: by the rotor alone it is unstable from 0.068."""
RELAXATION = 2e-4
"""Time constant of the damping in gears and stops that give, s: metal loses some 4 % at 30 Hz."""


def spring_shares(stiffness: Array, inertia: Array, step: float | Array) -> tuple[Array, Array]:
    """How a sub-step takes a damped spring: by the velocity that it ends at, and the one before.

    Of a spring that a sub-step can follow, the mean over it, half a sub-step to each side of its
    position: second order, without damping of its own. Of a stiffer one ever more as at its end.

    Args:
      stiffness: N m/rad.
      inertia: what swings on it, kg m².
      step: sub-step, s.

    Returns:
      The times (s) by which those two velocities are multiplied, to be added to its deflection.
    """
    stiff = 2 * implicit_share(stiffness * step, inertia, step) - 1
    mean = (1 - stiff) * step / 8
    return mean + stiff * step + RELAXATION / 2, RELAXATION / 2 - mean


def swinging(rotor: Array, model: Model) -> Array:
    """What steps take for the inertia of two masses that swing against each other, kg m².

    Args:
      rotor: of the motors, (n_simulations, n_joints), kg m².
      model: whose links, where all others give way, may be far lighter than that.
    """
    own = model.compiled.dof_armature[model.dofs]
    link = np.maximum(1 / model.compiled.dof_invweight0[model.dofs] - own, LEAST)
    return np.asarray(np.minimum(rotor, link / LIGHT))


class Transmission(Term):
    """Play or give between motor and link; a Drivetrain puts all of a joint's in series."""

    def gap(self) -> Array:
        """Half of the play, (n_simulations, n_joints), rad."""
        return np.zeros_like(self.scene.inertia)

    def give(self) -> Array:
        """Compliance, same shape, rad/(N m)."""
        return np.zeros_like(self.scene.inertia)

    def drag(self) -> Array:
        """What holds motor and link together within the play, same shape, N m s/rad."""
        return np.zeros_like(self.scene.inertia)

    def behind(self) -> Array:
        """Share of the play and give that the encoder is behind: 0 at the motor, 1 at the link."""
        raise NotImplementedError


class Drivetrain(Term):
    """Motors with their own rotors that reach the links through play and give.

    Motor and link are two masses. The motor's step is solved together with the link's: seen from
    the link, the rest is a torque and a viscous coefficient, whatever the stiffness between them,
    and as play and give go to nothing the rotor's inertia goes back to the link. The servo's and
    the joint's damping act on the motor, and so do friction and cogging, which are the motor's and
    its gear's: what is loose rattles freely.

    Args:
      parts: the play and the give.
      scene: what they act on.

    Attributes:
      driven: torque of the motors in the last sub-step, (n_simulations, n_joints), N m.
    """

    effect = "drivetrain"
    state = ("_position", "_velocity", "_free", "_heft", "_torque", "_damping", "_before")

    def __init__(self, parts: Sequence[Transmission], scene: Scene) -> None:
        self._gap = np.asarray(sum(part.gap() for part in parts))
        self._give = np.asarray(sum(part.give() for part in parts))
        self._drag = np.asarray(sum(part.drag() for part in parts))
        # Of the play and of the give, what an encoder sees that is not behind them.
        ahead = [1 - part.behind() for part in parts]
        play = sum(part.gap() * share for part, share in zip(parts, ahead, strict=True))
        bend = sum(part.give() * share for part, share in zip(parts, ahead, strict=True))
        self._play_seen = play / np.maximum(self._gap, 1e-12)
        self._bend_seen = bend / np.maximum(self._give, 1e-12)
        self._active = np.where((self._gap > 0) | (self._give > 0), 1.0, 0.0)
        self._first = np.full_like(self._gap, np.nan)
        self._ahead = np.zeros_like(self._gap)
        self.driven = np.zeros_like(self._gap)
        super().__init__({}, scene)

    @property
    def rows(self) -> NDArray[np.int32]:
        """The simulations that have any."""
        return np.asarray(np.flatnonzero(self._active.any(axis=1)), dtype=np.int32)

    def prepare(self) -> None:
        """See Term."""
        step = self.scene.timestep
        self._step = self.scene.steps()
        self._rotor = np.maximum(self.scene.armature, LEAST) / step
        stiffness = 1 / np.maximum(self._give, 1e-9)
        swings = swinging(self._rotor * step, self.scene.model)
        self._reach, self._past = spring_shares(stiffness, swings, step)
        self._past = np.where(self._give > 0, self._past, 0.0)
        self._position = np.full_like(self._gap, np.nan)
        self._velocity = np.zeros_like(self._gap)
        self._free = np.zeros_like(self._gap)
        self._heft = np.ones_like(self._gap)
        self._torque, self._damping = np.zeros_like(self._gap), np.zeros_like(self._gap)
        self._before = np.full_like(self._gap, np.nan)  # velocity of the link at the last sub-step

    def fields(self, writer: FieldWriter) -> None:
        """See Term: the rotor leaves the link."""
        armature, dofs = writer.field("dof_armature"), self.scene.model.dofs
        armature[:, dofs] = np.where(self._active, 0.0, armature[:, dofs])
        np.copyto(self.scene.inertia, self.scene.armature, where=self._active > 0)

    def sense(self, position: Array, velocity: Array) -> tuple[Array, Array]:
        """See Term."""
        told, felt = np.empty(position.shape), np.empty(position.shape)
        kernels.follow(told, felt, position, velocity, *self._motors(), *self._seen())
        return told, felt

    def parts(self) -> Parts:
        """See Term: of the motors, of what encoders see, of what reaches links, and before."""
        return (*self._motors(), *self._seen(), *self._between(), self._before)

    def _motors(self) -> Parts:
        moved = self._position, self._velocity, self._free, self._heft
        return (*moved, self._torque, self._damping)

    def _seen(self) -> Parts:
        starts = self._first, self._ahead, self._active, self._gap
        return (*starts, self._play_seen, self._bend_seen, self._step)

    def _between(self) -> Parts:
        springs = self._give, self._rotor, self._reach, self._past
        return (self._active, self._gap, self._drag, *springs, self._step)

    def turned(self, position: Array) -> Array:
        """Angles of what servos turn, their motors or else their links, (n_active, n_joints), rad.

        Args:
          position: of the links, same shape, rad.
        """
        n = len(position)
        return np.where(self._active[:n], self._position[:n], position)

    def bend(self, torque: Array) -> Array:
        """Let motors start where they have long passed on a torque.

        Args:
          torque: (n_simulations, n_joints), N m.

        Returns:
          What encoders see of it that are not behind it, same shape, rad.
        """
        play, give = np.sign(torque) * self._gap, torque * self._give
        self._ahead = play + give
        return np.asarray(play * self._play_seen + give * self._bend_seen)

    def short(self) -> Array:
        """By how much less of the motors' torques reached the links than they had, N m."""
        return np.where(self._active, self.driven - self._torque, 0.0)

    def tried(self, position: Array, velocity: Array, before: Array) -> None:
        """Learn from a first sub-step how fast the motors are half a sub-step before the start.

        Args:
          position: of the links after it, (n_simulations, n_joints), rad.
          velocity: of the links after it, rad/s.
          before: of the links and the motors before it, rad/s.
        """
        self.sense(position, velocity)
        self._first = before - (self._velocity - before) / 2

    def flow(self, flow: Flow) -> None:
        """See Term: what has acted on the motor, acts on the link from here on."""
        n, before = len(flow.torque), self._before[: len(flow.torque)]
        # Without a motor of its own, what turns a link bears the joint's damping, too.
        self.driven[:n] = flow.carried() + flow.brake + flow.viscous * flow.coming
        begin(before, flow.link)
        flow.angle, flow.velocity, flow.coming = flow.position, flow.link, 2 * flow.link - before
        before[:] = flow.link
        on_its_way = flow.torque, flow.damping, flow.brake, flow.viscous
        kernels.engage(*on_its_way, flow.position, flow.velocity, *self._motors(), *self._between())


class Backlash(Transmission):
    """Play between motor and link, with a viscous drag in it.

    The dead zone with inner damping of Nordin, Galic and Gutman, "New models for backlash and gear
    play" (International Journal of Adaptive Control and Signal Processing, 1997).
    """

    effect = "backlash"
    quantities = (
        Quantity("gap", "rad", 0.006, 0.06),
        Quantity("behind", "1", 1.0, 1.0, grid=(0.0, 1.0)),
        Quantity("drag", "N m s/rad", 0.001, 0.02, grid=(0.001,)),
    )
    source = "half of 0.01 to 0.035 rad: Webots' OP2, SO-101, microduck; drag: estimate"

    def gap(self) -> Array:
        """See Transmission."""
        return self.values["gap"]

    def drag(self) -> Array:
        """See Transmission: none of a term that has no play, where another has some."""
        return np.asarray(np.where(self.values["gap"] > 0, self.values["drag"], 0.0))

    def behind(self) -> Array:
        """See Transmission."""
        return self.values["behind"]


class JointCompliance(Transmission):
    """A spring between motor and link."""

    effect = "joint_compliance"
    quantities = (
        Quantity("compliance", "rad/(N m)", 0.008, 0.1),
        Quantity("behind", "1", 1.0, 1.0, grid=(0.0, 1.0)),
    )
    source = "estimate: 60 to 300 N m/rad"

    def give(self) -> Array:
        """See Transmission."""
        return self.values["compliance"]

    def behind(self) -> Array:
        """See Transmission."""
        return self.values["behind"]


class JointSpring(Term):
    """A spring beside the servo: a cable or a harness."""

    effect = "joint_spring"
    kinds = ("joint",)
    quantities = (
        Quantity("stiffness", "N m/rad", 0.15, 3.0),
        Quantity("preload", "N m", 0.05, 1.0, signed=True),
    )
    source = "estimate: 0.05 to 0.3 N m/rad"

    def parts(self) -> Parts:
        """See Term."""
        return self.values["stiffness"], self.values["preload"]

    def flow(self, flow: Flow) -> None:
        """See Term."""
        kernels.pull(flow.torque, flow.position, *self.parts())


class JointStop(Term):
    """Something stiff in the way beyond an angle, which takes some of the speed and never pulls."""

    effect = "joint_stop"
    kinds = ("joint",)
    starts = (1.0, 5.0, 25.0)
    least = 0.25
    quantities = (
        Quantity("stiffness", "N m/rad", 20.0, 2000.0),
        Quantity("angle", "rad", 0.0, 3.2, signed=True, grid=(-1.0, 1.0)),
        Quantity("side", "1", 1.0, 1.0, signed=True, grid=(-1.0, 1.0)),
        Quantity("loss", "s", 0.003, 0.05, grid=(0.003,)),
    )
    source = (
        "geometry; stiffness of plastic parts, which bounce at a third to two thirds of the speed"
    )

    def prepare(self) -> None:
        """See Term."""
        stiffness, loss = self.values["stiffness"], self.values["loss"]
        scene, step = self.scene, self.scene.timestep
        alone = scene.inertia <= scene.armature  # it has a motor of its own, and stops without it
        inertia = np.where(alone, swinging(scene.inertia, scene.model), scene.inertia)
        self._side = np.sign(self.values["side"])
        reach, past = spring_shares(stiffness, inertia, step)
        late = implicit_share(stiffness * loss, inertia, step)
        self._reach, self._past = reach + late * loss, past + (1 - late) * loss
        # How far ahead of the velocities what presses on it is told.
        self._soon, self._later = np.ones_like(self._past) * step / 2, self._reach + self._past

    def parts(self) -> Parts:
        """See Term."""
        stop = self._side, self.values["angle"], self.values["stiffness"]
        return (*stop, self._soon, self._later, self._past, self._reach)

    def flow(self, flow: Flow) -> None:
        """See Term."""
        kernels.block(flow.torque, flow.damping, flow.position, flow.velocity, *self.parts())
