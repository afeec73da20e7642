"""Dry friction in its kinds: a bristle that holds until it slips, and what its grip depends on."""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from pup.physics.terms import kernels
from pup.physics.terms.base import Flow, Parts, Quantity, Term

Array = NDArray[np.float64]

GRIP = 5e-5
"""How far a joint gives before dry friction slips, rad: what no encoder of a servo would see."""
RESTED = 1.0
"""Time for which a joint has rested when a recording starts, s."""


class Friction(Term):
    """Friction of some level on a joint, as the deflection of a bristle (Dahl 1968).

    The bristle follows the joint and slips at `level`. Its torque is the mean from half a sub-step
    before the position to half a one after it, the first half by the velocity that was, the second
    by the one to come: so a reversal costs what it should wherever in a sub-step it falls.
    """

    state: ClassVar[tuple[str, ...]] = ("_bend",)

    def prepare(self) -> None:
        """See Term."""
        self._bend = np.zeros_like(self.scene.inertia)  # as a share of where it slips
        self._load: Array | None = None
        self._length = self.length()
        self._step = self.scene.steps()
        self._level = np.empty_like(self._bend)

    def parts(self) -> Parts:
        """See Term: of the bristle, then of its level."""
        return (*self._bristle(), *self.grip())

    def _bristle(self) -> Parts:
        return self._bend, self._length, self.scene.inertia, self._step

    def held(self, load: Array, gravity: Array) -> Array:
        """See Term: a joint that is found at rest has its bristle bent by what it holds."""
        sizes = [np.abs(self.values[q.name]) for q in self.quantities if not q.shape]
        acts = np.asarray(sum(sizes)) > 0  # a batch has simulations without it, too
        self._load = np.where(acts, load, 0.0)
        return np.where(acts, 0.0, load)

    def flow(self, flow: Flow) -> None:
        """See Term."""
        level = self.level(flow)
        if self._load is not None:
            self._bend[:] = np.clip(-self._load / np.maximum(level, 1e-9), -1.0, 1.0)
            self._load = None
        bend, *fixed = self._bristle()
        kernels.rub(flow.torque, flow.damping, bend, flow.velocity, flow.coming, level, *fixed)

    def level(self, flow: Flow) -> Array:
        """Friction torque of joints that slip, N m; of simulations that have ended it is old."""
        return self.grip()[0]

    def grip(self) -> Parts:
        """The level, which by itself is the same always, and what else it depends on."""
        return (self.values["torque"],)

    def length(self) -> Array:
        """How far a joint gives before it slips, (n_simulations, n_joints), rad."""
        return np.full_like(self.scene.inertia, GRIP)


class CoulombFriction(Friction):
    """Friction of one level whatever the speed."""

    effect = "coulomb_friction"
    quantities = (Quantity("torque", "N m", 0.08, 1.0),)
    source = "BAM M1 of the MX-64 (arXiv:2410.08650): 0.09 N m"


class StribeckFriction(Friction):
    """Friction that is higher at rest than when sliding."""

    effect = "stribeck_friction"
    quantities = (
        Quantity("torque", "N m", 0.05, 1.0),
        Quantity("rest", "N m", 0.06, 1.0),
        Quantity("speed", "rad/s", 0.5, 6.0, grid=(0.1, 0.5, 2.0)),
    )
    source = "BAM M4 to M6 (arXiv:2410.08650): 0.02 to 0.12 N m more at rest, 1.5 to 2.6 rad/s"

    def grip(self) -> Parts:
        """See Friction."""
        return self._level, self.values["torque"], self.values["rest"], self.values["speed"]

    def level(self, flow: Flow) -> Array:
        """See Friction."""
        level, *fixed = self.grip()
        kernels.stribeck(level, flow.velocity, *fixed)
        return self._level


