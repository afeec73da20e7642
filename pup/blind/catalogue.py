"""Which effects there are, where they may sit and how large they typically are."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from pup.blind.kit import Kit
from pup.blind.world import Array, Effect, Place

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
"""Effects that scoring treats as one where the data cannot split them (contract, section 6)."""

CLASS_OF = {effect: name for name, effects in CLASSES.items() for effect in effects}

MASKED = (
    *("voltage_sag", "gear_efficiency", "quadratic_damping", "torque_speed_limit"),
    *("target_rate_limit", "load_dependent_friction", "joint_compliance", "actuator_lag"),
    *("command_delay", "measurement_delay", "thermal_drift"),
)
"""Effects that a refit of stiffness, damping and torque limit mostly hides."""
COMPARABLE = frozenset(
    (
        *("coulomb_friction", "stribeck_friction", "load_dependent_friction", "gear_efficiency"),
        *("torque_speed_limit", "target_rate_limit", "command_delay", "measurement_delay"),
        *("actuator_lag", "dead_band", "backlash", "joint_compliance", "structural_flex"),
        *("integral_action", "gain_asymmetry", "encoder_bias", "payload", "armature"),
        *("joint_spring", "joint_stop", "clock_skew", "ground_slope", "imu_delay"),
        *("external_force", "cogging"),
    )
)
"""Effects whose size means the same in any sensible form."""

LOSS = (0.00025, 0.0006)  # s, a material's damping over its stiffness; half a step keeps it stable

USUAL = (0.05, 1.5)  # times typical: what is less is no omission, what is more no servo
FIRM = (0.1, 1.5)  # of delays and springs: less is shorter than a step or stiffer than a link
SLOW = (0.25, 1.5)  # of a limited rate: less is beyond what the motor can follow

Shape = Callable[[np.random.Generator, Kit], Mapping[str, float]]


def _nothing(rng: np.random.Generator, kit: Kit) -> Mapping[str, float]:
    return {}


@dataclass(frozen=True)
class Kind:
    """How an effect is drawn.

    Attributes:
      size_name: what its number is called.
      unit: of that number.
      typical: that number's typical value on a kit.
      places: kinds of place it may take.
      shape: draws its other numbers.
      signed: whether the number may have either sign.
      inverse: whether less of the number is more of the effect.
      where: `air`, `ground` or `both`.
      single: whether it makes sense on a single servo on a bench.
      besides: effects of other classes that come with it and are no mistake to name.
      span: least and most of it that is plausible, times typical.
    """

    size_name: str
    unit: str
    typical: Callable[[Kit], float]
    places: tuple[str, ...]
    shape: Shape = _nothing
    signed: bool = False
    inverse: bool = False
    where: str = "both"
    single: bool = True
    besides: tuple[str, ...] = ()
    span: tuple[float, float] = USUAL


def _direction(rng: np.random.Generator, level: bool = False) -> Mapping[str, float]:
    vector: Array = rng.normal(size=3)
    vector[2] = 0.0 if level else vector[2]
    x, y, z = vector / np.linalg.norm(vector)
    return {"x": float(x), "y": float(y), "z": float(z)}


def _of(**ranges: tuple[float, float]) -> Shape:
    return lambda rng, kit: {k: float(rng.uniform(*limits)) for k, limits in ranges.items()}


def _late(rng: np.random.Generator, kit: Kit) -> Mapping[str, float]:
    wild = rng.uniform() < 0.4
    return {
        "jitter": float(rng.uniform(0.2, 0.5)) if wild else 0.0,
        "lost": float(rng.uniform(0.0, 2.5)) if wild else 0.0,  # share per second of delay
    }


def _sided(rng: np.random.Generator, kit: Kit) -> Mapping[str, float]:
    """Where the encoder sits, and how much the parts in series lose."""
    return {
        "side": 1.0 if rng.uniform() < 0.65 else -1.0,
        "loss": float(rng.uniform(*LOSS)),
        "drag": 0.002 * kit.share * float(rng.uniform(0.5, 1.5)),
    }


def _bend(rng: np.random.Generator, kit: Kit) -> Mapping[str, float]:
    """A link bends about a level axis of its own; on the bench about the servo's."""
    loss = {"loss": float(rng.uniform(*LOSS)), "root": 0.1}
    if len(kit.robot.joints) == 1:
        return {"x": 0.0, "y": 1.0, "z": 0.0, **loss}
    angle = float(rng.uniform(0, np.pi))
    return {"x": float(np.cos(angle)), "y": float(np.sin(angle)), "z": 0.0, **loss}


