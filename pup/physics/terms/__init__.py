"""The physics library: every effect of docs/physics.md; how columns name them.

A column `effect/quantity@place` of a parameter space puts a term into a simulation, with no other
word anywhere: a space without such columns is the nominal model.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import cast, get_args

import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.physics.space import Candidates, ParameterSpace
from pup.physics.terms.actuator import (
    ActuatorLag,
    Cogging,
    DeadBand,
    DerivativeKick,
    GainAsymmetry,
    IntegralAction,
    QuadraticDamping,
    TargetRateLimit,
    ThermalDrift,
    TorqueSpeedLimit,
    VoltageSag,
)
from pup.physics.terms.base import Kind, Quantity, Scene, Term
from pup.physics.terms.body import Armature, ComOffset, ExternalForce, Payload, StructuralFlex
from pup.physics.terms.contact import (
    ContactRestitution,
    GroundCompliance,
    GroundFriction,
    GroundSlope,
)
from pup.physics.terms.friction import (
    CoulombFriction,
    FrictionAsymmetry,
    GearEfficiency,
    LoadDependentFriction,
    PreslidingHysteresis,
    RisingStaticFriction,
    StribeckFriction,
)
from pup.physics.terms.learned import LearnedLaw
from pup.physics.terms.sensing import (
    EncoderBias,
    EncoderEccentricity,
    ImuDelay,
    ImuMisalignment,
    MeasurementDelay,
    ScanDelay,
)
from pup.physics.terms.timing import ClockSkew, CommandDelay
from pup.physics.terms.transmission import (
    Backlash,
    Drivetrain,
    JointCompliance,
    JointSpring,
    JointStop,
    Transmission,
)
from pup.robot import RobotDescription, TermSpec
from pup.robot_parts import SINGLE_KINDS

Array = NDArray[np.float64]

TERMS: dict[str, type[Term]] = {
    term.effect: term
    for term in (
        # In the order in which they act on a torque's way from the servo to the link.
        CommandDelay,
        ClockSkew,
        TargetRateLimit,
        DeadBand,
        GainAsymmetry,
        IntegralAction,
        DerivativeKick,
        ThermalDrift,
        VoltageSag,
        TorqueSpeedLimit,
        ActuatorLag,
        GearEfficiency,
        Armature,
        LoadDependentFriction,
        CoulombFriction,
        StribeckFriction,
        RisingStaticFriction,
        PreslidingHysteresis,
        FrictionAsymmetry,
        QuadraticDamping,
        Cogging,
        Backlash,
        JointCompliance,
        StructuralFlex,
        JointSpring,
        JointStop,
        Payload,
        ComOffset,
        ExternalForce,
        EncoderBias,
        EncoderEccentricity,
        MeasurementDelay,
        ScanDelay,
        ImuMisalignment,
        ImuDelay,
        GroundCompliance,
        ContactRestitution,
        GroundFriction,
        GroundSlope,
    )
}
BEYOND: dict[str, type[Term]] = {LearnedLaw.effect: LearnedLaw}
"""Terms that are no effect of the library; they act after all others."""
CLASSES: dict[str, tuple[str, ...]] = {
    "dry_friction": (
        "coulomb_friction",
        "stribeck_friction",
        "rising_static_friction",
        "presliding_hysteresis",
    ),
    "load_friction": ("load_dependent_friction", "gear_efficiency"),
    "speed_loss": ("quadratic_damping", "torque_speed_limit"),
    "rate_limit": ("target_rate_limit",),
    "delay": ("command_delay", "measurement_delay", "scan_delay", "actuator_lag"),
    "supply": ("voltage_sag",),
    "drift": ("thermal_drift",),
    "ripple": ("cogging",),
    "lost_motion": ("backlash", "dead_band"),
    "compliance": ("joint_compliance", "structural_flex"),
    "hidden_control": ("integral_action", "derivative_kick"),
    "asymmetry": ("gain_asymmetry", "friction_asymmetry"),
    "bias": ("encoder_bias", "com_offset", "encoder_eccentricity"),
    "inertia": ("payload", "armature"),
    "spring": ("joint_spring",),
    "stop": ("joint_stop",),
    "clock": ("clock_skew",),
    "ground_compliance": ("ground_compliance",),
    "ground_slope": ("ground_slope",),
    "ground_friction": ("ground_friction",),
    "impact": ("contact_restitution",),
    "imu": ("imu_misalignment", "imu_delay"),
    "external": ("external_force",),
}
UNLISTED = frozenset(("derivative_kick", "rising_static_friction"))
"""Effects that the contract has no name for; documents call them `unknown` and give their law."""
FORMS = {"scan_delay": "measurement_delay"}
"""Effects that are a form of one that the contract names."""
CLASS_OF = {effect: name for name, effects in CLASSES.items() for effect in effects}


@dataclass(frozen=True, order=True)
class Place:
    """Where a term acts.

    Attributes:
      kind: of docs/diagnosis.md.
      name: of the joint, group, body or foot; empty for the kinds there is one of.
    """

    kind: Kind
    name: str = ""

    def __str__(self) -> str:
        return f"{self.kind}:{self.name}" if self.name else self.kind

    @classmethod
    def parse(cls, text: str) -> "Place":
        """The place that a string such as `joint:l_knee` or `bus` stands for."""
        kind, _, name = text.partition(":")
        if kind not in get_args(Kind):
            raise InputError(f"place {text!r}: {kind!r} is none of {', '.join(get_args(Kind))}")
        return cls(cast(Kind, kind), name)

    def joints(self, robot: RobotDescription) -> NDArray[np.int64]:
        """The joints of a joint, of a group, or of a whole robot or bus; none elsewhere."""
        if self.kind == "joint":
            return np.array([robot.joint_names.index(self.name)])
        if self.kind == "group":
            return np.flatnonzero(robot.group_index == robot.groups.index(self.name))
        return np.arange(len(robot.joints) if self.kind in ("robot", "bus") else 0)


def column(effect: str, quantity: str, place: Place) -> str:
    """Name of a column of candidates."""
    return f"{effect}/{quantity}@{place}"


@lru_cache(maxsize=4096)
def split_column(name: str) -> tuple[str, str, Place] | None:
    """Effect, quantity and place of a column; None for a parameter of another kind."""
    head, at, place = name.partition("@")
    if not at:
        return None
    effect, _, quantity = head.partition("/")
    try:
        _quantity(_term(effect), quantity)
    except InputError as error:
        raise InputError(f"{name!r}: {error}") from error
    return effect, quantity, Place.parse(place)


def _term(effect: str) -> type[Term]:
    known = TERMS | BEYOND
    if effect not in known:
        raise InputError(f"there is no effect {effect!r}; known: {', '.join(known)}")
    return known[effect]


def _quantity(term: type[Term], name: str) -> Quantity:
    for quantity in term.quantities:
        if quantity.name == name:
            return quantity
    known = ", ".join(q.name for q in term.quantities)
    raise InputError(f"{term.effect} has no {name!r}; it has: {known}")


def term_space(effect: str, place: Place) -> ParameterSpace:
    """The parameters of one effect at one place, nominally absent."""
    quantities = _term(effect).quantities
    return ParameterSpace(
        tuple(column(effect, q.name, place) for q in quantities),
        tuple(q.unit for q in quantities),
        np.array([q.nominal for q in quantities]),
        np.array([q.lower for q in quantities]),
        np.array([q.limit for q in quantities]),
    )


def described(spec: TermSpec) -> ParameterSpace:
    """The parameters of a term of a robot's description, nominally as given there.

    The search ranges are those of the effect, wide enough for what is given.

    Raises:
      InputError: no such effect or quantity, a place it cannot act at, or a negative size.
    """
    term = _term(spec.effect)
    place = Place.parse(f"{spec.kind}:{spec.name}" if spec.name else spec.kind)
    _check_kind(term, place)
    for name, value in spec.values.items():
        quantity = _quantity(term, name)
        if value < 0 and not quantity.signed:
            raise InputError(f"{name} = {value:g}: {spec.effect} takes no negative {name}")
    space = term_space(spec.effect, place)
    given = space.at({column(spec.effect, name, place): v for name, v in spec.values.items()})
    return replace(
        given,
        lower=np.minimum(given.lower, given.nominal),
        upper=np.maximum(given.upper, given.nominal),
    )


def bind_terms(candidates: Candidates, scene: Scene, dormant: bool = False) -> list[Term]:
    """The terms that act in some simulations, in the order in which they act.

    Args:
      candidates: one row per simulation.
      scene: what the simulations have in common.
      dormant: whether to bind those too that act in none, for they may later.
    """
    named: dict[str, list[tuple[str, str, Place]]] = {}
    for name in candidates.space.names:
        told = split_column(name)
        if told is not None and (scene.model.floating or told[2].kind not in ("ground", "foot")):
            named.setdefault(told[0], []).append((name, told[1], told[2]))
    bound: list[Term] = []
    for effect, term in (TERMS | BEYOND).items():
        if effect not in named:
            continue
        columns, sizes = named[effect], {q.name for q in term.magnitudes()}
        sized = [name for name, quantity, _ in columns if quantity in sizes]
        if any(dormant or candidates[name].any() for name in sized):
            bound.append(term(_values(term, columns, candidates, scene), scene))
    parts = [term for term in bound if isinstance(term, Transmission)]
    if parts:
        bound[bound.index(parts[0])] = Drivetrain(parts, scene)
    return [term for term in bound if not isinstance(term, Transmission)]


def _values(
    term: type[Term],
    columns: Sequence[tuple[str, str, Place]],
    candidates: Candidates,
    scene: Scene,
) -> Mapping[str, Array]:
    """Each quantity at each place of the term's layout, shape (n_simulations, n_places)."""
    width = _width(term, scene)
    values = {q.name: np.full((len(candidates), width), q.nominal) for q in term.quantities}
    shapes = {q.name: q.nominal for q in term.quantities if q.shape}
    present: dict[Place, NDArray[np.bool_]] = {}
    for name, quantity, place in columns:
        if quantity not in shapes:
            active = candidates[name] != 0
            present[place] = present[place] | active if place in present else active
    for name, quantity, place in columns:
        where = _where(term, place, scene)
        given = candidates[name][:, None]
        if quantity in shapes:  # a shape counts where its own term acts, not where another does
            values[quantity][:, where] = np.where(
                present[place][:, None], given, values[quantity][:, where]
            )
        else:
            values[quantity][:, where] += given
    return values