class RisingStaticFriction(Friction):
    """Friction that rises while a joint rests, and is worn off as it slides.

    The rise with the time at rest is that of the seven-parameter model (Armstrong-Helouvry, Dupont
    and Canudas de Wit 1994, table 3); the time is forgotten over a slip, as the state of Dieterich
    and Ruina is. At a constant speed it is lower the faster, as Stribeck friction is, and with next
    to no time of its own it is a form of that; with very much it grows throughout a recording.
    """

    effect = "rising_static_friction"
    quantities = (
        Quantity("torque", "N m", 0.05, 1.0),
        Quantity("rise", "N m", 0.06, 1.0),
        Quantity("time", "s", 0.1, 3.0, grid=(0.06, 0.3)),
        Quantity("slip", "rad", 0.03, 0.3, grid=(0.01, 0.05)),
    )
    telling = ("time",)
    rarity = 1.1  # a third: Coulomb and Stribeck friction are what robots are described with
    source = "sizes as of Stribeck friction; time 0 to 200 s (Armstrong-Helouvry et al. 1994)"
    state = ("_bend", "_age")

    def prepare(self) -> None:
        """See Term."""
        super().prepare()
        self._age = np.full_like(self._bend, RESTED)

    def grip(self) -> Parts:
        """See Friction."""
        sizes = (self.values[name] for name in ("torque", "rise", "time", "slip"))
        return self._level, self._age, *sizes, self._step

    def level(self, flow: Flow) -> Array:
        """See Friction: the age by d(age)/dt = 1 - fresh age, which at rest just grows."""
        level, age, *sizes = self.grip()
        kernels.rising(level, age, flow.velocity, *sizes)
        return self._level


class PreslidingHysteresis(Friction):
    """Dry friction with a wide elastic range before it slips."""

    effect = "presliding_hysteresis"
    quantities = (
        Quantity("torque", "N m", 0.08, 1.0),
        Quantity("deflection", "rad", 0.006, 0.05, grid=(0.003, 0.008, 0.02)),
    )
    source = "estimate: a LuGre bristle gives 3 mrad before it slips"

    def held(self, load: Array, gravity: Array) -> Array:
        """See Term: what bends a bristle that gives is not known; it starts relaxed."""
        return load

    def length(self) -> Array:
        """See Friction."""
        return self.values["deflection"]


class LoadDependentFriction(Friction):
    """Friction that grows with what the gear carries: the motor's torque and what it passes on."""

    effect = "load_dependent_friction"
    quantities = (Quantity("share", "1", 0.15, 0.8),)
    source = "BAM M4 to M6 (arXiv:2410.08650): 0.22 to 0.31 on MX-64 and MX-106"

    def grip(self) -> Parts:
        """See Friction."""
        return self._level, self.values["share"], self.scene.armature, self._step

    def level(self, flow: Flow) -> Array:
        """See Friction: what the gear passes on is the motor's torque less what turns its rotor."""
        level, *fixed = self.grip()
        now = flow.velocity, flow.coming
        kernels.passed(level, flow.torque, flow.damping, *now, *fixed)
        return self._level


class GearEfficiency(Friction):
    """A share of the motor's torque lost in the gear, whichever way power flows."""

    effect = "gear_efficiency"
    quantities = (Quantity("loss", "1", 0.2, 0.8),)
    source = "estimate: 0.7 to 0.9 for servo gears; BAM M5 and M6"

    def grip(self) -> Parts:
        """See Friction."""
        return self._level, self.values["loss"]

    def level(self, flow: Flow) -> Array:
        """See Friction."""
        level, loss = self.grip()
        kernels.carried(level, flow.torque, flow.damping, flow.coming, loss)
        return self._level


class FrictionAsymmetry(Friction):
    """Friction in one direction only, dry and viscous; positive brakes positive motion."""

    effect = "friction_asymmetry"
    kinds = ("joint",)
    quantities = (
        Quantity("torque", "N m", 0.04, 0.5, signed=True),
        Quantity("viscous", "N m s/rad", 0.05, 0.6, signed=True),
    )
    starts = (-1.0, 1.0)
    one_way = True
    source = "EMPS (Janot, Gautier, Brunot 2019): viscous friction 166.7 forward, 240.4 backward"

    def grip(self) -> Parts:
        """See Friction."""
        return self._level, self.values["torque"], self.values["viscous"]

    def level(self, flow: Flow) -> Array:
        """See Friction."""
        level, *sizes = self.grip()
        kernels.one_way(level, flow.damping, flow.velocity, self._bend, *sizes)
        return self._level
