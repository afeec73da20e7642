"""What a drafted robot stands on and by: its free body, the floor, the soles, and its IMU."""

from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from pup.drafting.description import words_of
from pup.drafting.spec import of_type, some, unique
from pup.errors import InputError
from pup.physics.model import FLOOR, LEVEL
from pup.physics.rotations import CONJUGATE
from pup.robot_stance import sole_of

Array = NDArray[np.float64]

SQUARE = np.cos(np.radians(20.0) / 2)
"""An IMU's site that is turned further in the torso is turned as its chip is."""
UPRIGHT = np.cos(np.radians(5.0))
"""A foot whose z axis leans further where the robot stands has a sole of its own."""
SOLES = 2
"""Feet of a robot that stands by their soles, at most; more stand by where they are."""
EMPTY = 0.01
"""A torso that weighs less than this share of what is fixed to it is but a frame."""


def free_base(
    spec: mujoco.MjSpec, source: Path, free: bool, notes: list[str]
) -> mujoco.MjsBody | None:
    """The body that is free; None for a fixed base. What else moves is deleted.

    Raises:
      InputError: several robots are free, one hangs on something, or the model has no base link to
        let go.
    """
    loose = [joint.parent for joint in of_type(spec, mujoco.mjtJoint.mjJNT_FREE)]
    for body in loose:
        if body.parent.name != "world":
            raise InputError(
                f"{source}: {body.name!r} is free, but hangs on {body.parent.name!r}; nothing may "
                "be above a free body: leave that out"
            )
    robots = [body for body in loose if any(_driven(below) for below in _below(body))]
    if len(robots) > 1:
        bodies = ", ".join(body.name for body in robots)
        raise InputError(f"{source}: more than one robot is free ({bodies}); leave the others out")
    torso = robots[0] if robots else _let_go(spec, source) if free else None
    if torso is None:
        notes.append("the base is fixed; --free lets it move and puts a floor under it")
    others = [body for body in loose if torso is None or body.name != torso.name]
    if torso is not None:  # the engine looks for the torso at the head of all that moves
        own = {torso.name, *(body.name for body in others)}
        trees = [body for body in spec.worldbody.bodies if body.name not in own]
        others += [t for t in trees if t.mocap or any(below.joints for below in _below(t))]
    if others:
        notes.append(f"not of the robot, and left out: {some([body.name for body in others])}")
    for body in others:
        spec.delete(body)
    return torso


def level_floor(spec: mujoco.MjSpec, model: mujoco.MjModel, notes: list[str]) -> None:
    """Have a level plane of the world called `floor`, and nothing else.

    Args:
      spec: the model, which loses its height fields.
      model: compiled from it; nothing has been changed since, as that takes the geoms' numbers.
      notes: told of what is lost.
    """
    at = standing(model, {})
    geoms = {geom.id: geom for geom in spec.geoms if geom.id >= 0}  # others are for the eye
    flat = [g for g in geoms if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_PLANE]
    level = [g for g in flat if at.geom_xmat[g][8] >= LEVEL]
    # The engine asks a floor how it lies, which one inside a body tells only of the body.
    own = [g for g in level if model.geom_bodyid[g] == 0]
    inside = [g for g in level if g not in own]
    floor = next((g for g in own if geoms[g].name == FLOOR), own[0] if own else None)
    taken = {geom.name for geom in geoms.values()}
    for g, geom in geoms.items():
        if geom.name == FLOOR and g != floor:
            _rename(spec, geom, unique(f"{FLOOR}_too", taken))
    if floor is None:
        ground = _plane(spec, float(at.geom_xpos[inside[0]][2]) if inside else 0.0)
    else:
        ground = geoms[floor]
        _rename(spec, ground, FLOOR)
    ground.priority = 1
    for g in inside:
        _follow(spec, geoms[g].name, FLOOR)
        spec.delete(geoms[g])
    _leave_out_fields(spec, notes)


def _plane(spec: mujoco.MjSpec, height: float) -> mujoco.MjsGeom:
    """A new floor, m; the model's defaults may be of shapes that do not touch."""
    return spec.worldbody.add_geom(
        name=FLOOR,
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[10.0, 10.0, 0.1],
        pos=[0.0, 0.0, height],
        contype=1,
        conaffinity=1,
    )


def _leave_out_fields(spec: mujoco.MjSpec, notes: list[str]) -> None:
    rough = [geom for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_HFIELD]
    if rough:
        notes.append("the floor is level: the model's height fields are left out")
    for geom in rough:
        spec.delete(geom)
    for field in list(spec.hfields):
        spec.delete(field)


