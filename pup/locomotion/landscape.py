"""How far a policy walks over its latent, for several mu: what post-sysID may start from."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pup.locomotion.evaluation import evaluate
from pup.locomotion.sampling import MARGIN, ParameterSampler
from pup.locomotion.settings import TaskSettings
from pup.locomotion.task import Action, WalkingTask
from pup.robot import RobotDescription
from pup.sysid.result import FittedBounds

Array = NDArray[np.float64]
Conditioned = Callable[[NDArray[np.float32], Array], Action]
"""From proprioception and eta, a row per simulation, to actions, shape (n, n_joints)."""

BATCH = 512
"""Robots that walk at once."""


def landscape(
    policy: Conditioned,
    robot: RobotDescription,
    bounds: FittedBounds,
    settings: TaskSettings,
    eta: Array,
    draws: int,
    seed: int,
    threads: int,
) -> Array:
    """One episode of each eta on each of some parameters drawn from the bounds.

    Args:
      policy: walks as it is conditioned.
      robot: the robot.
      bounds: of its parameters.
      settings: of the task.
      eta: shape (n_points, n_eta).
      draws: of the parameters.
      seed: of everything random.
      threads: cores to use.

    Returns:
      Distances, m, shape (draws, n_points).
    """
    sampler = ParameterSampler(bounds)
    rng = np.random.default_rng(seed)
    mu = rng.uniform(-MARGIN, 1 + MARGIN, (draws, len(sampler.names)))
    rows, conditions = np.repeat(sampler.physical(mu), len(eta), axis=0), np.tile(eta, (draws, 1))
    told = []
    for first in range(0, len(rows), BATCH):
        of, condition = rows[first : first + BATCH], conditions[first : first + BATCH]
        given = ParameterSampler(bounds, of)
        task = WalkingTask(robot, given, settings, len(of), rng, threads)
        walks = evaluate(lambda seen, _, eta=condition: policy(seen, eta), task)  # type: ignore[misc]
        told.append(walks.distance)
    return np.concatenate(told).reshape(draws, len(eta))
