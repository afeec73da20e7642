"""A robot's folder drafted from the model that a laboratory has already, MJCF or URDF.

MuJoCo reads both. What it knows of joints, servos and contact is written down as `robot.toml`; what
no model tells is guessed, and told as such.
"""

import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.files import write_atomic
from pup.physics.draft_limbs import feet_of, mirror_map
from pup.physics.draft_numbers import parameters, servos
from pup.physics.model import FLOOR, compile_model
from pup.robot import RobotDescription
from pup.robot_draft import Draft, group_of, written
from pup.robot_parts import Joint
from pup.robot_toml import NAME

Array = NDArray[np.float64]

KINDS = (".xml", ".urdf")
MESHES = "assets"
WORLD_WIDE = np.pi
"""Limit of a joint without a range, rad, or m."""
SQUARE = np.cos(np.radians(20.0) / 2)
"""An IMU's site that is turned further in the torso is turned as its chip is."""
DIGITS = 6
"""Of a limit, rad."""
HOLDERS = 4
"""Folders above a URDF in which its meshes are looked for."""


@dataclass(frozen=True)
class Drafted:
    """What came of a model.

    Attributes:
      robot: as its folder reads.
      notes: what was guessed, or is for the user to see to.
    """

    robot: RobotDescription
    notes: tuple[str, ...]


def draft_robot(source: Path, folder: Path, name: str = "", free: bool = False) -> Drafted:
    """Write a robot's folder for a model.

    Args:
      source: MJCF or URDF.
      folder: where to write; it may hold no robot yet.
      name: of the robot; empty for the model's own.
      free: whether to let the base move, as a URDF does not tell, and to put a floor under it.

    Raises:
      InputError: MuJoCo refuses the model, it has no joint that a servo could drive, or a robot is
        there already.
    """
    if (folder / "robot.toml").exists():
        raise InputError(f"{folder}: holds a robot.toml already; give another --out")
    if not source.is_file():
        raise InputError(f"{source}: no such file; name an MJCF or a URDF file")
    if source.suffix.lower() not in KINDS:
        raise InputError(f"{source}: name an MJCF file (.xml) or a URDF file (.urdf)")
    if name and not NAME.fullmatch(name):
        raise InputError(f"--name: {name!r} is no name; use letters, digits, '_', '.' and '-'")
    spec = _read(source)
    notes: list[str] = []
    _name_joints(spec, source)
    torso = _torso(spec, source, free, notes)
    site = _imu_site(torso, notes) if torso is not None else None
    compiled = _compiled(spec, source)
    at = _standing(compiled)
    if torso is not None:
        _part_neighbours(spec, compiled, at, notes)
    told = _draft(compiled, at, name or _named(spec, source), torso, site, notes)
    with tempfile.TemporaryDirectory() as place:
        _write(spec, told, source, Path(place))
        robot = RobotDescription.load(place)
        compile_model(robot, "ground" if robot.floating else "bench")
        for file in sorted(Path(place).rglob("*")):
            if file.is_file():
                write_atomic(folder / file.relative_to(place), file.read_bytes())
    return Drafted(RobotDescription.load(folder), told.notes)


def _read(source: Path) -> mujoco.MjSpec:
    try:
        spec = mujoco.MjSpec.from_file(str(source))
        spec.compiler.fusestatic = False  # a URDF's base would become part of the world
        _find_meshes(spec, source)
    except ValueError as error:
        raise _refused(source, error) from error
    for parts in (spec.sensors, spec.tendons, spec.equalities, spec.cameras, spec.lights):
        for part in list(parts):
            spec.delete(part)
    return spec


def _compiled(spec: mujoco.MjSpec, source: Path) -> mujoco.MjModel:
    try:
        return spec.copy().compile()
    except ValueError as error:
        raise _refused(source, error) from error


def _refused(source: Path, error: Exception) -> InputError:
    told = " ".join(str(error).split())
    return InputError(f"{source}: MuJoCo refuses it: {told}")


def _named(spec: mujoco.MjSpec, source: Path) -> str:
    name = "_".join((spec.modelname or source.stem).split())
    return name if NAME.fullmatch(name) else "robot"


