"""How far a policy walks."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from pup.locomotion.task import Action, WalkingTask

Array = NDArray[np.float64]
Policy = Callable[[NDArray[np.float32], NDArray[np.float32]], Action]
"""From proprioception and parameters, a row per simulation, to actions, shape (n, n_joints)."""


@dataclass(frozen=True)
class Walks:
    """One episode of each simulation, in their order.

    Attributes:
      parameters: true mu on the unit scale of the bounds, shape (n, n_parameters).
      distance: in the direction, m.
      aside: across it, m.
      time: before the fall, or the whole episode's, s.
      fell: whether it ended otherwise than by time.
      reward: sum over the episode.
    """

    parameters: NDArray[np.float32]
    distance: Array
    aside: Array
    time: Array
    fell: NDArray[np.bool_]
    reward: Array

    @classmethod
    def joined(cls, parts: Sequence["Walks"]) -> "Walks":
        """Those of all parts, one part after the other."""
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))

    def of(self, rows: slice) -> "Walks":
        """Some of them."""
        return Walks(*(getattr(self, f.name)[rows] for f in fields(self)))

    def summary(self) -> dict[str, float]:
        """Median distance, way aside and time, share without a fall, mean reward."""
        return {
            "distance_median": float(np.median(self.distance)),
            "aside_median": float(np.median(np.abs(self.aside))),
            "time_median": float(np.median(self.time)),
            "upright_share": float(1 - self.fell.mean()),
            "reward_mean": float(self.reward.mean()),
        }


def evaluate(policy: Policy, task: WalkingTask) -> Walks:
    """Let a policy walk one episode in every simulation of a task.

    The task's sampler says on which parameters: fresh ones, or given ones, a row per simulation.

    Args:
      policy: chooses the actions of the whole batch; also for simulations whose episode is over.
      task: is reset at the start.
    """
    seen = task.reset()
    parameters = seen.true_parameters
    reward, going = np.zeros(task.n), np.ones(task.n, dtype=bool)
    distance, aside, time = np.zeros((3, task.n))
    fell = np.zeros(task.n, dtype=bool)
    while going.any():
        step = task.step(policy(seen.proprioception, seen.parameters))
        reward += np.where(going, step.reward, 0.0)
        distance = np.where(going, step.distance, distance)
        aside = np.where(going, step.aside, aside)
        time = np.where(going, step.time, time)
        fell |= going & step.terminated
        going &= ~(step.terminated | step.truncated)
        seen = step.observation
    return Walks(parameters, distance, aside, time, fell, reward)
