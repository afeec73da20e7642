"""Walking tasks for tests."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pup.locomotion.sampling import ParameterSampler
from pup.locomotion.settings import TaskSettings
from pup.locomotion.task import WalkingTask
from pup.robot import Harmonics, RobotDescription
from pup.sysid.result import read_bounds

DARWIN = RobotDescription.load("darwin_op2")
BOUNDS = read_bounds(DARWIN.identified_path, DARWIN)
EXACT = TaskSettings().without_noise()
JOINTS = len(DARWIN.joints)
CENTRE = 5  # the bin of no action

# What of `WalkingTask.state()["simulations/physics"]` is what: MuJoCo's mjSTATE_INTEGRATION.
QPOS, QVEL = slice(1, 28), slice(28, 54)


def walking(
    settings: TaskSettings = EXACT,
    n: int = 4,
    seed: int = 0,
    threads: int = 1,
    sampler: ParameterSampler | None = None,
    robot: RobotDescription = DARWIN,
) -> WalkingTask:
    """A task; with exact readings and nominal parameters unless told otherwise."""
    sampler = sampler or ParameterSampler.nominal(BOUNDS)
    return WalkingTask(robot, sampler, settings, n, np.random.default_rng(seed), threads)


def standing_robot() -> RobotDescription:
    """The robot with a gait that only stands in the half-squat: the mirror image of itself."""
    assert DARWIN.gait is not None and DARWIN.gait.start is not None
    joints = {
        name: Harmonics(angle, (), ())
        for name, angle in zip(DARWIN.joint_names, DARWIN.gait.start, strict=True)
    }
    return replace(DARWIN, gait=replace(DARWIN.gait, joints=joints, start_pitch=None))


def idle(n: int) -> NDArray[np.int64]:
    """No action, of n simulations."""
    return np.full((n, JOINTS), CENTRE)


def random_actions(rng: np.random.Generator, n: int, spread: int = 5) -> NDArray[np.int64]:
    """Bins around the centre."""
    return rng.integers(CENTRE - spread, CENTRE + spread + 1, (n, JOINTS))