def _speed(low: float, high: float) -> Shape:
    return lambda rng, kit: {"speed": kit.fast * float(rng.uniform(low, high))}


ROUNDING = 1e-9  # relative, of numbers that were scaled
JOINT = ("joint", "group")
WIDE = ("joint", "group", "bus")
TURN = 2 * np.pi

KINDS: dict[str, Kind] = {
    "coulomb_friction": Kind("torque", "N m", lambda k: 0.075 * k.share, JOINT),
    "stribeck_friction": Kind(
        "static torque",
        "N m",
        lambda k: 0.08 * k.share,
        JOINT,
        lambda rng, kit: {
            "floor": float(rng.uniform(0.2, 0.5)),
            "speed": kit.fast * float(rng.uniform(0.05, 0.25)),
        },
    ),
    "presliding_hysteresis": Kind(
        "torque", "N m", lambda k: 0.075 * k.share, JOINT, _of(length=(0.002, 0.006))
    ),
    "load_dependent_friction": Kind("coefficient", "1", lambda k: 0.2, JOINT),
    "gear_efficiency": Kind("loss", "1", lambda k: 0.2, JOINT),
    "quadratic_damping": Kind(
        "coefficient",
        "N m s2/rad2",
        lambda k: 0.9 * k.stall / k.fast**2,
        JOINT,
        lambda rng, kit: {"power": float(rng.uniform(1.75, 2.25)), "reference": kit.fast / 2},
    ),
    "torque_speed_limit": Kind("slope", "N m s/rad", lambda k: k.stall / k.fast, JOINT),
    "target_rate_limit": Kind(
        "rate", "rad/s", lambda k: 4.0, WIDE, _of(run_up=(0.02, 0.06)), inverse=True, span=SLOW
    ),
    "command_delay": Kind("delay", "s", lambda k: 0.012, WIDE, _late, span=FIRM),
    "measurement_delay": Kind(
        "delay", "s", lambda k: 0.012, WIDE, _of(jitter=(0.0, 0.2)), span=FIRM
    ),
    "actuator_lag": Kind("time constant", "s", lambda k: 0.01, JOINT, span=FIRM),
    "voltage_sag": Kind(
        "resistance",
        "ohm",
        lambda k: 0.6 if k.fast > 10 else 0.7 if len(k.robot.joints) < 10 else 0.35,
        ("bus",),
        lambda rng, kit: {"draw": kit.draw, "buffer": float(rng.uniform(0.002, 0.03))},
    ),
    "thermal_drift": Kind(
        "loss", "1", lambda k: 0.2, ("joint", "group", "robot"), _of(time=(8.0, 20.0))
    ),
    "cogging": Kind(
        "amplitude",
        "N m",
        lambda k: 0.04 * k.share,
        JOINT,
        lambda rng, kit: {
            "teeth": float(rng.integers(18, 46)),
            "phase": float(rng.uniform(0, TURN)),
            "second": float(rng.uniform(0, TURN)),
        },
    ),
    "dead_band": Kind("half width", "rad", lambda k: 0.004, JOINT),
    "backlash": Kind("half width", "rad", lambda k: 0.009, JOINT, _sided),
    "joint_compliance": Kind(
        "stiffness", "N m/rad", lambda k: 120 * k.share, JOINT, _sided, inverse=True, span=FIRM
    ),
    "structural_flex": Kind(
        "stiffness", "N m/rad", lambda k: 150 * k.share, ("body",), _bend, inverse=True, span=FIRM
    ),
    "integral_action": Kind("gain", "N m/(rad s)", lambda k: 2.0 * k.kp, JOINT),
    "gain_asymmetry": Kind("asymmetry", "1", lambda k: 0.085, ("joint",), signed=True),
    "friction_asymmetry": Kind(
        "mean torque",
        "N m",
        lambda k: 0.06 * k.share,
        ("joint",),
        lambda rng, kit: {"share": float(rng.choice((-1, 1)) * rng.uniform(0.6, 1.0))},
        besides=("coulomb_friction",),
    ),
    "encoder_bias": Kind("bias", "rad", lambda k: 0.025, ("joint",), signed=True),
    "encoder_eccentricity": Kind("amplitude", "rad", lambda k: 0.009, JOINT, _of(phase=(0, TURN))),
    "com_offset": Kind(
        "offset",
        "m",
        lambda k: 0.008 if len(k.robot.joints) == 1 else 0.015,
        ("body",),
        lambda rng, kit: (
            {"x": 1.0, "y": 0.0, "z": 0.0}
            if len(kit.robot.joints) == 1
            else _direction(rng, level=True)
        ),
        signed=True,
    ),
    "payload": Kind("mass", "kg", lambda k: 0.15 if k.ground else 0.05, ("body",)),
    "armature": Kind("inertia", "kg m2", lambda k: 0.004, ("joint",), single=False),
    "joint_spring": Kind(
        "stiffness",
        "N m/rad",
        lambda k: 0.18 * k.share,
        ("joint",),
        _of(rest=(-0.5, 0.5), stiffening=(0.0, 0.4)),
    ),
    "joint_stop": Kind(
        "angle",
        "rad",
        lambda k: 0.0,
        ("joint",),
        lambda rng, kit: {
            "side": float(rng.choice((-1, 1))),
            "give": float(rng.uniform(0.004, 0.02)),
            "quantile": float(rng.uniform(0.85, 0.97)),
        },
        where="air",
    ),
    "clock_skew": Kind("skew", "1", lambda k: 0.003, ("robot",), signed=True),
    "ground_compliance": Kind(
        "sag",
        "m",
        lambda k: 0.0025,
        ("ground", "foot"),
        _of(impedance=(0.75, 0.9), damping=(0.4, 1.2)),
        where="ground",
    ),
    "ground_slope": Kind(
        "tilt", "rad", lambda k: 0.03, ("ground",), _of(heading=(0, TURN)), where="ground"
    ),
    "ground_friction": Kind("loss", "1", lambda k: 0.7, ("foot",), where="ground"),
    "contact_restitution": Kind(
        "undamped share",
        "1",
        lambda k: 0.6,
        ("ground", "foot"),
        _of(time=(0.02, 0.04)),
        where="ground",
    ),
    "imu_misalignment": Kind(
        "angle", "rad", lambda k: 0.04, ("sensor",), lambda r, k: _direction(r), where="ground"
    ),
    "imu_delay": Kind("delay", "s", lambda k: 0.025, ("sensor",), where="ground"),
    "external_force": Kind(
        "force",
        "N",
        lambda k: 1.0 if k.ground else 0.6,
        ("body",),
        lambda r, k: _direction(r, level=k.ground),
        single=False,
    ),
}