def _width(term: type[Term], scene: Scene) -> int:
    widths = {
        "joints": len(scene.robot.joints),
        "carried": len(scene.robot.joints),
        "bodies": int(scene.model.compiled.nbody),
        "feet": len(scene.robot.feet) + 1,
        "one": 1,
    }
    return widths[term.layout]


def _where(term: type[Term], place: Place, scene: Scene) -> NDArray[np.int64]:
    """The columns of a term's layout that a place covers."""
    robot = scene.robot
    _check_kind(term, place)
    names = _names(place.kind, robot, scene)
    if place.name and place.name not in names:
        raise InputError(f"place {place}: the robot has no {place.kind} of that name")
    if term.layout == "one":
        return np.zeros(1, dtype=np.int64)
    if place.kind in ("joint", "group"):
        return place.joints(robot)
    if place.kind == "foot":
        return np.array([robot.feet.index(place.name)])
    if place.kind == "body":
        body = scene.model.compiled.body(place.name)
        if term.layout == "bodies":
            return np.array([body.id])
        carrying = [
            i
            for i, name in enumerate(robot.joint_names)
            if scene.model.compiled.joint(name).bodyid[0] == body.id
        ]
        if not carrying:
            raise InputError(f"place {place}: no joint carries it, so {term.effect} cannot act")
        return np.array(carrying)
    return np.arange(_width(term, scene))


def _check_kind(term: type[Term], place: Place) -> None:
    """Refuse a place of a kind at which a term cannot act, or one too many or too few names."""
    if place.kind not in term.kinds:
        raise InputError(
            f"{term.effect} cannot act at {place}; it acts at a {' or '.join(term.kinds)}"
        )
    if place.kind in SINGLE_KINDS and place.name:
        raise InputError(f"place {place}: there is one {place.kind}; leave the name out")
    if place.kind not in SINGLE_KINDS and not place.name:
        raise InputError(f"place {place}: which {place.kind}? give its name")


def _names(kind: Kind, robot: RobotDescription, scene: Scene) -> Sequence[str]:
    if kind == "joint":
        return robot.joint_names
    if kind == "group":
        return robot.groups
    if kind == "foot":
        return robot.feet
    if kind == "body":
        model = scene.model.compiled
        return [model.body(i).name for i in range(1, model.nbody)]
    return ()


__all__ = [
    "CLASSES",
    "CLASS_OF",
    "FORMS",
    "TERMS",
    "UNLISTED",
    "Drivetrain",
    "Kind",
    "Place",
    "Quantity",
    "Scene",
    "Term",
    "bind_terms",
    "column",
    "described",
    "split_column",
    "term_space",
]