def imu_site(spec: mujoco.MjSpec, model: mujoco.MjModel, torso: str, notes: list[str]) -> str:
    """A site for the IMU: the model's own, where its link is, or the torso's origin.

    Args:
      spec: the model.
      model: compiled from it.
      torso: the free body; what is fixed to it counts as well.
      notes: told of a guess.
    """
    at = standing(model, {})
    frame, origin = at.body(torso).xmat.reshape(3, 3), at.body(torso).xpos
    fixed = fixed_to(model, torso)
    sites = [s for s in range(model.nsite) if model.site_bodyid[s] in fixed]
    sites = [s for s in sites if "imu" in words_of(model.site(s).name)]
    for site in sites:
        turn = np.empty(4)
        mujoco.mju_mat2Quat(turn, (frame.T @ at.site_xmat[site].reshape(3, 3)).ravel())
        if abs(turn[0]) >= SQUARE:
            return str(model.site(site).name)
    links = [b for b in fixed if "imu" in words_of(model.body(b).name)]
    places = [at.site_xpos[s] for s in sites] + [at.xpos[b] for b in links] + [origin]
    told = "where the model has it" if sites or links else "at the torso's origin"
    notes.append(f"the IMU is taken to be {told}, turned as the torso is")
    name = unique("torso_imu", {site.name for site in spec.sites})
    spec.body(torso).add_site(name=name, pos=frame.T @ (places[0] - origin))
    return name


def fixed_to(model: mujoco.MjModel, torso: str) -> list[int]:
    """A free body and those that are rigidly fixed to it, by number."""
    welded = model.body_weldid
    return [b for b in range(model.nbody) if welded[b] == welded[model.body(torso).id]]


def heavy_part(model: mujoco.MjModel, torso: str, notes: list[str]) -> str:
    """The torso, or what is fixed to it and weighs where the torso is but a frame."""
    heaviest = max(fixed_to(model, torso), key=lambda body: float(model.body_mass[body]))
    if model.body(torso).mass[0] >= EMPTY * model.body_mass[heaviest]:
        return torso
    told = str(model.body(heaviest).name)
    notes.append(f"{torso} weighs nothing: the centre of mass to be found is that of {told}")
    return told


def add_soles(
    spec: mujoco.MjSpec,
    model: mujoco.MjModel,
    at: mujoco.MjData,
    feet: tuple[str, ...],
    notes: list[str],
) -> None:
    """Tell the soles of feet whose z axes never point up: where the robot stands, or as written."""
    poses = at, standing(model, {})
    turned = [foot for foot in feet if all(d.body(foot).xmat[8] < UPRIGHT for d in poses)]
    if len(feet) > SOLES or not turned:
        return
    known = {site.name for site in spec.sites}
    for foot in turned:
        if sole_of(foot) not in known:
            spec.body(foot).add_site(name=sole_of(foot), quat=at.body(foot).xquat * CONJUGATE)
    notes.append(f"level where the robot stands in the model: the soles of {', '.join(turned)}")


def part_neighbours(
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
    named = [(model.body(a).name, model.body(b).name) for a, b in sorted(pairs)]
    parted = [names for names in named if frozenset(names) not in known]
    for one, other in parted:
        spec.add_exclude(bodyname1=one, bodyname2=other)
    if parted:
        told = some([" and ".join(names) for names in parted])
        notes.append(f"made not to touch, as they overlap where it stands: {told}")


def standing(model: mujoco.MjModel, key: dict[str, Array]) -> mujoco.MjData:
    """The model with some joints where a key frame has them, the others as it is written."""
    data = mujoco.MjData(model)
    for name, qpos in key.items():
        if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) >= 0:
            data.joint(name).qpos = qpos
    mujoco.mj_forward(model, data)
    return data


def _let_go(spec: mujoco.MjSpec, source: Path) -> mujoco.MjsBody:
    torso = max(spec.worldbody.bodies, key=lambda body: len(list(_below(body))))
    if torso.joints:
        raise InputError(
            f"{source}: its first link {torso.name!r} has a joint of its own; the model has no "
            "base link that --free could let go: give it one, or leave --free out"
        )
    torso.add_freejoint()
    return torso


def _below(body: mujoco.MjsBody) -> Iterator[mujoco.MjsBody]:
    """A body and all that hangs on it."""
    yield body
    for child in body.bodies:
        yield from _below(child)


def _driven(body: mujoco.MjsBody) -> bool:
    return any(joint.type != mujoco.mjtJoint.mjJNT_FREE for joint in body.joints)


def _rename(spec: mujoco.MjSpec, geom: mujoco.MjsGeom, name: str) -> None:
    """Rename a geom, also where a pair of geoms that may touch names it."""
    old, geom.name = geom.name, name
    _follow(spec, old, name)


def _follow(spec: mujoco.MjSpec, old: str, name: str) -> None:
    """Let pairs of geoms name another one."""
    for pair in spec.pairs if old else ():
        pair.geomname1 = name if pair.geomname1 == old else pair.geomname1
        pair.geomname2 = name if pair.geomname2 == old else pair.geomname2