def _find_meshes(spec: mujoco.MjSpec, source: Path) -> None:
    """Give every mesh and texture the whole path of its file.

    A URDF names them by package, from some folder above it, which MuJoCo leaves out.
    """
    base = source.absolute().parent
    for assets, folder in (
        (spec.meshes, spec.compiler.meshdir),
        (spec.textures, spec.compiler.texturedir),
        (spec.hfields, spec.compiler.meshdir),
    ):
        for asset in assets:
            if not asset.file:
                continue
            if Path(asset.file).suffix.lower() == ".dae":
                raise InputError(
                    f"{source}: MuJoCo does not read {asset.file!r}; convert it to STL or OBJ, or "
                    "leave the geoms that use it out"
                )
            places = [base / folder / asset.file, base / asset.file]
            found = next((p for p in places if p.is_file()), None) or _above(base, asset.file)
            if found is None:
                raise InputError(
                    f"{source}: {asset.file!r} is not there; put it beside the model, or leave the "
                    "geoms that use it out"
                )
            asset.file = str(found)
    spec.compiler.meshdir = spec.compiler.texturedir = ""


def _above(base: Path, file: str) -> Path | None:
    """A file of that name in the folders of the package that a URDF belongs to."""
    for holder in (base, *base.parents[:HOLDERS]):
        if (holder / "package.xml").is_file() or (holder / "meshes").is_dir():
            return next((p for p in sorted(holder.rglob(Path(file).name)) if p.is_file()), None)
    return None


def _name_joints(spec: mujoco.MjSpec, source: Path) -> None:
    driven = 0
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_BALL:
            raise InputError(
                f"{source}: joint {joint.name!r} is a ball joint, which no servo drives; write it "
                "as three hinges, or leave it out"
            )
        if joint.type != mujoco.mjtJoint.mjJNT_FREE:
            driven += 1
            joint.name = joint.name or f"{joint.parent.name or f'body{driven}'}_joint"
    if not driven:
        raise InputError(f"{source}: has no hinge or slide joint that a servo could drive")


def _torso(
    spec: mujoco.MjSpec, source: Path, free: bool, notes: list[str]
) -> mujoco.MjsBody | None:
    """The body that is free, with a floor below; None for a fixed base."""
    loose = [j for j in spec.joints if j.type == mujoco.mjtJoint.mjJNT_FREE]
    if len(loose) > 1:
        bodies = ", ".join(j.parent.name for j in loose)
        raise InputError(f"{source}: more than one body is free ({bodies}); leave the others out")
    if loose:
        torso = loose[0].parent
    elif free:
        torso = max(spec.worldbody.bodies, key=lambda body: len(list(_below(body))))
        torso.add_freejoint()
    else:
        notes.append("the base is fixed; --free lets it move and puts a floor under it")
        return None
    torso.name = torso.name or "torso"
    flat = [g for g in spec.geoms if g.type == mujoco.mjtGeom.mjGEOM_PLANE]
    floor = next((g for g in flat if g.name == FLOOR), None) or next(iter(flat), None)
    for geom in spec.geoms:
        if geom is not floor and geom.name == FLOOR:
            geom.name = f"{FLOOR}_too"
    floor = floor or spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE, size=[10.0, 10.0, 0.1]
    )
    floor.name, floor.priority = FLOOR, 1
    return torso


def _below(body: mujoco.MjsBody) -> Iterator[mujoco.MjsBody]:
    """A body and all that hangs on it."""
    yield body
    for child in body.bodies:
        yield from _below(child)


def _imu_site(torso: mujoco.MjsBody, notes: list[str]) -> str:
    """A site of the torso for the IMU: its own, where its link is, or the torso's origin."""
    sites = [s for s in torso.sites if "imu" in s.name.lower()]
    square = [s for s in sites if abs(s.quat[0]) >= SQUARE]
    if square:
        return str(square[0].name)
    link = next((b for b in torso.bodies if "imu" in b.name.lower() and not b.joints), None)
    where = sites[0].pos if sites else link.pos if link is not None else np.zeros(3)
    told = "where the model has it" if sites or link is not None else "at the torso's origin"
    notes.append(f"the IMU is taken to be {told}, turned as the torso is")
    return str(torso.add_site(name="torso_imu", pos=where).name)


def _standing(model: mujoco.MjModel) -> mujoco.MjData:
    """The model in its first key frame, or as it is written."""
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    return data


