"""Nominal servos of a drafted robot: what its model says of them, or a guess by its weight."""

from collections.abc import Mapping

import mujoco
import numpy as np

from pup.physics.draft_limbs import height_of
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
DIGITS = 2


def parameters(
    model: mujoco.MjModel,
    at: mujoco.MjData,
    groups: Mapping[int, str],
    free: bool,
    notes: list[str],
) -> tuple[ParameterSpec, ...]:
    """The parameter space of the `pd` law, and of the torso and the floor where the base is free.

    Args:
      model: compiled, with its actuators.
      at: as the robot stands.
      groups: of each joint, by its number.
      free: whether the base moves.
      notes: told what is guessed.
    """
    nominal: dict[str, list[tuple[float, float, float]]] = {}
    guessed: dict[str, list[str]] = {"kp": [], "tau_max": []}
    idle = [model.joint(j).name for j in groups if model.nu and not servos(model, j)]
    if idle:
        notes.append(f"the model drives no {', '.join(idle)}: weld what has no servo")
    for joint, group in groups.items():
        servo, unknown = _servo(model, at, joint, free)
        nominal.setdefault(group, []).append(servo)
        for what in unknown:
            guessed[what].append(model.joint(joint).name)
    for what, joints in guessed.items():
        if joints and joints != idle:
            some = "all joints" if len(joints) == len(groups) else ", ".join(joints)
            notes.append(f"the model does not tell {what} of {some}: a guess by what they carry")
    told: list[ParameterSpec] = []
    units = {"kp": "N m/rad", "kd": "N m s/rad", "tau_max": "N m"}
    wide = {"kp": (0.2, 5.0), "kd": (0.05, 10.0), "tau_max": (0.2, 3.0)}
    for number, (kind, unit) in enumerate(units.items()):
        for group, several in nominal.items():
            middle = float(np.median([servo[number] for servo in several]))
            told.append(_spec(f"{kind}/{group}", unit, middle, wide[kind]))
    rotors = [float(model.dof_armature[model.jnt_dofadr[j]]) for j in groups]
    known = [r for r in rotors if r > 0]
    rotor = float(np.median(known)) if known else ROTOR * max(_inertia(model, j) for j in groups)
    told.append(_spec("armature", "kg m2", rotor, (0.05, 20.0)))
    if free:
        across = max(round(SHIFTED * height_of(model, at), 3), LEAST)
        told += [
            ParameterSpec(f"torso_com/{axis}", "m", 0.0, (-across, across), ("pd",))
            for axis in "xyz"
        ]
        told.append(ParameterSpec("ground_friction", "1", 0.8, (0.2, 1.5), ("pd",)))
    return tuple(told)


def servos(model: mujoco.MjModel, joint: int) -> list[int]:
    """The actuators that drive a joint, by number."""
    return [
        a
        for a in range(model.nu)
        if model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT
        and model.actuator_trnid[a, 0] == joint
    ]


def _servo(
    model: mujoco.MjModel, at: mujoco.MjData, joint: int, free: bool
) -> tuple[tuple[float, float, float], list[str]]:
    """Stiffness, damping and torque limit of a joint's servo, and which of these are guesses."""
    kp = kd = limit = 0.0
    for a in servos(model, joint):
        gear = abs(float(model.actuator_gear[a, 0]))
        if model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_AFFINE:
            kp += -float(model.actuator_biasprm[a, 1]) * gear**2
            kd += -float(model.actuator_biasprm[a, 2]) * gear**2
        if model.actuator_forcelimited[a]:
            limit += float(np.abs(model.actuator_forcerange[a]).max()) * gear
        elif model.actuator_ctrllimited[a] and kp == 0:  # a motor is told a torque
            gain = abs(float(model.actuator_gainprm[a, 0])) * gear
            limit += float(np.abs(model.actuator_ctrlrange[a]).max()) * gain
    if model.jnt_actfrclimited[joint]:
        bound = float(np.abs(model.jnt_actfrcrange[joint]).max())
        limit = min(limit, bound) if limit > 0 else bound
    guessed = []
    if limit <= 0:
        limit = STRONG * _load(model, at, joint, free)
        guessed.append("tau_max")
    if kp <= 0:
        kp = limit / SAG
        guessed.append("kp")
    if kd <= 0:
        kd = 2 * DAMPED * np.sqrt(kp * (1 + ROTOR) * _inertia(model, joint))
    return (kp, kd, limit), guessed


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


def _spec(name: str, unit: str, nominal: float, wide: tuple[float, float]) -> ParameterSpec:
    low, middle, high = (_rounded(nominal * factor) for factor in (wide[0], 1.0, wide[1]))
    return ParameterSpec(name, unit, middle, (low, high), ("pd",))


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")
