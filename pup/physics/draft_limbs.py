"""What is alike on both sides of a drafted robot, and which of its links are feet."""

import mujoco
import numpy as np

from pup.robot_draft import partner

REFLECTED = 0.99
"""Least cosine of a joint's axis and the mirror image of its partner's."""
ASIDE = 0.01
"""Distance by which a joint may stand beside the mirror image of its partner, m."""
LEVEL = 0.15
"""Feet reach down as far as the lowest point, to this share of the robot's height."""


def mirror_map(
    model: mujoco.MjModel,
    at: mujoco.MjData,
    ids: list[int],
    torso: str | None,
    notes: list[str],
) -> list[tuple[str | None, float]]:
    """The partner of each joint on the other side, and the sign of its angle; none without.

    Names tell partners. Their axes must be mirror images in the torso's x-z plane.
    """
    none: list[tuple[str | None, float]] = [(None, 1.0)] * len(ids)
    if torso is None:
        return none
    body = model.body(torso).id
    frame, origin = at.xmat[body].reshape(3, 3), at.xpos[body]
    names = {model.joint(j).name: j for j in ids}
    told: list[tuple[str | None, float]] = []
    for name, joint in names.items():
        other = names.get(partner(name))
        if other is None:
            notes.append(f"no mirror map: {name} has no {partner(name)}")
            return none
        flip = np.array([1.0, -1.0, 1.0])
        image = frame.T @ at.xaxis[joint] * flip
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE:
            image = -image  # what turns is mirrored the other way
        alike = float(image @ (frame.T @ at.xaxis[other]))
        apart = (frame.T @ (at.xanchor[joint] - origin)) * flip
        apart -= frame.T @ (at.xanchor[other] - origin)
        aside = np.linalg.norm(np.cross(apart, image))  # along its axis a joint may stand anywhere
        if abs(alike) < REFLECTED or aside > ASIDE:
            notes.append(f"no mirror map: {name} and {model.joint(other).name} are no mirror image")
            return none
        told.append((model.joint(other).name, float(np.sign(alike))))
    return told


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
