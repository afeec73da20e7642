"""Robots of one joint, whose motion has a closed law that needs no engine.

With its base fixed and nothing to touch, the forces that turn a hinge's link are a constant and a
sine of its angle, and those on a slide are a constant: gravity, wrenches on the bodies, whatever a
model's fields make of them. MuJoCo tells them in three poses, and they are held against it in two
more; a model that has more to it, such as a spring or dry friction, is left to MuJoCo, and so is a
simulation that is beyond its joint's range or breaks down. A sub-step of one simulation takes
MuJoCo a microsecond, nearly all of it for what such a robot does not have.
"""

import math
from typing import Self

import mujoco
import mujoco.batch
import numpy as np

from pup.physics.kernels import Array, Ids, Mask, kernel

POSES = np.array([0.0, 2 * np.pi / 3, 4 * np.pi / 3])
"""Where forces are asked for, rad or m."""
ELSEWHERE = ((0.3, 0.7), (0.8, -1.3))
"""Where they are held against MuJoCo: share of the joint's range, and velocity, rad/s or m/s."""
AGREED = 1e-9
"""Difference that is rounding, relative."""
SOUND = 1e9
"""Positions, velocities and accelerations beyond are MuJoCo's to judge."""


class OneJoint:
    """Moves simulations of a robot of one joint on, in the arrays that are bound to their batch.

    Args:
      batch: the simulations; all their model fields are written.
      forces: constant, cosine's and sine's part of what turns the joint, N m (of a slide: N),
        shape (n_simulations, 3).
      inertia: of the joint, kg m² (kg), shape (n_simulations, 1).
      ranges: of the joint, rad (m), shape (n_simulations, 2).
    """

    def __init__(
        self, batch: mujoco.batch.Batch, forces: Array, inertia: Array, ranges: Array
    ) -> None:
        self.batch = batch
        self.forces, self.inertia, self.ranges = forces, inertia, ranges
        self.qpos, self.qvel = batch.bind("qpos"), batch.bind("qvel")
        self.force, self.damping = batch.bind("qfrc_applied"), batch.expand("dof_damping")
        self.timestep = float(batch.model.opt.timestep)
        self.ids = np.arange(len(inertia), dtype=np.int32)
        self.left = np.zeros((len(inertia), 1), dtype=np.bool_)

    @classmethod
    def of(cls, batch: mujoco.batch.Batch) -> Self | None:
        """What moves a batch; None where its law of motion is not of this form."""
        model = batch.model
        if model.nv != 1 or model.nq != 1 or model.ntendon:  # tendons may pull in some poses only
            return None
        qpos, qvel, applied = (batch.bind(name) for name in ("qpos", "qvel", "qfrc_applied"))
        smooth, inertia, rows = (batch.bind(name) for name in ("qfrc_smooth", "M", "nefc"))
        damping = batch.expand("dof_damping")
        kept = [(array, array.copy()) for array in (qpos, qvel, applied)]
        ranges = _ranges(batch)
        hinge = model.jnt_type[0] == mujoco.mjtJoint.mjJNT_HINGE

        def told(pose: Array | float, speed: float) -> Array:
            qpos[:], qvel[:] = pose, speed
            batch.forward()
            return np.asarray(smooth[:, 0] + damping[:, 0] * speed)

        applied[:] = 0.0
        at = np.stack([told(pose, 0.0) for pose in POSES], axis=1)
        own = inertia.copy()
        forces = at @ np.linalg.inv(_waves(POSES)).T if hinge else at * [1.0, 0.0, 0.0]
        inside = np.clip(ranges, -np.pi, np.pi)
        holds = True
        for share, speed in ELSEWHERE:
            pose = inside[:, :1] + share * (inside[:, 1:] - inside[:, :1])
            seen = told(pose, speed)
            foretold = (_waves(pose[:, 0]) * forces).sum(axis=1)
            size = 1 + np.abs(at).max(axis=1)
            holds &= bool((np.abs(seen - foretold) < AGREED * size).all())
            holds &= bool((np.abs(inertia - own) < AGREED * own).all() and not rows.any())
        for array, before in kept:
            array[:] = before
        return cls(batch, forces, own, ranges) if holds else None

    def step(self, ids: Ids | None = None) -> None:
        """Move simulations on by one sub-step; see `mujoco.batch.Batch.step`.

        Raises:
          mujoco.batch.SimulationError: as that does, for those that have broken down.
        """
        chosen = self.ids if ids is None else ids
        left = self.left[: len(chosen)]
        advance(
            self.qpos,
            self.qvel,
            self.force,
            self.damping,
            self.forces,
            self.inertia,
            self.ranges,
            chosen,
            left,
            self.timestep,
        )
        if left.any():
            self.batch.step(ids=chosen[left[:, 0]])


def _ranges(batch: mujoco.batch.Batch) -> Array:
    """Positions between which no limit acts, shape (n_simulations, 2)."""
    if not batch.model.jnt_limited[0]:
        return np.tile([-np.inf, np.inf], (batch.nsim, 1))
    margin = np.asarray(batch.expand("jnt_margin"))
    return np.asarray(batch.expand("jnt_range")[:, 0] + margin * [1.0, -1.0])


def _waves(angle: Array) -> Array:
    """One, cosine and sine of some angles, shape (n, 3)."""
    return np.stack([np.ones_like(angle), np.cos(angle), np.sin(angle)], axis=-1)


@kernel
def advance(
    qpos: Array,
    qvel: Array,
    force: Array,
    damping: Array,
    forces: Array,
    inertia: Array,
    ranges: Array,
    ids: Ids,
    left: Mask,
    timestep: float,
) -> None:
    """One sub-step as MuJoCo's `implicitfast` takes it: velocity first, damped by what it becomes.

    Args:
      qpos: position, rad or m; changed in place, like the velocity.
      qvel: its velocity, per s.
      force: applied, N m or N.
      damping: times the velocity at the sub-step's end.
      forces: see OneJoint; like the next two.
      inertia: of the joint.
      ranges: of the joint.
      ids: the simulations to move, shape (n,).
      left: whether each is left to MuJoCo, shape (n, 1); written.
      timestep: s.
    """
    for k in range(len(ids)):
        i = ids[k]
        position, velocity = qpos[i, 0], qvel[i, 0]
        total = forces[i, 0] + force[i, 0] - damping[i, 0] * velocity
        if forces[i, 1] != 0.0 or forces[i, 2] != 0.0:
            total += forces[i, 1] * math.cos(position) + forces[i, 2] * math.sin(position)
        gained = timestep * total / (inertia[i, 0] + timestep * damping[i, 0])
        within = ranges[i, 0] <= position <= ranges[i, 1]
        sound = abs(position) < SOUND and abs(velocity) < SOUND
        left[k, 0] = not (within and sound and abs(total) < SOUND * inertia[i, 0])
        if not left[k, 0]:
            qvel[i, 0] = velocity + gained
            qpos[i, 0] = position + timestep * qvel[i, 0]
