"""Landscapes of distance over eta for tests and benchmarks of the transfer.

A family stands for a policy on robots with different mu: a ridge of good gaits whose place and
width depend on mu, a cliff beyond which the robot falls at once, and the edge of the board.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Robot:
    """A robot's landscape over eta in [-1, 1]^3.

    Attributes:
      best: eta that walks furthest if there were no other hill.
      width: of the hill by entry.
      hills: centres of lower ones, shape (n, 3).
      cliff: direction in which walks end at once, and where, shape (4,).
      noise: deviation of a walk, m, before the share that grows with distance.
    """

    best: Array
    width: Array
    hills: Array
    cliff: Array
    noise: float

    @classmethod
    def draw(cls, seed: int, noise: float = 0.05, gap: float = 0.0) -> "Robot":
        """A robot of the family, moved out of it by `gap`."""
        rng = np.random.default_rng((seed, 77))
        mu = rng.uniform(-1, 1, 3)
        mixing = np.random.default_rng(5).normal(0, 1, (3, 3)) / 2
        best = 0.7 * np.tanh(mixing @ mu) + gap * rng.normal(0, 1, 3)
        cliff = np.append(direction := rng.normal(0, 1, 3), 1.6 * np.linalg.norm(direction))
        return cls(
            np.clip(best, -0.9, 0.9),
            np.array([0.5, 0.7, 1.1]) * np.exp(0.2 * mu),
            rng.uniform(-1, 1, (2, 3)),
            cliff,
            noise,
        )

    def expected(self, eta: Array) -> Array:
        """Distance without noise, m; eta of shape (..., 3)."""
        far = (((eta - self.best) / self.width) ** 2).sum(axis=-1)
        hills = [0.45 * np.exp(-((eta - h) ** 2).sum(axis=-1) / 0.3) for h in self.hills]
        walked = np.maximum.reduce([0.85 * np.exp(-far), *hills])
        fallen = 1 / (1 + np.exp(12 * (eta @ self.cliff[:3] - self.cliff[3])))
        return np.asarray(0.05 + fallen * walked)

    def walk(self, eta: Array, rng: np.random.Generator) -> Array:
        """Distance as measured: longer walks vary more, m."""
        mean = self.expected(np.asarray(eta))
        return np.asarray(mean + rng.normal(0, 1, mean.shape) * (self.noise + 0.1 * mean))

    def optimum(self) -> float:
        """Largest expected distance on a dense grid, m."""
        line = np.linspace(-1, 1, 41)
        grid = np.stack(np.meshgrid(line, line, line), axis=-1).reshape(-1, 3)
        return float(self.expected(grid).max())
