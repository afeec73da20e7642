"""A robot's bodies over time, drawn in Rerun by the joints' positions."""

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
import rerun as rr

from pup.exporters.common import Array
from pup.physics.model import Model, compile_model, standing_qpos, tilted
from pup.robot import RobotDescription

TIMELINE = "time"
Look = dict[str, Any]
"""Colour and fill mode, as Rerun's shapes take them."""


def draw_bodies(
    stream: rr.RecordingStream,
    robot: RobotDescription,
    support: str,
    columns: Mapping[str, Array],
    entity: Sequence[str],
    look: Look,
) -> None:
    """Draw the robot in every row in which all its joints are known; nothing where none is so.

    On the ground it stands with its lowest point on the floor and leans as the IMU says, or with
    its feet flat; where it went to is in no recording.

    Args:
      stream: gets an entity for each body.
      robot: of the recording.
      support: of the recording.
      columns: of the recording or of its replay, with the time.
      entity: path above the bodies.
      look: of the bodies.
    """
    model = compile_model(robot, support)
    position = np.stack([columns[f"position/{name}"] for name in robot.joint_names], axis=1)
    rows = np.flatnonzero(~np.isnan(position).any(axis=1))
    if not len(rows):
        return
    places, turns = _poses(robot, model, position[rows], _tilt(columns)[rows])
    time = rr.TimeColumn(TIMELINE, duration=(columns["time"] - columns["time"][0])[rows])
    for body in range(1, model.compiled.nbody):
        path = rr.new_entity_path([*entity, model.compiled.body(body).name])
        stream.send_columns(
            path,
            indexes=[time],
            columns=rr.Transform3D.columns(
                translation=places[:, body], quaternion=np.roll(turns[:, body], -1, axis=1)
            ),
        )
        for geom in np.flatnonzero(model.compiled.geom_bodyid == body):
            shape = _shape(model.compiled, int(geom), look)
            if shape is not None:
                stream.log(f"{path}/{geom}", shape, static=True)


def _tilt(columns: Mapping[str, Array]) -> Array:
    """Roll and pitch, shape (n_rows, 2), rad; NaN where they are not known."""
    unknown = np.full(len(columns["time"]), np.nan)
    return np.stack([columns.get(f"imu/{angle}", unknown) for angle in ("roll", "pitch")], axis=1)


def _poses(
    robot: RobotDescription, model: Model, position: Array, tilt: Array
) -> tuple[Array, Array]:
    """Places (n_rows, n_bodies, 3), m, and orientations (n_rows, n_bodies, 4) of all bodies."""
    data = mujoco.MjData(model.compiled)
    places, turns = [], []
    for joints, (roll, pitch) in zip(position, tilt, strict=True):
        data.qpos[:] = standing_qpos(robot, model, joints, tilted(robot, model, roll, pitch))
        mujoco.mj_kinematics(model.compiled, data)
        places.append(data.xpos.copy())
        turns.append(data.xquat.copy())
    return np.array(places), np.array(turns)


def _shape(model: mujoco.MjModel, geom: int, look: Look) -> rr.AsComponents | None:
    """A geom in its body's frame; None for a kind that no body has."""
    size, at = model.geom_size[geom], model.geom_pos[geom]
    quaternion = model.geom_quat[geom]
    placed = {"quaternions": [np.roll(quaternion, -1)], **look}
    kind = mujoco.mjtGeom(int(model.geom_type[geom]))
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return rr.Boxes3D(half_sizes=[size], centers=[at], **placed)
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return rr.Ellipsoids3D(radii=[size[0]], centers=[at], **placed)
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return rr.Ellipsoids3D(half_sizes=[size], centers=[at], **placed)
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return rr.Cylinders3D(lengths=[2 * size[1]], radii=[size[0]], centers=[at], **placed)
    flat = np.zeros(9)
    mujoco.mju_quat2Mat(flat, quaternion)
    axes = flat.reshape(3, 3)
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:  # Rerun's begins at one of its two centres
        end = at - size[1] * axes[:, 2]
        return rr.Capsules3D(lengths=[2 * size[1]], radii=[size[0]], translations=[end], **placed)
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.mesh(int(model.geom_dataid[geom]))
        first, count = int(mesh.vertadr[0]), int(mesh.vertnum[0])
        face, faces = int(mesh.faceadr[0]), int(mesh.facenum[0])
        return rr.Mesh3D(
            vertex_positions=model.mesh_vert[first : first + count] @ axes.T + at,
            triangle_indices=model.mesh_face[face : face + faces],
            albedo_factor=look["colors"],
        )
    return None
