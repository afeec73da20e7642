"""From a robot's description to a compiled MuJoCo model, and the pose a recording starts in."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import mujoco
import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.physics.rest import Units, at_rest, ticks_at_rest
from pup.physics.rotations import CONJUGATE, multiply
from pup.physics.stopwatch import put_away
from pup.recording import Recording
from pup.robot import RobotDescription
from pup.robot_stance import floor_normal, sole_of

Array = NDArray[np.float64]
Selection = slice | NDArray[np.int64]

FLOOR = "floor"
"""Name of the floor's geom in a robot's MJCF; its friction is the ground's (priority 1)."""

# A simulation that breaks down is told by its trajectories, a model that is wrong by an exception.
# MuJoCo would also print each, and write MUJOCO_LOG.TXT to wherever the user stands.
_log = mujoco.MjLogConfig.get()
_log.logto_console = _log.logto_file = False
_log.set()
put_away()


@dataclass(frozen=True)
class Model:
    """A compiled model and where the robot's joints stand in it.

    Attributes:
      compiled: the MuJoCo model, without actuators: the engine applies joint torques.
      qpos: where the joints' positions stand in qpos, in the robot's order.
      dofs: where their velocities stand in qvel.
      floating: whether the torso is free.
      contacts: geoms that say how the floor feels, each with its place: the feet in their order,
        then the floor, for all else that falls on it.
    """

    compiled: mujoco.MjModel
    qpos: Selection
    dofs: Selection
    floating: bool
    contacts: tuple[tuple[int, int], ...]


DRIVEN = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
BEYOND, MARGIN = 2.0, 0.5
"""Limits of a hinge in robot.toml may be so many times the larger end of its range in the MJCF, and
so much more, rad; degrees beside radians are further apart."""
LEVEL = 1 - 1e-9
"""Least vertical part of the normal of a floor that is level."""
TURNS = 4 * np.pi
"""Limits that a hinge without a range may have, rad."""
ASKEW = 20.0
"""Degrees by which a walking robot's IMU may be turned in the torso: what is left of its mounting
after the agent has told it as the torso's angles."""

Extension = Callable[[RobotDescription, mujoco.MjSpec], None]


@lru_cache(maxsize=32)
def compile_model(robot: RobotDescription, support: str, extend: Extension | None = None) -> Model:
    """Compile a robot for one kind of support.

    Suspended, the torso is fixed and nothing touches; on the ground it is free; on the bench the
    model stays as it is, without contact.

    Args:
      robot: the robot.
      support: `suspended`, `ground` or `bench`.
      extend: adds to the model, such as sensors.

    Raises:
      InputError: MuJoCo refuses the model, or the robot cannot stand on that support.
    """
    try:
        spec = mujoco.MjSpec.from_file(str(robot.model_path))
        for actuator in list(spec.actuators):
            spec.delete(actuator)
        for key in list(spec.keys):
            spec.delete(key)  # key frames change length with the joints
        free = [j for j in spec.joints if j.type == mujoco.mjtJoint.mjJNT_FREE]
        if support == "suspended":
            for joint in free:
                spec.delete(joint)
        for body in spec.bodies[1:]:
            body.simple = False  # a body on a slide could not have its centre of mass moved
        spec.option.timestep = robot.timestep
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        # One robot is one island: looking for more costs a tenth of a step on the ground.
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
        if support == "ground":
            _floor_under_the_feet(robot, spec)
        else:
            spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        if extend is not None:
            extend(robot, spec)
        compiled = spec.compile()
    except ValueError as error:
        raise InputError(f"{robot.model_path}: MuJoCo refuses it: {_one_line(error)}") from error
    floating = support == "ground" and bool(free)
    if support == "ground" and not floating:
        raise InputError(
            f"robot {robot.name!r} has a fixed base and cannot be on the ground; "
            "the recording's support should be 'bench'"
        )
    _check_joints(robot, compiled)
    _check_numbers(robot, compiled)
    _check_limits(robot, compiled)
    ids = [compiled.joint(name).id for name in robot.joint_names]
    model = Model(
        compiled,
        _selection(compiled.jnt_qposadr[ids]),
        _selection(compiled.jnt_dofadr[ids]),
        floating,
        _contacts(robot, compiled),
    )
    if floating:
        _check_first(robot, compiled)
        _check_floor(robot, compiled)
        _check_mount(robot, model)
    return model


