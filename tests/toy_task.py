"""A batched double integrator with the interface of a walking task: learnt in seconds."""

from dataclasses import dataclass

import numpy as np

BINS = 11
LIMIT, EPISODE, DT = 2.0, 40, 0.1


@dataclass(frozen=True)
class Observation:
    proprioception: np.ndarray
    parameters: np.ndarray
    privileged: np.ndarray


@dataclass(frozen=True)
class Step:
    observation: Observation
    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    live: np.ndarray
    distance: np.ndarray
    time: np.ndarray


class ToyTask:
    """Masses to be brought to rest at 0 by two forces; how strong the first acts is the parameter.

    Far from 0 an episode ends; the slot after an end is a reset.
    """

    bins = BINS
    joints = ("left", "right")
    observation_names = ("x", "v")
    parameter_names = ("strength", "nothing")
    privileged_names = parameter_names

    def __init__(self, n: int, seed: int, threads: int = 1) -> None:
        self.n, self.rng = n, np.random.default_rng(seed)
        self.x = np.zeros((n, 2))
        self.mu = np.zeros((n, 2))
        self.steps = np.zeros(n, dtype=np.int64)
        self.over = np.zeros(n, dtype=bool)

    def _begin(self, which: np.ndarray) -> None:
        count = int(which.sum())
        self.x[which] = self.rng.uniform(-1, 1, (count, 2))
        self.mu[which] = self.rng.uniform(0, 1, (count, 2))
        self.steps[which] = 0

    def reset(self) -> Observation:
        self._begin(np.ones(self.n, dtype=bool))
        self.over[:] = False
        return self._told()

    def step(self, action: np.ndarray) -> Step:
        live = ~self.over
        self._begin(self.over)
        force = (action @ [1.0, 1.0] / (BINS - 1) - 1) * (2 + 4 * self.mu[:, 0])
        moved = self.x + DT * np.stack([self.x[:, 1], force], axis=1)
        self.x[live] = moved[live]
        self.steps[live] += 1
        cost = self.x[:, 0] ** 2 + 0.1 * self.x[:, 1] ** 2
        terminated = live & (np.abs(self.x[:, 0]) > LIMIT)
        truncated = live & ~terminated & (self.steps >= EPISODE)
        self.over = terminated | truncated
        return Step(
            self._told(),
            np.where(live, 1 - cost, 0.0).astype(np.float32),
            terminated,
            truncated,
            live,
            -np.abs(self.x[:, 0]),
            DT * self.steps,
        )

    def _told(self) -> Observation:
        mu = self.mu.astype(np.float32)
        return Observation(self.x.astype(np.float32), mu, 2 * mu - 1)

    def state(self) -> dict[str, np.ndarray]:
        words = [int(w) for w in _words(self.rng.bit_generator.state["state"].values())]
        return {
            "x": self.x.copy(),
            "mu": self.mu.copy(),
            "steps": self.steps.copy(),
            "over": self.over.copy(),
            "rng": np.array(words, dtype=np.uint64),
        }

    def restore(self, state: dict[str, np.ndarray]) -> None:
        for name in ("x", "mu", "steps", "over"):
            setattr(self, name, state[name].copy())
        a, b, c, d = (int(w) for w in state["rng"])
        told = self.rng.bit_generator.state
        self.rng.bit_generator.state = told | {"state": {"state": a << 64 | b, "inc": c << 64 | d}}


def _words(numbers):
    for number in numbers:
        yield from (number >> 64, number & (2**64 - 1))
