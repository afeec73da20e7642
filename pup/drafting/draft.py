"""A robot's folder drafted from the model that a laboratory has already, MJCF or URDF.

MuJoCo reads both. What it knows of joints, servos and contact is written down as `robot.toml`; what
no model tells is guessed, and told as such.
"""

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from pup.drafting.base import (
    add_soles,
    free_base,
    heavy_part,
    imu_site,
    level_floor,
    part_neighbours,
    standing,
)
from pup.drafting.description import Draft, groups_of, written
from pup.drafting.files import take_along
from pup.drafting.limbs import feet_of, mirror_map
from pup.drafting.numbers import limits_of, parameters, servo_of
from pup.drafting.spec import compiled, fitting, read_spec, refusals
from pup.errors import InputError
from pup.files import write_atomic
from pup.physics.model import compile_model
from pup.robot import RobotDescription
from pup.robot_mjcf import check_path
from pup.robot_parts import Joint
from pup.robot_toml import NAME

Array = NDArray[np.float64]

KINDS = (".xml", ".urdf")
MESHES = "assets"
WORLD_WIDE = np.pi
"""Limit of a joint without a range, rad, or m."""
NAMELESS = ("", "MuJoCo Model")
"""What MuJoCo calls a model without a name."""
USUAL, STEPS = 0.002, (0.0005, 0.005)
"""The physics step of a robot.toml without one, and what is kept of a model's own, s."""


@dataclass(frozen=True)
class Drafted:
    """What came of a model.

    Attributes:
      robot: as its folder reads.
      notes: what was guessed, or is for the user to see to.
    """

    robot: RobotDescription
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Key:
    """A key frame of the model.

    Attributes:
      name: empty without one.
      qpos: of each joint, by name.
    """

    name: str
    qpos: dict[str, Array]


def draft_robot(source: Path, folder: Path, name: str = "", free: bool = False) -> Drafted:
    """Write a robot's folder for a model.

    Args:
      source: MJCF or URDF.
      folder: where to write; no file of the robot may be there yet.
      name: of the robot; empty for the model's own.
      free: whether to let the base move, as a URDF does not tell, and to put a floor under it.

    Raises:
      InputError: MuJoCo refuses the model, it has no joint that a servo could drive, or a file
        would be overwritten.
    """
    if not source.is_file():
        raise InputError(f"{source}: no such file; name an MJCF or a URDF file")
    for path in (source, folder):
        check_path(path)
    if not os.access(source, os.R_OK):
        raise InputError(f"{source}: cannot be read; change its rights")
    if source.suffix.lower() not in KINDS:
        raise InputError(f"{source}: name an MJCF file (.xml) or a URDF file (.urdf)")
    if b"<xacro:" in source.read_bytes():
        told = f"describe what `xacro {source.name} > robot.urdf` makes of it"
        raise InputError(f"{source}: is a source of xacro; {told}")
    if name and not NAME.fullmatch(name):
        raise InputError(f"--name: {name!r} is no name; use letters, digits, '_', '.' and '-'")
    _refuse_to_overwrite(folder, [Path("robot.toml"), Path("model.xml")])
    with tempfile.TemporaryDirectory() as place, refusals(source):
        notes = _drafted(source, Path(place), name, free)
        _check(source, Path(place))
        files = [f.relative_to(place) for f in sorted(Path(place).rglob("*")) if f.is_file()]
        _refuse_to_overwrite(folder, files)
        for file in files:
            write_atomic(folder / file, (Path(place) / file).read_bytes())
    return Drafted(RobotDescription.load(folder), notes)


def _refuse_to_overwrite(folder: Path, files: list[Path]) -> None:
    there = next((file for file in files if (folder / file).exists()), None)
    if there is not None:
        raise InputError(f"{folder}: holds a {there} already; give another --out")


def _check(source: Path, place: Path) -> None:
    """Refuse a model of which pup cannot read what came of it, by the name that the user knows."""
    try:
        robot = RobotDescription.load(place)
        compile_model(robot, "ground" if robot.floating else "bench")
    except InputError as error:
        told = str(error).replace(f"{place}/", "")
        raise InputError(f"{source}: what comes of it is refused: {told}") from error


