"""Nominal servos of a drafted robot: what its model says of them, or a guess by its weight."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from pup.drafting.limbs import height_of
from pup.drafting.spec import BY_JOINT
from pup.robot_parts import ParameterSpec

GRAVITY = 9.81
STRONG = 3.0
"""A servo whose torque nobody tells is taken to carry so many times what may hang on it."""
SAG = 0.15
"""Error at which such a servo is at its torque limit, rad."""
DAMPED = 0.7
"""Damping ratio of such a servo."""
ROTOR = 0.1
"""Its rotor inertia as a share of the most that any of them moves."""
SHIFTED, LEAST = 0.05, 0.005
"""By so much a torso's centre of mass may be off: a share of the robot's height, and at least m."""
LEAST_DAMPED = 0.1
"""Of the damping that such a joint should have, the least share that is the servo's: joints of the
model may have their own."""
ALIKE = 1.5
"""Servos of a group have stiffness and torque limits within this factor of each other."""
GUESS, TOLD, LIMIT = 2, 4, 6
"""Digits of a guess, of what the model tells, and of a limit after the point, rad."""
UNITS = {"kp": "N m/rad", "kd": "N m s/rad", "tau_max": "N m"}
WIDE = {"kp": (0.2, 5.0), "kd": (0.05, 10.0), "tau_max": (0.2, 3.0)}
"""Search ranges, as factors on the nominal values."""


@dataclass(frozen=True)
class Servo:
    """What drives a joint.

    Attributes:
      values: `kp`, `kd` and `tau_max`.
      guessed: which of them the model does not tell.
    """

    values: dict[str, float]
    guessed: frozenset[str]

    def like(self, other: "Servo") -> bool:
        """Whether both can share their parameters, by what is told of them."""
        told = {"kp", "tau_max"} - self.guessed - other.guessed
        pairs = [sorted((self.values[what], other.values[what])) for what in told]
        return all(high <= ALIKE * low for low, high in pairs)


def parameters(
    model: mujoco.MjModel,
    at: mujoco.MjData,
    driven: Mapping[int, Servo],
    groups: Sequence[str],
    heavy: str | None,
    notes: list[str],
) -> tuple[ParameterSpec, ...]:
    """The parameter space of the `pd` law, and of the torso and the floor where the base is free.

    Args:
      model: compiled, with its actuators.
      at: as the robot stands.
      driven: the servo of each joint, by its number.
      groups: of each joint.
      heavy: what the torso's centre of mass is that of, such as `torso_com`; None for a fixed base.
      notes: told what is guessed.
    """
    _tell(model, driven, notes)
    told: list[ParameterSpec] = []
    for kind, unit in UNITS.items():
        for group in dict.fromkeys(groups):
            several = [s for s, own in zip(driven.values(), groups, strict=True) if own == group]
            known = [servo for servo in several if kind not in servo.guessed]
            middle = float(np.median([servo.values[kind] for servo in known or several]))
            digits = TOLD if known else GUESS
            told.append(_spec(f"{kind}/{group}", unit, middle, WIDE[kind], digits))
    rotors = [float(model.dof_armature[model.jnt_dofadr[j]]) for j in driven]
    own = [rotor for rotor in rotors if rotor > 0]
    rotor = float(np.median(own)) if own else ROTOR * max(_inertia(model, j) for j in driven)
    told.append(_spec("armature", "kg m2", rotor, (0.05, 20.0), TOLD if own else GUESS))
    if not own:
        notes.append("guessed by what they move: armature of all joints")
    if heavy is not None:
        across = max(round(SHIFTED * height_of(model, at), 3), LEAST)
        told += [
            ParameterSpec(f"{heavy}/{axis}", "m", 0.0, (-across, across), ("pd",)) for axis in "xyz"
        ]
        told.append(ParameterSpec("ground_friction", "1", 0.8, (0.2, 1.5), ("pd",)))
    return tuple(told)


def _tell(model: mujoco.MjModel, driven: Mapping[int, Servo], notes: list[str]) -> None:
    """Tell which joints the model does not drive, and what of the others is guessed."""
    idle = [model.joint(j).name for j in driven if model.nu and not _servos(model, j)]
    if idle:
        notes.append(f"the model drives no {', '.join(idle)}: weld what has no servo")
    unknown: dict[tuple[str, ...], list[str]] = {}
    for kind in UNITS:
        joints = tuple(model.joint(j).name for j, s in driven.items() if kind in s.guessed)
        unknown.setdefault(joints, []).append(kind)
    for joints, kinds in unknown.items():
        if joints and list(joints) != idle:
            told = "all joints" if len(joints) == len(driven) else ", ".join(joints)
            notes.append(f"guessed by what they carry: {', '.join(kinds)} of {told}")


def limits_of(model: mujoco.MjModel, joint: int) -> tuple[float, float] | None:
    """Targets that a joint may be sent: its range, or what its position servo takes; else None."""
    limits = [np.array(model.jnt_range[joint])] if model.jnt_limited[joint] else []
    for a in _servos(model, joint):
        told = model.actuator_dyntype[a] != mujoco.mjtDyn.mjDYN_INTEGRATOR  # is told a rate
        if told and model.actuator_ctrllimited[a] and _stiffness(model, a) > 0:
            # The angle at which the servo is at rest: gain u + b0 + b1 gear q = 0.
            slope = -model.actuator_biasprm[a, 1] * model.actuator_gear[a, 0]
            force = model.actuator_gainprm[a, 0] * model.actuator_ctrlrange[a]
            limits.append(np.sort((force + model.actuator_biasprm[a, 0]) / slope))
    if not limits:
        return None
    low, high = np.max(limits, axis=0)[0], np.min(limits, axis=0)[1]
    if low >= high:  # they have nothing in common
        low, high = limits[0]
    return round(float(low), LIMIT), round(float(high), LIMIT)


def _servos(model: mujoco.MjModel, joint: int) -> list[int]:
    """The actuators that drive a joint, by number."""
    by_joint = np.isin(model.actuator_trntype, [int(kind) for kind in BY_JOINT])
    return [int(a) for a in np.flatnonzero(by_joint & (model.actuator_trnid[:, 0] == joint))]


def _stiffness(model: mujoco.MjModel, actuator: int) -> float:
    """Of a position servo, at the joint; 0 of a motor and of a velocity servo."""
    if model.actuator_biastype[actuator] != mujoco.mjtBias.mjBIAS_AFFINE:
        return 0.0
    gear = float(model.actuator_gear[actuator, 0])
    return max(0.0, -float(model.actuator_biasprm[actuator, 1]) * gear**2)


def servo_of(model: mujoco.MjModel, at: mujoco.MjData, joint: int, free: bool) -> Servo:
    """Stiffness, damping and torque limit of a joint's servo, and which of these are guesses."""
    kp = sum(_stiffness(model, a) for a in _servos(model, joint))
    kd = limit = 0.0
    for a in _servos(model, joint):
        gear = abs(float(model.actuator_gear[a, 0]))
        if model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_AFFINE:
            kd += -float(model.actuator_biasprm[a, 2]) * gear**2
        if model.actuator_forcelimited[a]:
            limit += float(np.abs(model.actuator_forcerange[a]).max()) * gear
        elif model.actuator_ctrllimited[a] and _is_motor(model, a) and kp == 0:
            gain = abs(float(model.actuator_gainprm[a, 0])) * gear
            limit += float(np.abs(model.actuator_ctrlrange[a]).max()) * gain
    if model.jnt_actfrclimited[joint]:
        bound = float(np.abs(model.jnt_actfrcrange[joint]).max())
        limit = min(limit, bound) if limit > 0 else bound
    guessed = {kind for kind, value in zip(UNITS, (kp, kd, limit), strict=True) if value <= 0}
    if limit <= 0:
        limit = STRONG * _load(model, at, joint, free)
    if kp <= 0:
        kp = limit / SAG
    if kd <= 0:
        wanted = 2 * DAMPED * float(np.sqrt(kp * (1 + ROTOR) * _inertia(model, joint)))
        own = float(model.dof_damping[model.jnt_dofadr[joint]])  # stays in the model
        kd = max(wanted - own, LEAST_DAMPED * wanted)
    return Servo({"kp": kp, "kd": kd, "tau_max": limit}, frozenset(guessed))


