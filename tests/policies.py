"""Policies of a few parameters that tests share."""

import numpy as np
import torch

from pup.policy.bundle import PolicyCard
from pup.policy.mirror import MirrorMap
from pup.policy.network import ProjectedPolicy
from pup.policy.shape import Method, PolicyShape
from pup.robot import RobotDescription

ROBOT = RobotDescription.load("darwin_op2")
OBSERVATION = (
    *(f"position_before/{name}" for name in ROBOT.joint_names),
    *(f"position/{name}" for name in ROBOT.joint_names),
    *("imu/roll", "imu/pitch", "imu_before/roll", "imu_before/pitch"),
)
PARAMETERS = ("rho/arm", "rho/knee", "torque_limit", "ground_friction")
MIRROR = MirrorMap.of(ROBOT, OBSERVATION, PARAMETERS)
COURSE = 2
SIZES = len(OBSERVATION), len(PARAMETERS), COURSE + len(PARAMETERS), len(ROBOT.joints)


def same(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> bool:
    """Whether two sets of weights are equal to the last bit."""
    return one.keys() == other.keys() and all(np.array_equal(one[k], other[k]) for k in one)


def policy_of(method: Method = Method.PUP, seed: int = 0) -> ProjectedPolicy:
    """A policy as after some training: with statistics, and actions that are not all alike."""
    torch.manual_seed(seed)
    policy = ProjectedPolicy(PolicyShape.of(method, *SIZES))
    policy.observations.update(torch.randn(500, SIZES[0]) * 0.3 + 0.1)
    policy.learn_returns(torch.randn(500) * 100 + 300)
    with torch.no_grad():
        policy.actor[-1].weight.mul_(200)
    return policy


def card_of(policy: ProjectedPolicy, method: Method = Method.PUP) -> PolicyCard:
    assert ROBOT.gait is not None
    count = policy.shape.eta
    return PolicyCard(
        robot=ROBOT.name,
        joints=ROBOT.joint_names,
        lower=tuple(j.lower for j in ROBOT.joints),
        upper=tuple(j.upper for j in ROBOT.joints),
        method=method,
        direction="forward",
        shape=policy.shape,
        observation=OBSERVATION,
        parameters=PARAMETERS,
        parameter_lower=(0.5,) * 4,
        parameter_upper=(1.5,) * 4,
        eta_lower=(-1.0,) * count,
        eta_upper=(1.0,) * count,
        rates=(25.0, 33.0),
        reach=0.3,
        smoothing=5,
        gait=ROBOT.gait,
        bounds_sha256="0" * 64,
        robot_digest=ROBOT.digest,
        provenance={"seed": 0},
    )


def weights_of(policy: ProjectedPolicy) -> dict[str, np.ndarray]:
    return {name: value.numpy() for name, value in policy.state_dict().items()}


def observations(count: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    seen = rng.normal(0.1, 0.4, (count, SIZES[0])).astype(np.float32)
    return seen, rng.uniform(-0.05, 1.05, (count, SIZES[1]))
