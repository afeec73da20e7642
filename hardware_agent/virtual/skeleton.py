"""A virtual robot's body: the MJCF with the masses, the rotors and the mat of its character."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from hardware_agent.virtual.character import Character
from pup.errors import InputError
from pup.robot import RobotDescription
from pup.robot_stance import floor_normal, sole_of

Array = NDArray[np.float64]

STEP = 0.001  # s, of physics and firmware
FLOOR = "floor"
HAND = "hand"
CLEAR = 0.0005  # m between soles and mat when a robot is put down


def bodies_of(robot: RobotDescription) -> int:
    """How many bodies the robot's model has, with the world."""
    return len(mujoco.MjSpec.from_file(str(robot.model_path)).bodies)


def build(robot: RobotDescription, character: Character) -> mujoco.MjModel:
    """Compile the model of one robot.

    Raises:
      InputError: MuJoCo refuses the model.
    """
    spec = mujoco.MjSpec.from_file(str(robot.model_path))
    spec.option.timestep = STEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    for key in list(spec.keys):
        spec.delete(key)
    for name, rotor in zip(robot.joint_names, character.motors.rotor, strict=True):
        joint = spec.joint(name)
        joint.armature, joint.damping, joint.frictionloss = rotor, (0, 0, 0), 0.0
    _weigh(spec, robot, character)
    _lay(spec, character)
    if robot.floating:
        _attach(spec, robot)
    try:
        return spec.compile()
    except ValueError as error:
        told = " ".join(str(error).split())
        raise InputError(f"{robot.model_path}: MuJoCo refuses it: {told}") from error


def _weigh(spec: mujoco.MjSpec, robot: RobotDescription, character: Character) -> None:
    own = character.body
    for body, factor in zip(spec.bodies[1:], own.masses[1:], strict=True):
        body.simple = False
        body.mass *= factor
        body.fullinertia = np.array(body.fullinertia) * factor
        body.inertia = np.array(body.inertia) * factor
    if robot.torso is not None:
        torso = spec.body(robot.torso)
        torso.mass += own.payload
        torso.ipos = np.array(torso.ipos) + own.shift


def _lay(spec: mujoco.MjSpec, character: Character) -> None:
    """Soft contact and slope of the mat; a bench has no floor."""
    mat = character.mat
    floors = [geom for geom in spec.geoms if geom.name == FLOOR]
    for floor in floors:
        floor.friction = (mat.friction, *floor.friction[1:])
        floor.solref = (mat.time, mat.damping)
        floor.solimp = (0.85, 0.95, 0.004, 0.5, 2.0)
        floor.quat = (1.0, -mat.tilt[1] / 2, mat.tilt[0] / 2, 0.0)


def _attach(spec: mujoco.MjSpec, robot: RobotDescription) -> None:
    """A hand that can hold the torso, or a rope that it can hang on."""
    spec.worldbody.add_body(name=HAND, mocap=True)
    spec.add_equality(
        name=HAND,
        type=mujoco.mjtEq.mjEQ_WELD,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        name1=HAND,
        name2=robot.torso,
        active=False,
        data=(0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1, 0),  # one pose, and turns count as much as ways
    )


def standing(robot: RobotDescription, model: mujoco.MjModel, pose: Array) -> Array:
    """The state of a robot put down in a pose, facing along x, its feet flat on the mat.

    Args:
      robot: the robot.
      model: its compiled model.
      pose: joint angles, rad, shape (n_joints,).

    Returns:
      qpos, shape (nq,).
    """
    data = mujoco.MjData(model)
    for name, angle in zip(robot.joint_names, pose, strict=True):
        data.qpos[model.joint(name).qposadr[0]] = angle
    if not robot.floating:
        return np.array(data.qpos)
    data.qpos[:7] = (0, 0, 0, 1, 0, 0, 0)
    mujoco.mj_kinematics(model, data)
    feet = [model.body(foot).id for foot in robot.feet]
    axes = np.array([_sole(model, data, foot) for foot in robot.feet])
    data.qpos[3:7] = _upright(floor_normal(data.xpos[feet], axes))
    mujoco.mj_kinematics(model, data)
    data.qpos[2] = CLEAR - _lowest(model, data, feet)
    return np.array(data.qpos)


def _sole(model: mujoco.MjModel, data: mujoco.MjData, foot: str) -> Array:
    """The upward axis of a foot's sole: of its site where there is one, or else of the body."""
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, sole_of(foot))
    if site >= 0 and model.site_bodyid[site] == model.body(foot).id:
        return np.asarray(data.site_xmat[site].reshape(3, 3)[:, 2])
    return np.asarray(data.body(foot).xmat.reshape(3, 3)[:, 2])


def _upright(up: Array) -> Array:
    """The turn about a level axis that brings a direction upright, a quaternion."""
    axis = np.array([up[1], -up[0], 0.0])
    sine = float(np.linalg.norm(axis))
    turn = np.array([1.0, 0.0, 0.0, 0.0])
    if sine > 0:
        mujoco.mju_axisAngle2Quat(turn, axis / sine, np.arctan2(sine, up[2]))
    return turn


def _lowest(model: mujoco.MjModel, data: mujoco.MjData, feet: list[int]) -> float:
    """Height of the lowest corner of the feet above the mat at that place, m."""
    floor = model.geom(FLOOR).id
    normal = data.geom_xmat[floor].reshape(3, 3)[:, 2]
    heights = [
        normal @ (data.geom_xpos[g] - data.geom_xpos[floor])
        - np.abs(normal @ data.geom_xmat[g].reshape(3, 3)) @ model.geom_aabb[g, 3:]
        for g in range(model.ngeom)
        if model.geom_bodyid[g] in feet and model.geom_contype[g]
    ]
    return float(min(heights))
