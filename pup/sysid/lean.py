"""Poses that topple a standing robot in a chosen direction."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.physics.model import compile_model
from pup.robot import RobotDescription

Array = NDArray[np.float64]

TOWARDS = {
    "forward": (1.0, 0.0, 0.0),
    "backward": (-1.0, 0.0, 0.0),
    "left": (0.0, 1.0, 0.0),
    "right": (0.0, -1.0, 0.0),
}
DIRECTIONS = tuple(TOWARDS)
LEAN = 0.5  # rad at the ankles; takes the centre of mass past the toes or the heels of a biped
DRAWN_IN = 0.7  # share of the way to the squat of the leg on the side to fall to
LATERAL = 0.9  # cosine of the angle to the y axis within which an axis counts as lateral


def falling_pose(robot: RobotDescription, direction: str) -> Array:
    """The pose to send to a robot that stands and shall fall, shape (n_joints,), rad.

    Forward and backward, the whole robot leans about the lateral joints next to its feet. To the
    side, the leg there is drawn in, which also works where the ankles hardly roll. On more than two
    feet no ankle carries it over: the legs on the side to fall to are drawn in, whichever it is.

    Args:
      robot: with feet and the poses `stand` and `squat`.
      direction: one of DIRECTIONS, seen by the robot.

    Raises:
      InputError: no joint of the robot makes it lean that way.
    """
    stand, squat = (np.array(robot.poses[name]) for name in ("stand", "squat"))
    model, data = _standing(robot, stand)
    legs = [_chain(robot, model, foot) for foot in robot.feet]
    if direction in ("left", "right") or len(legs) > 2:
        feet = np.array([data.xpos[model.body(foot).id] for foot in robot.feet])
        side = feet @ TOWARDS[direction]
        there = [leg for leg, far in zip(legs, side > side.mean(), strict=True) if far]
        drawn = [joint for leg in there for joint in leg]
        if np.ptp(side) < 1e-3 or np.array_equal(stand[drawn], squat[drawn]):
            raise InputError(
                f"robot {robot.name!r} has no leg to draw in; it cannot fall {direction}"
            )
        pose = stand.copy()
        pose[drawn] += DRAWN_IN * (squat - stand)[drawn]
        return pose
    # With the foot on the floor, a joint's turn about its axis turns the torso the other way.
    way = -1.0 if direction == "forward" else 1.0
    turn = np.zeros(len(stand))
    for leg in legs:
        ids = [model.joint(robot.joint_names[i]).id for i in leg]
        lateral = [data.xaxis[joint][1] for joint in ids]
        hinge = [model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE for joint in ids]
        usable = [k for k in range(len(leg)) if hinge[k] and abs(lateral[k]) > LATERAL]
        if not usable:
            raise InputError(
                f"robot {robot.name!r} has a leg without a lateral axis; it cannot fall {direction}"
            )
        turn[leg[usable[0]]] = way * np.sign(lateral[usable[0]]) * LEAN
    return np.clip(stand + turn, *robot.limits)


def _standing(robot: RobotDescription, stand: Array) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The robot's kinematics in the standing pose, torso upright."""
    model = compile_model(robot, "suspended")
    data = mujoco.MjData(model.compiled)
    data.qpos[model.qpos] = stand
    mujoco.mj_kinematics(model.compiled, data)
    return model.compiled, data


def _chain(robot: RobotDescription, model: mujoco.MjModel, foot: str) -> list[int]:
    """Joints between a foot and the torso, the foot's own first, by their place in the robot."""
    joints: list[int] = []
    body = model.body(foot).id
    while body != 0 and model.body(body).name != robot.torso:
        first = model.body_jntadr[body]
        names = [model.joint(first + k).name for k in reversed(range(model.body_jntnum[body]))]
        joints += [robot.joint_names.index(name) for name in names]
        body = model.body_parentid[body]
    return joints