def _check_joints(robot: RobotDescription, model: mujoco.MjModel) -> None:
    """Refuse hinges and slides that the file's text does not show: nobody would drive them."""
    made = {model.joint(j).name for j in range(model.njnt) if model.jnt_type[j] in DRIVEN}
    if odd := sorted(made.symmetric_difference(robot.joint_names)):
        raise InputError(
            f"{robot.model_path}: no hinge or slide of both this file and robot.toml, as MuJoCo "
            f"reads them: {', '.join(name or 'one without a name' for name in odd)}; write out the "
            "joints that <replicate>, <flexcomp> or the defaults make"
        )


def _check_numbers(robot: RobotDescription, model: mujoco.MjModel) -> None:
    """Refuse bodies that MuJoCo takes with numbers that no simulation survives."""
    told = [model.body_mass[:, None], model.body_inertia, model.body_pos, model.body_ipos]
    for body in np.flatnonzero(~np.isfinite(np.hstack(told)).all(axis=1)):
        raise InputError(
            f"{robot.model_path}: body {model.body(body).name!r} has a mass, an inertia or a place "
            "that is no finite number; correct it"
        )


def _check_limits(robot: RobotDescription, model: mujoco.MjModel) -> None:
    """Refuse hinges whose limits in robot.toml are in another unit than the MJCF."""
    for joint in robot.joints:
        compiled = model.joint(joint.name)
        if compiled.type[0] != mujoco.mjtJoint.mjJNT_HINGE:
            continue
        (low, high), limited = compiled.range, model.jnt_limited[compiled.id]
        largest = BEYOND * max(abs(low), abs(high)) + MARGIN if limited else TURNS
        if max(abs(joint.lower), abs(joint.upper)) <= largest:
            continue
        told = f"{robot.folder / 'robot.toml'}: joint {joint.name!r}: "
        told += f"[{joint.lower:g}, {joint.upper:g}] "
        if not limited:
            raise InputError(
                f"{told}is more than two turns; are these degrees? If not, give the joint a range "
                "in model.xml"
            )
        raise InputError(
            f"{told}is far beyond its range [{low:.3g}, {high:.3g}] rad in model.xml; is one of "
            'them in degrees? model.xml is, unless it has <compiler angle="radian"/>'
        )


def _check_first(robot: RobotDescription, model: mujoco.MjModel) -> None:
    """Refuse a torso that is not at the head of qpos and qvel, where everybody looks for it."""
    if model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
        raise InputError(
            f"{robot.model_path}: joint {model.joint(0).name!r} stands before the free joint; list "
            f"the robot's torso {robot.torso!r} first in worldbody"
        )


def _check_floor(robot: RobotDescription, model: mujoco.MjModel) -> None:
    """Refuse a floor that is not level: whoever stands on it is put down as on one that is."""
    for floor in _floors(model):
        up = np.empty(3)
        mujoco.mju_rotVecQuat(up, np.array([0.0, 0.0, 1.0]), model.geom_quat[floor])
        if up[2] < LEVEL:
            raise InputError(
                f"{robot.model_path}: the geom {FLOOR!r} is not level; leave its orientation out "
                "(the effect 'ground_slope' makes the ground lean)"
            )


def _check_mount(robot: RobotDescription, model: Model) -> None:
    """Refuse an IMU turned as its chip is, where a policy would take roll for pitch on the robot.

    Replays and the walking task turn the torso's angles by the site; a robot's agent does not.
    """
    if robot.gait is None:
        return
    turned = np.degrees(2 * np.arccos(min(1.0, abs(mount(robot, model)[0]))))
    if turned > ASKEW:
        raise InputError(
            f"{robot.model_path}: the site {robot.imu_site!r} is turned by {turned:.0f} degrees "
            f"against the torso; leave at most {ASKEW:g}, and tell how the chip is mounted by "
            "roll, pitch, yaw and axes of the agent's [imu]"
        )


def _floors(model: mujoco.MjModel) -> list[int]:
    """The geom that is the floor, if there is one."""
    return [geom for geom in range(model.ngeom) if model.geom(geom).name == FLOOR]


