"""The physics library: every effect of CONTRACTS.md, section 6, and how columns name it.

A column `effect/quantity@place` of a parameter space puts a term into a simulation, with no other
word anywhere: a space without such columns is the nominal model.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.physics.parameters import Candidates, ParameterSpace
from pup.physics.terms.actuator import (
    ActuatorLag,
    Cogging,
    DeadBand,
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
    StribeckFriction,
)
from pup.physics.terms.sensing import (
    EncoderBias,
    EncoderEccentricity,
    ImuDelay,
    ImuMisalignment,
    MeasurementDelay,
)
from pup.physics.terms.timing import ClockSkew, CommandDelay
from pup.physics.terms.transmission import Backlash, JointCompliance, JointSpring, JointStop
from pup.robot import RobotDescription

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
        ThermalDrift,
        VoltageSag,
        TorqueSpeedLimit,
        ActuatorLag,
        GearEfficiency,
        Backlash,
        JointCompliance,
        StructuralFlex,
        CoulombFriction,
        StribeckFriction,
        PreslidingHysteresis,
        LoadDependentFriction,
        FrictionAsymmetry,
        QuadraticDamping,
        Cogging,
        JointSpring,
        JointStop,
        Armature,
        Payload,
        ComOffset,
        ExternalForce,
        EncoderBias,
        EncoderEccentricity,
        MeasurementDelay,
        ImuMisalignment,
        ImuDelay,
        GroundCompliance,
        ContactRestitution,
        GroundFriction,
        GroundSlope,
    )
}
CLASSES: dict[str, tuple[str, ...]] = {
    "dry_friction": ("coulomb_friction", "stribeck_friction", "presliding_hysteresis"),
    "load_friction": ("load_dependent_friction", "gear_efficiency"),
    "speed_loss": ("quadratic_damping", "torque_speed_limit"),
    "rate_limit": ("target_rate_limit",),
    "delay": ("command_delay", "measurement_delay", "actuator_lag"),
    "supply": ("voltage_sag",),
    "drift": ("thermal_drift",),
    "ripple": ("cogging",),
    "lost_motion": ("backlash", "dead_band"),
    "compliance": ("joint_compliance", "structural_flex"),
    "hidden_control": ("integral_action",),
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
CLASS_OF = {effect: name for name, effects in CLASSES.items() for effect in effects}


@dataclass(frozen=True, order=True)
class Place:
    """Where a term acts.

    Attributes:
      kind: of CONTRACTS.md, section 5.
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
        return cls(kind, name)  # type: ignore[arg-type]


def column(effect: str, quantity: str, place: Place) -> str:
    """Name of a column of candidates."""
    return f"{effect}/{quantity}@{place}"


def split_column(name: str) -> tuple[str, str, Place] | None:
    """Effect, quantity and place of a column; None for a parameter of another kind."""
    head, at, place = name.partition("@")
    if not at:
        return None
    effect, _, quantity = head.partition("/")
    if effect not in TERMS:
        raise InputError(f"{name!r}: there is no effect {effect!r}; known: {', '.join(TERMS)}")
    if quantity not in [q.name for q in TERMS[effect].quantities]:
        raise InputError(f"{name!r}: {effect} has no {quantity!r}")
    return effect, quantity, Place.parse(place)


def term_space(effect: str, place: Place) -> ParameterSpace:
    """The parameters of one effect at one place, nominally absent."""
    quantities = TERMS[effect].quantities
    return ParameterSpace(
        tuple(column(effect, q.name, place) for q in quantities),
        tuple(q.unit for q in quantities),
        np.array([q.nominal for q in quantities]),
        np.array([q.lower for q in quantities]),
        np.array([q.limit for q in quantities]),
    )


def bind_terms(candidates: Candidates, scene: Scene) -> list[Term]:
    """The terms that act in some simulations, in the order in which they act.

    Args:
      candidates: one row per simulation.
      scene: what the simulations have in common.
    """
    named: dict[str, list[tuple[str, str, Place]]] = {}
    for name in candidates.space.names:
        told = split_column(name)
        if told is not None and (scene.model.floating or told[2].kind not in ("ground", "foot")):
            named.setdefault(told[0], []).append((name, told[1], told[2]))
    bound = []
    for effect, term in TERMS.items():
        columns = named.get(effect, [])
        sizes = {q.name for q in term.magnitudes()}
        if any(candidates[name].any() for name, quantity, _ in columns if quantity in sizes):
            bound.append(term(_values(term, columns, candidates, scene), scene))
    return bound


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
    if place.kind not in term.kinds:
        raise InputError(
            f"{term.effect} cannot act at {place}; it acts at a {' or '.join(term.kinds)}"
        )
    if place.kind in ("bus", "robot", "sensor", "ground") and place.name:
        raise InputError(f"place {place}: there is one {place.kind}; leave the name out")
    names = _names(place.kind, robot, scene)
    if place.name and place.name not in names:
        raise InputError(f"place {place}: the robot has no {place.kind} of that name")
    if term.layout == "one":
        return np.zeros(1, dtype=np.int64)
    if place.kind == "joint":
        return np.array([robot.joint_names.index(place.name)])
    if place.kind == "group":
        return np.flatnonzero(robot.group_index == robot.groups.index(place.name))
    if place.kind == "foot":
        return np.array([robot.feet.index(place.name)])
    if place.kind == "body":
        body = scene.model.compiled.body(place.name)
        if term.layout == "bodies":
            return np.array([body.id])
        return np.array(
            [
                i
                for i, name in enumerate(robot.joint_names)
                if scene.model.compiled.joint(name).bodyid[0] == body.id
            ],
            dtype=np.int64,
        )
    return np.arange(_width(term, scene))


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
    "TERMS",
    "Kind",
    "Place",
    "Quantity",
    "Scene",
    "Term",
    "bind_terms",
    "column",
    "split_column",
    "term_space",
]
