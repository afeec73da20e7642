"""What is alike on both sides of a drafted robot, and which of its links are feet."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from pup.drafting.description import partner

Array = NDArray[np.float64]

REFLECTED = 0.99
"""Least cosine of a joint's axis and the mirror image of its partner's."""
ASIDE = 0.01
"""Distance by which a joint may stand beside the mirror image of its partner, m."""
MIDDLE = 0.02
"""A joint in the middle is off the mid-plane by no more than this share of the robot's height."""
FORWARD_X, FORWARD_Y = np.array([1.0, -1.0, 1.0]), np.array([-1.0, 1.0, 1.0])
"""What mirrors a robot that faces along x, or y."""
LEVEL = 0.15
"""Feet reach down as far as the lowest point, to this share of the robot's height."""


def mirror_map(
    model: mujoco.MjModel, ids: list[int], torso: str | None, notes: list[str]
) -> list[tuple[str | None, float]]:
    """The partner of each joint on the other side, and the sign of its angle; none without.

    Names tell partners. At the model's reference pose their axes must be mirror images in the
    torso's x-z plane, and a joint that is its own partner must stand in it.
    """
    none: list[tuple[str | None, float]] = [(None, 1.0)] * len(ids)
    if torso is None:
        return none
    at = mujoco.MjData(model)
    mujoco.mj_forward(model, at)
    names = {model.joint(j).name: j for j in ids}
    alone = next((name for name in names if partner(name) not in names), None)
    if alone is not None:
        notes.append(f"no mirror map: {alone} has no {partner(alone)}")
        return none
    pairs = {joint: names[partner(name)] for name, joint in names.items()}
    signs = {pair: _mirrored(model, at, torso, pair, FORWARD_X) for pair in pairs.items()}
    wrong = next((pair for pair, sign in signs.items() if sign == 0), None)
    if wrong is None:
        return [(model.joint(other).name, sign) for (_, other), sign in signs.items()]
    one, other = (model.joint(j).name for j in wrong)
    told = "its mirror image are apart" if one == other else f"{other} are no mirror images"
    notes.append(f"no mirror map: {one} and {told}")
    if all(_mirrored(model, at, torso, pair, FORWARD_Y) for pair in pairs.items()):
        notes.append("it faces along y: turn the model, as forward must be +x")
    return none


def _mirrored(
    model: mujoco.MjModel, at: mujoco.MjData, torso: str, pair: tuple[int, int], flip: Array
) -> float:
    """The sign of a joint's angle in the mirror, where its partner is its image; else 0."""
    joint, other = pair
    frame, origin = at.body(torso).xmat.reshape(3, 3), at.body(torso).xpos
    image = frame.T @ at.xaxis[joint] * flip
    if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE:
        image = -image  # what turns is mirrored the other way
    alike = float(image @ (frame.T @ at.xaxis[other]))
    apart = (frame.T @ (at.xanchor[joint] - origin)) * flip
    apart -= frame.T @ (at.xanchor[other] - origin)
    aside = float(np.linalg.norm(np.cross(apart, image)))  # along its axis it may stand anywhere
    if joint == other:
        places = at.xanchor[joint], at.subtree_com[model.jnt_bodyid[joint]]
        across = frame[:, np.argmin(flip)]
        off = min(abs(float(across @ (place - origin))) for place in places)
        if off > max(ASIDE, MIDDLE * height_of(model, at)):
            return 0.0
    return 0.0 if abs(alike) < REFLECTED or aside > ASIDE else float(np.sign(alike))


def feet_of(model: mujoco.MjModel, at: mujoco.MjData) -> tuple[str, ...]:
    """Of the last links, those that reach down to where the robot stands: the bodies that do."""
    moved = {int(model.jnt_bodyid[j]) for j in range(model.njnt)}
    inner = set()
    for body in moved:
        above = int(model.body_parentid[body])
        while above:
            inner.add(above)
            above = int(model.body_parentid[above])
    lowest: dict[int, tuple[float, int]] = {}
    for geom in range(model.ngeom):
        body = link = int(model.geom_bodyid[geom])
        touches = model.geom_contype[geom] or model.geom_conaffinity[geom]
        while link and link not in moved:
            link = int(model.body_parentid[link])
        if link and link not in inner and touches:
            lowest[link] = min(lowest.get(link, (np.inf, 0)), (_bottom(model, at, geom), body))
    if not lowest:
        return ()
    low = min(lowest.values())[0]
    height = max(float(at.xpos[_own(model), 2].max()) - low, 1e-3)
    reaching = [body for _, (z, body) in sorted(lowest.items()) if z < low + LEVEL * height]
    return tuple(model.body(body).name for body in reaching)


def _bottom(model: mujoco.MjModel, at: mujoco.MjData, geom: int) -> float:
    """The lowest point of a geom's box, m."""
    centre, half = model.geom_aabb[geom][:3], model.geom_aabb[geom][3:]
    turn = at.geom_xmat[geom].reshape(3, 3)
    return float((at.geom_xpos[geom] + turn @ centre)[2] - np.abs(turn[2]) @ half)


def height_of(model: mujoco.MjModel, at: mujoco.MjData) -> float:
    """From the lowest of a robot's links to the highest, m."""
    return float(np.ptp(at.xpos[_own(model), 2]))


def _own(model: mujoco.MjModel) -> list[int]:
    """The links of the robot, not of what stands around it."""
    roots = {int(model.body_rootid[model.jnt_bodyid[j]]) for j in range(model.njnt)}
    return [b for b in range(1, model.nbody) if int(model.body_rootid[b]) in roots]