def _part_neighbours(
    spec: mujoco.MjSpec, model: mujoco.MjModel, at: mujoco.MjData, notes: list[str]
) -> None:
    """Let links that overlap where the robot stands not push each other."""
    world = model.body_weldid == 0
    pairs = set()
    for contact in at.contact:
        a, b = (int(model.geom_bodyid[g]) for g in contact.geom)
        if not (world[a] or world[b]) and contact.dist < 0:
            pairs.add((min(a, b), max(a, b)))
    known = {frozenset((e.bodyname1, e.bodyname2)) for e in spec.excludes}
    for a, b in sorted(pairs):
        names = model.body(a).name, model.body(b).name
        if all(names) and frozenset(names) not in known:
            spec.add_exclude(bodyname1=names[0], bodyname2=names[1])
            notes.append(f"{names[0]} and {names[1]} overlap, so that they do not touch")


def _draft(
    model: mujoco.MjModel,
    at: mujoco.MjData,
    name: str,
    torso: mujoco.MjsBody | None,
    site: str | None,
    notes: list[str],
) -> Draft:
    base = None if torso is None else str(torso.name)
    ids = [j for j in range(model.njnt) if model.jnt_type[j] != mujoco.mjtJoint.mjJNT_FREE]
    names = [model.joint(j).name for j in ids]
    known = [_limits(model, j) for j in ids]
    limits = [told or (-WORLD_WIDE, WORLD_WIDE) for told in known]
    if None in known:
        some = [n for n, told in zip(names, known, strict=True) if told is None]
        notes.append(f"no range, so that the limits are made up: {', '.join(some)}")
    groups = [group_of(n) for n in names]
    mirror = mirror_map(model, at, ids, base, notes)
    joints = tuple(
        Joint(n, None, group, low, high, *other)
        for n, group, (low, high), other in zip(names, groups, limits, mirror, strict=True)
    )
    feet = feet_of(model, at) if torso is not None else ()
    if torso is not None:
        notes.append(f"feet are taken to be {', '.join(feet)}; a walking robot needs a [gait] too")
    poses = {
        pose: tuple(
            float(np.clip(model.key_qpos[k][model.jnt_qposadr[j]], low, high))
            for j, (low, high) in zip(ids, limits, strict=True)
        )
        for k in range(model.nkey)
        for pose in [model.key(k).name or "home"]
        if NAME.fullmatch(pose)
    }
    if "stand" not in poses and "home" in poses and torso is not None:
        poses["stand"] = poses["home"]
    free = torso is not None
    told = parameters(model, at, dict(zip(ids, groups, strict=True)), free, notes)
    return Draft(name, joints, told, base, site, feet, poses, tuple(notes))


def _limits(model: mujoco.MjModel, joint: int) -> tuple[float, float] | None:
    """Targets that a joint may be sent: its range, or as its position servo has it; else None."""
    limits = []
    if model.jnt_limited[joint]:
        limits.append(model.jnt_range[joint])
    for servo in servos(model, joint):
        asked = model.actuator_biastype[servo] == mujoco.mjtBias.mjBIAS_AFFINE
        if asked and model.actuator_ctrllimited[servo]:
            limits.append(model.actuator_ctrlrange[servo])
    if not limits:
        return None
    low, high = np.max(limits, axis=0)[0], np.min(limits, axis=0)[1]
    return (round(float(low), DIGITS), round(float(high), DIGITS)) if low < high else None


def _write(spec: mujoco.MjSpec, told: Draft, source: Path, place: Path) -> None:
    """Write `model.xml`, its meshes and `robot.toml`."""
    taken: dict[str, str] = {}
    for assets in (spec.meshes, spec.textures, spec.hfields):
        for asset in assets:
            if asset.file:
                asset.file = _copied(Path(asset.file), place / MESHES, taken)
    spec.compiler.meshdir = spec.compiler.texturedir = MESHES if taken else ""
    for parts in (spec.actuators, spec.keys):
        for part in list(parts):
            spec.delete(part)
    spec.modelfiledir = str(place)
    try:
        spec.compile()
        (place / "model.xml").write_text(spec.to_xml(), encoding="utf-8")
    except ValueError as error:
        raise _refused(source, error) from error
    (place / "robot.toml").write_text(written(told, source.name), encoding="utf-8")


def _copied(file: Path, folder: Path, taken: dict[str, str]) -> str:
    """The name in a folder of a file that is copied there, once; several may be called alike."""
    if str(file) not in taken:
        name, number = file.name, 1
        while name in taken.values():
            name, number = f"{file.stem}_{number}{file.suffix}", number + 1
        folder.mkdir(exist_ok=True)
        shutil.copyfile(file, folder / name)
        taken[str(file)] = name
    return taken[str(file)]