_UNLISTED: dict[str, tuple[str, str, Callable[[Kit], float], Shape]] = {
    "ageing_friction": (
        "torque",
        "N m",
        lambda k: 0.08 * k.share,
        _of(slip=(0.01, 0.05), young=(0.01, 0.03), growth=(0.1, 0.25)),
    ),
    "hysteretic_gain": ("loss", "1", lambda k: 0.3, _of(width=(0.01, 0.04))),
    "stick_events": ("torque", "N m", lambda k: 0.6 * k.stall, _of(every=(1.5, 3.0))),
    "quantised_torque": ("level", "N m", lambda k: 0.1 * k.stall, _nothing),
    "speed_dependent_gain": ("change", "1", lambda k: -0.35, _speed(0.05, 0.2)),
    "friction_step": ("torque", "N m", lambda k: 0.1 * k.share, _of(onset=(2.0, 4.5))),
    "derivative_of_error": (
        "gain",
        "N m s/rad",
        lambda k: 0.008 * k.kp,
        _of(filter=(0.004, 0.012)),
    ),
    "relaxing_harness": ("stiffness", "N m/rad", lambda k: 0.25 * k.share, _of(time=(0.3, 1.2))),
}


def available(kit: Kit) -> tuple[str, ...]:
    """The effects that make sense on a kit."""
    alone = len(kit.robot.joints) == 1
    away = "air" if kit.ground else "ground"
    return tuple(n for n, k in KINDS.items() if k.where != away and (k.single or not alone))