def joint_inertia(model: Model, armature: Array | None, shape: tuple[int, ...]) -> Array:
    """What each joint's torque accelerates at the model's reference pose, kg m².

    Args:
      model: the compiled model.
      armature: rotor inertia of the torque law, broadcastable to `shape`; None keeps the model's.
      shape: (n_simulations, n_joints).
    """
    own = model.compiled.dof_armature[model.dofs]
    rotor = np.broadcast_to(own if armature is None else armature, shape)
    return np.asarray(model.compiled.dof_M0[model.dofs] - own + rotor)


def _contacts(robot: RobotDescription, model: mujoco.MjModel) -> tuple[tuple[int, int], ...]:
    feet = [model.body(foot).id for foot in robot.feet]
    pairs = [(g, feet.index(b)) for g, b in enumerate(model.geom_bodyid) if b in feet]
    return (*pairs, *((floor, len(feet)) for floor in _floors(model)))


def _floor_under_the_feet(robot: RobotDescription, spec: mujoco.MjSpec) -> None:
    """Give the feet the floor's contact parameters, and the say: one foot's may then be changed."""
    floor = next((geom for geom in spec.geoms if geom.name == FLOOR), None)
    if floor is None:
        return
    for foot in robot.feet:
        for geom in spec.body(foot).geoms:
            if geom.contype or geom.conaffinity:
                geom.priority = floor.priority + 1
                geom.friction, geom.condim = floor.friction, floor.condim
                geom.solref, geom.solimp = floor.solref, floor.solimp
                geom.solmix, geom.margin, geom.gap = floor.solmix, floor.margin, floor.gap


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


def _selection(addresses: NDArray[np.int32]) -> Selection:
    """A slice where the addresses are consecutive: a view instead of a copy."""
    if (np.diff(addresses) == 1).all():
        return slice(int(addresses[0]), int(addresses[-1]) + 1)
    return addresses.astype(np.int64)


def starting_qpos(
    robot: RobotDescription, model: Model, position: Array, recording: Recording
) -> Array:
    """The configuration a recording starts in, shape (nq,).

    Args:
      robot: the robot.
      model: its compiled model.
      position: the joints' first positions, shape (n_joints,), rad.
      recording: gives the IMU's first reading.
    """
    return standing_qpos(robot, model, position, first_tilt(robot, model, recording))


def first_tilt(robot: RobotDescription, model: Model, recording: Recording) -> Array:
    """The torso's orientation by the IMU's roll and pitch at the start, (4,); NaN without them."""
    ticks = ticks_at_rest(recording, named_units(robot))
    roll, pitch = (
        _first_known(recording.extras.get(f"imu/{angle}"), ticks) for angle in ("roll", "pitch")
    )
    return tilted(robot, model, roll, pitch)


def tilted(robot: RobotDescription, model: Model, roll: float, pitch: float) -> Array:
    """The torso's orientation by readings of its IMU, rad, shape (4,); NaN where one is NaN."""
    quaternion = _from_roll_pitch(roll, pitch)
    if robot.imu_site is not None and model.floating:
        quaternion = multiply(quaternion, mount(robot, model) * CONJUGATE)
    return quaternion


def mount(robot: RobotDescription, model: Model) -> Array:
    """The IMU's orientation in the torso, a quaternion.

    Raises:
      InputError: it is on another body, which moves against the torso.
    """
    if robot.imu_site is None:
        return np.array([1.0, 0, 0, 0])
    compiled = model.compiled
    site, torso = compiled.site(robot.imu_site), compiled.body(robot.torso or 0).id
    turn, body = np.array(site.quat), int(site.bodyid[0])
    while body != torso:
        if body == 0 or compiled.body_jntnum[body]:
            raise InputError(
                f"{robot.folder / 'robot.toml'}: imu_site {robot.imu_site!r} moves against the "
                f"torso {robot.torso!r}, whose tilt it is to tell; move it there"
            )
        turn = multiply(compiled.body_quat[body], turn)
        body = int(compiled.body_parentid[body])
    return turn


def joint_units(robot: RobotDescription) -> Array:
    """What stands for a radian in each joint: 1 in a hinge, a share of a slide's range (m).

    Shape (n_joints,).
    """
    model = compile_model(robot, "suspended" if robot.floating else "bench").compiled
    lower, upper = robot.limits
    slides = [
        model.joint(name).type[0] == mujoco.mjtJoint.mjJNT_SLIDE for name in robot.joint_names
    ]
    return np.asarray(np.where(slides, (upper - lower) / np.pi, 1.0), dtype=np.float64)