def _drafted(source: Path, place: Path, name: str, free: bool) -> tuple[str, ...]:
    """Write the robot's folder to a place of its own; the notes."""
    notes: list[str] = []
    spec = read_spec(source, notes)
    keys = _keys(compiled(spec, notes)) if spec.keys else []
    for key in list(spec.keys):
        spec.delete(key)  # it fits the model with all its joints
    base = free_base(spec, source, free, notes)
    torso = None if base is None else str(base.name)
    model = compiled(spec, notes)
    at = standing(model, keys[0].qpos if keys else {})
    feet = feet_of(model, at) if torso is not None else ()
    site = None
    if torso is not None:
        level_floor(spec, model, notes)
        site = imu_site(spec, model, torso, notes)
        _tell_feet(feet, notes)
        add_soles(spec, model, at, feet, notes)
        part_neighbours(spec, model, at, notes)
    ids = [j for j in range(model.njnt) if model.jnt_type[j] != mujoco.mjtJoint.mjJNT_FREE]
    driven = {j: servo_of(model, at, j, torso is not None) for j in ids}
    groups = groups_of(
        [model.joint(j).name for j in ids],
        lambda a, b: (
            model.jnt_type[ids[a]] == model.jnt_type[ids[b]] and driven[ids[a]].like(driven[ids[b]])
        ),
    )
    heavy = None if torso is None else _heavy(model, torso, notes)
    joints = _joints(model, ids, groups, torso, notes)
    told = Draft(
        name=name or _named(spec, source),
        joints=joints,
        parameters=parameters(model, at, driven, groups, heavy, notes),
        torso=torso,
        imu_site=site,
        feet=feet,
        poses=_poses(keys, joints, torso is not None, notes),
        timestep=_timestep(model),
        notes=tuple(notes),
    )
    _write(spec, told, source, place)
    return told.notes


def _keys(model: mujoco.MjModel) -> list[Key]:
    """The key frames, joint by joint: what is deleted of the model changes their length."""
    data = mujoco.MjData(model)
    keys = []
    for key in range(model.nkey):
        data.qpos = model.key_qpos[key]
        joints = [data.joint(j) for j in range(model.njnt)]
        keys.append(Key(model.key(key).name, {j.name: j.qpos.copy() for j in joints}))
    return keys


def _named(spec: mujoco.MjSpec, source: Path) -> str:
    name = source.stem if spec.modelname in NAMELESS else spec.modelname
    return fitting(name) or "robot"


def _timestep(model: mujoco.MjModel) -> float | None:
    step = float(model.opt.timestep)
    return step if step != USUAL and STEPS[0] <= step <= STEPS[1] else None


def _tell_feet(feet: tuple[str, ...], notes: list[str]) -> None:
    if feet:
        notes.append(f"feet are taken to be {', '.join(feet)}; a walking robot needs a [gait] too")
    else:
        notes.append("no feet are found: name the bodies that are meant to touch the floor")


def _heavy(model: mujoco.MjModel, torso: str, notes: list[str]) -> str:
    """What the parameters of the torso's centre of mass are called."""
    body = heavy_part(model, torso, notes)
    return "torso_com" if body == torso else f"com/{body}"


def _joints(
    model: mujoco.MjModel, ids: list[int], groups: list[str], torso: str | None, notes: list[str]
) -> tuple[Joint, ...]:
    names = [model.joint(j).name for j in ids]
    known = [limits_of(model, j) for j in ids]
    if None in known:
        free = [n for n, told in zip(names, known, strict=True) if told is None]
        notes.append(f"no range, so that the limits are made up: {', '.join(free)}")
    limits = [told or (-WORLD_WIDE, WORLD_WIDE) for told in known]
    mirror = mirror_map(model, ids, torso, notes)
    return tuple(
        Joint(n, None, group, low, high, *other)
        for n, group, (low, high), other in zip(names, groups, limits, mirror, strict=True)
    )


def _poses(
    keys: list[Key], joints: tuple[Joint, ...], free: bool, notes: list[str]
) -> dict[str, tuple[float, ...]]:
    """Joint angles of the key frames by name; the first one without a name is `home`."""
    poses: dict[str, tuple[float, ...]] = {}
    for key in sorted(keys, key=lambda key: not key.name):
        pose = fitting(key.name) or "home"
        if pose in poses:
            continue
        angles = [float(key.qpos[joint.name][0]) for joint in joints]
        poses[pose] = tuple(
            min(max(angle, joint.lower), joint.upper)
            for angle, joint in zip(angles, joints, strict=True)
        )
        clipped = zip(joints, angles, poses[pose], strict=True)
        beyond = [joint.name for joint, asked, given in clipped if asked != given]
        if beyond:
            notes.append(f"pose {pose}: beyond their limits, and clipped: {', '.join(beyond)}")
    if "stand" not in poses and "home" in poses and free:
        poses["stand"] = poses["home"]
    return poses


def _write(spec: mujoco.MjSpec, told: Draft, source: Path, place: Path) -> None:
    """Write `model.xml`, its meshes and `robot.toml`."""
    folder = MESHES if take_along(spec, place / MESHES) else ""
    spec.compiler.meshdir = spec.compiler.texturedir = folder
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    spec.modelfiledir = str(place)
    spec.compile()
    (place / "model.xml").write_text(spec.to_xml(), encoding="utf-8")
    (place / "robot.toml").write_text(written(told, source.name), encoding="utf-8")