def draw(name: str, kit: Kit, rng: np.random.Generator, places: tuple[str, ...] = ()) -> Effect:
    """An effect of typical size at a random place.

    Args:
      name: of the catalogue, or of an unlisted form.
      kit: what it is on.
      rng: source of all that is random.
      places: kinds of place to choose from; the effect's own when none is given.
    """
    if name in _UNLISTED:
        size_name, unit, size, shape = _UNLISTED[name]
        place = Place("joint", (str(rng.choice(kit.sites("joint"))),))
        return Effect("unknown", place, size(kit), size_name, unit, shape(rng, kit), name)
    kind = KINDS[name]
    options = [p for p in places or kind.places if p == "body" or kit.sites(p)]
    if name == "voltage_sag":
        place = Place("bus", ("bus",))
    else:
        chosen = str(rng.choice(options))
        place = Place(chosen, (str(rng.choice(_bodies(name, kit) or kit.sites(chosen))),))
    sign = float(rng.choice((-1, 1))) if kind.signed else 1.0
    form = ""
    if name == "thermal_drift":
        form = "battery" if place.kind == "robot" else "winding"
    elif name == "measurement_delay" and place.kind == "bus":
        form = "one by one" if rng.uniform() < 0.5 else "together"
    return Effect(
        name,
        place,
        sign * kind.typical(kit),
        kind.size_name,
        kind.unit,
        kind.shape(rng, kit),
        form,
        kind.inverse,
    )


def plausible(effect: Effect, kit: Kit) -> bool:
    """Whether a robot may have so much of an effect.

    A stop is: its angle comes from the motion, not from the catalogue.
    """
    if effect.name == "joint_stop":
        return True
    if effect.form in _UNLISTED:
        typical, (least, most) = _UNLISTED[effect.form][2](kit), USUAL
    else:
        typical, (least, most) = KINDS[effect.name].typical(kit), KINDS[effect.name].span
    much = typical / effect.size if effect.inverse else effect.size / typical
    return least * (1 - ROUNDING) <= abs(much) <= most * (1 + ROUNDING)


def unlisted() -> tuple[str, ...]:
    """Forms that the contract's list does not have."""
    return tuple(_UNLISTED)


def _bodies(name: str, kit: Kit) -> tuple[str, ...]:
    """Bodies on which an effect of that kind shows."""
    if "body" not in KINDS[name].places:
        return ()
    robot = kit.robot
    if len(robot.joints) == 1:
        return ("load",)
    links = tuple(f"{j}_link" for j in kit.sites("joint"))
    if name == "structural_flex":
        return tuple(n for n in links if any(k in n for k in ("hip_roll", "pitch", "knee", "sho")))
    heavy = ("hip_pitch", "knee", "ank_pitch", "ank_roll", "sho_roll", "_el_", "head_tilt")
    limbs = tuple(n for n in links if any(k in n for k in heavy))
    if kit.ground and robot.torso is not None:
        return (robot.torso,) * len(limbs) + (limbs if name != "external_force" else ())
    return limbs