def _is_motor(model: mujoco.MjModel, actuator: int) -> bool:
    return bool(model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_NONE)


def _load(model: mujoco.MjModel, at: mujoco.MjData, joint: int, free: bool) -> float:
    """Torque, or force, that a joint may have to carry: its limb, or half of a robot that stands.

    A limb is held out level; a leg carries the rest on a lever of a quarter of the robot's height.
    """
    body = int(model.jnt_bodyid[joint])
    mass = float(model.body_subtreemass[body])
    weight = GRAVITY * mass
    if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
        return max(weight, GRAVITY * 0.01)
    reach = float(np.linalg.norm(at.subtree_com[body] - at.xanchor[joint]))
    held = weight * reach
    if free:
        root = int(model.body_rootid[body])
        carried = 0.5 * GRAVITY * float(model.body_subtreemass[root])
        held = max(held, carried * 0.25 * height_of(model, at))
    return max(held, 1e-3)


def _inertia(model: mujoco.MjModel, joint: int) -> float:
    """What a joint moves at the model's reference pose, without rotor, kg m2 or kg."""
    dof = int(model.jnt_dofadr[joint])
    return max(float(model.dof_M0[dof] - model.dof_armature[dof]), 1e-6)


def _spec(
    name: str, unit: str, nominal: float, wide: tuple[float, float], digits: int
) -> ParameterSpec:
    low, high = (_rounded(nominal * factor, GUESS) for factor in wide)
    return ParameterSpec(name, unit, _rounded(nominal, digits), (low, high), ("pd",))


def _rounded(value: float, digits: int) -> float:
    return float(f"{value:.{digits}g}")
