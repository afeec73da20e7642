"""How far a policy walks over its latent, for several mu: what post-sysID may start from."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pup.locomotion.evaluation import Walks, evaluate
from pup.locomotion.sampling import ParameterSampler
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
    rng = np.random.default_rng(seed)
    mu = ParameterSampler(bounds).draw(rng, np.arange(draws))
    rows, conditions = np.repeat(mu, len(eta), axis=0), np.tile(eta, (draws, 1))
    walks = walk_each(policy, robot, bounds, settings, rows, conditions, rng, threads)
    return walks.distance.reshape(draws, len(eta))


def walk_each(
    policy: Conditioned,
    robot: RobotDescription,
    bounds: FittedBounds,
    settings: TaskSettings,
    mu: Array,
    eta: Array,
    rng: np.random.Generator,
    threads: int,
) -> Walks:
    """One episode on each of some parameters, each with a condition of its own.

    Args:
      policy: walks as it is conditioned.
      robot: the robot.
      bounds: of its parameters.
      settings: of the task.
      mu: on the unit scale of the bounds, shape (n, n_parameters).
      eta: shape (n, n_eta).
      rng: draws everything else that is random.
      threads: cores to use.
    """
    physical = ParameterSampler(bounds).physical(mu)

    def walked(mu: Array, eta: Array) -> Walks:
        task = WalkingTask(robot, ParameterSampler(bounds, mu), settings, len(mu), rng, threads)
        return evaluate(lambda seen, _: policy(seen, eta), task)

    parts = (slice(first, first + BATCH) for first in range(0, len(mu), BATCH))
    return Walks.joined([walked(physical[part], eta[part]) for part in parts])