def named_units(robot: RobotDescription) -> Units:
    """The same by the joints' names."""
    return dict(zip(robot.joint_names, joint_units(robot).tolist(), strict=True))


def standing_qpos(robot: RobotDescription, model: Model, position: Array, torso: Array) -> Array:
    """A configuration to start in, shape (nq,).

    On the ground the torso takes an orientation, or where there is none the tilt that lays the
    feet flat, and the lowest point of the robot touches the floor.

    Args:
      robot: the robot.
      model: its compiled model.
      position: of the joints, shape (n_joints,), rad.
      torso: quaternion, shape (4,); NaN for none.
    """
    data = mujoco.MjData(model.compiled)
    data.qpos[model.qpos] = position
    if not model.floating:
        return np.array(data.qpos)
    data.qpos[:7] = (0, 0, 0, 1, 0, 0, 0)
    mujoco.mj_kinematics(model.compiled, data)
    data.qpos[3:7] = _feet_flat(robot, model.compiled, data) if np.isnan(torso).any() else torso
    mujoco.mj_kinematics(model.compiled, data)
    data.qpos[2] -= lowest_point(model.compiled, data.geom_xpos, data.geom_xmat)
    return np.array(data.qpos)


def _first_known(values: Array | None, ticks: int) -> float:
    """The mean of the readings at rest, or else the first one there is; NaN without any."""
    if values is None or np.isnan(values).all():
        return np.nan
    resting = float(at_rest(values, ticks))
    return float(values[np.argmax(~np.isnan(values))]) if np.isnan(resting) else resting


def _from_roll_pitch(roll: float, pitch: float) -> Array:
    """Z-Y-X Euler angles with no yaw to a quaternion (w, x, y, z)."""
    cr, sr, cp, sp = np.cos(roll / 2), np.sin(roll / 2), np.cos(pitch / 2), np.sin(pitch / 2)
    return np.array([cr * cp, sr * cp, cr * sp, -sr * sp])


def _feet_flat(robot: RobotDescription, model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    """The torso's tilt that lays the feet on a level floor."""
    if not robot.feet:
        return np.array([1.0, 0, 0, 0])
    feet = [model.body(foot).id for foot in robot.feet]
    axes = np.array([_sole(model, data, foot) for foot in robot.feet])
    up = floor_normal(data.xpos[feet], axes)
    up /= np.linalg.norm(up)
    half = np.array([1 + up[2], up[1], -up[0], 0.0])  # shortest turn that takes `up` to z
    return np.asarray(half / np.linalg.norm(half))


def _sole(model: mujoco.MjModel, data: mujoco.MjData, foot: str) -> Array:
    """The upward axis of a foot's sole: of its site where there is one, or else of the body."""
    body = model.body(foot).id
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, sole_of(foot))
    told = site >= 0 and model.site_bodyid[site] == body
    turn = data.site_xmat[site] if told else data.xmat[body]
    return np.asarray(turn.reshape(3, 3)[:, 2])


def lowest_point(model: mujoco.MjModel, places: Array, axes: Array) -> Array:
    """Height of the lowest corner of the robot's colliding geoms above the floor, shape (...,), m.

    Args:
      model: the compiled model.
      places: of all geoms, shape (..., n_geoms, 3), m: `geom_xpos`.
      axes: their rotation matrices, shape (..., n_geoms, 9): `geom_xmat`.
    """
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    moves = model.body_weldid[model.geom_bodyid] != 0  # what is fixed to the world is not of it
    geoms = np.flatnonzero(collides & moves)
    if not len(geoms):
        return np.zeros(places.shape[:-2])
    centre, half = model.geom_aabb[geoms, :3], model.geom_aabb[geoms, 3:]
    up = axes[..., geoms, 6:]  # what each geom's axes have of the vertical
    corner = (up * centre).sum(axis=-1) - (np.abs(up) * half).sum(axis=-1)
    ground = sum(places[..., floor, 2] + _top(model, floor) for floor in _floors(model))
    return np.asarray((places[..., geoms, 2] + corner).min(axis=-1) - ground)


def _top(model: mujoco.MjModel, geom: int) -> float:
    """Height of a floor above its place, m."""
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
        return 0.0
    return float(model.geom_aabb[geom, 2] + model.geom_aabb[geom, 5])
