"""The model that a robot is drafted from, as MuJoCo reads it, without what pup has no use for."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mujoco

from pup.drafting.files import find_files
from pup.errors import InputError
from pup.robot_toml import NAME

LEAST_INERTIA = 1e-9
"""Inertia of links that a model gives none, kg m2."""
MANY = 8
"""Names that a note lists."""
UNUSED = ("tuples", "sensors", "skins", "cameras", "lights", "tendons", "equalities")
"""Parts of a model, each kind before those that it refers to, with which it would go."""
BY_JOINT = mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT


@contextmanager
def refusals(source: Path) -> Iterator[None]:
    """Tell what MuJoCo refuses in one line that names the model."""
    try:
        yield
    except InputError:
        raise
    except (ValueError, mujoco.FatalError) as error:
        told = " ".join(str(error).split()).replace(f"{source}: ", "")
        raise InputError(f"{source}: MuJoCo refuses it: {told}") from error


def read_spec(source: Path, notes: list[str]) -> mujoco.MjSpec:
    """Read a model; every joint and body has a name that `robot.toml` can hold.

    Raises:
      InputError: it has no joint that a servo could drive, or has one that none could.
    """
    spec = mujoco.MjSpec.from_file(str(source))
    spec.compiler.fusestatic = False  # a URDF's base would become part of the world
    _refuse(spec, source)
    _leave_out(spec, notes)
    _name_all(spec, notes)
    if source.suffix.lower() == ".urdf":
        _follow_urdf(spec)
    find_files(spec, source, notes)
    return spec


def compiled(spec: mujoco.MjSpec, notes: list[str]) -> mujoco.MjModel:
    """The compiled model; what MuJoCo refuses in its inertias is mended where that helps."""
    empty = [body for body in spec.bodies[1:] if body.explicitinertial and body.mass <= 0]
    shapes = [geom for body in empty for geom in _resting(body)]  # not to be asked once refused
    try:
        return spec.compile()
    except ValueError as refused:
        spec.compiler.balanceinertia = True
        spec.compiler.boundinertia = LEAST_INERTIA
        for body in empty:
            body.explicitinertial = False
        _unweigh(shapes)
        try:
            model = spec.compile()
        except ValueError:
            raise refused from None
    notes.append("MuJoCo refused inertias, which are mended: compare them with your robot's")
    return model


def unique(name: str, taken: set[str]) -> str:
    """A name that is not taken yet, which it then is."""
    found, number = name, 2
    while found in taken:
        found, number = f"{name}_{number}", number + 1
    taken.add(found)
    return found


def fitting(name: str) -> str:
    """A name as `robot.toml` can hold it."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "_", name)[:60]


def some(names: list[str]) -> str:
    """A list for a note."""
    more = f" and {len(names) - MANY} more" if len(names) > MANY else ""
    return ", ".join(names[:MANY]) + more


def of_type(spec: mujoco.MjSpec, *types: mujoco.mjtJoint) -> list[mujoco.MjsJoint]:
    """The joints of some types."""
    return [joint for joint in spec.joints if joint.type in types]


def _refuse(spec: mujoco.MjSpec, source: Path) -> None:
    for joint in of_type(spec, mujoco.mjtJoint.mjJNT_BALL):
        raise InputError(
            f"{source}: joint {joint.name!r} is a ball joint, which no servo drives; write it "
            "as three hinges, or leave it out"
        )
    if spec.flexes:
        raise InputError(f"{source}: has a soft body (flex), which pup knows none of; leave it out")
    if not of_type(spec, mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
        raise InputError(f"{source}: has no hinge or slide joint that a servo could drive")


def _name_all(spec: mujoco.MjSpec, notes: list[str]) -> None:
    """Name bodies and joints that have no name, and rename what `robot.toml` cannot hold."""
    bodies = _renamed(spec.bodies[1:], lambda body: "torso" if _is_free(body) else "body")
    joints = _renamed(spec.joints, lambda joint: f"{joint.parent.name}_joint")
    sites = _renamed([site for site in spec.sites if site.name], lambda _: "site")
    for exclude in spec.excludes:
        exclude.bodyname1 = bodies.get(exclude.bodyname1, exclude.bodyname1)
        exclude.bodyname2 = bodies.get(exclude.bodyname2, exclude.bodyname2)
    for actuator in spec.actuators:
        actuator.target = joints.get(actuator.target, actuator.target)
    told = dict.fromkeys((*joints.values(), *bodies.values(), *sites.values()))
    if told:
        notes.append(f"renamed, as robot.toml could not hold the names: {some(list(told))}")


def _is_free(body: mujoco.MjsBody) -> bool:
    return any(joint.type == mujoco.mjtJoint.mjJNT_FREE for joint in body.joints)


def _renamed(parts: list[Any], otherwise: Callable[[Any], str]) -> dict[str, str]:
    """Give parts names that fit; the new name of each that had one."""
    taken = {part.name for part in parts if NAME.fullmatch(part.name)} | {"world"}
    changed = {}
    for part in parts:
        old = part.name
        if not NAME.fullmatch(old):
            part.name = unique(fitting(old) or otherwise(part), taken)
            if old:
                changed[old] = part.name
    return changed


def _leave_out(spec: mujoco.MjSpec, notes: list[str]) -> None:
    """Delete what a robot's folder has no use for; what couples joints is told."""
    couplings = [_coupled(equality) for equality in spec.equalities]
    couplings += [_spanned(tendon) for tendon in spec.tendons]
    if couplings:
        told = "; ".join(some(names) for names in couplings if names)
        notes.append(f"couplings of the model are left out, so that these move freely: {told}")
    for kind in UNUSED:
        for part in list(getattr(spec, kind)):
            spec.delete(part)
    for actuator in [a for a in spec.actuators if a.trntype not in BY_JOINT]:
        spec.delete(actuator)


def _coupled(equality: mujoco.MjsEquality) -> list[str]:
    return [fitting(name) for name in (equality.name1, equality.name2) if name]


def _spanned(tendon: mujoco.MjsTendon) -> list[str]:
    ends = [wrap.target for wrap in tendon.path if wrap.target is not None]
    return [fitting(getattr(end, "name", str(end))) for end in ends]


def _follow_urdf(spec: mujoco.MjSpec) -> None:
    """Let links without an inertial have no mass, where others have one for them."""
    for body in spec.bodies[1:]:
        held = [child for child in body.bodies if child.explicitinertial and not child.joints]
        if not body.explicitinertial and (body.parent.name != "world" or held):
            _unweigh(_resting(body))


def _resting(body: mujoco.MjsBody) -> list[mujoco.MjsGeom]:
    """The shapes of a link that no joint moves; one that moves needs their mass."""
    return [] if body.joints else list(body.geoms)


def _unweigh(geoms: list[mujoco.MjsGeom]) -> None:
    for geom in geoms:
        geom.mass = 0
