"""The model parameters mu of episodes: drawn from their bounds, or given."""

import numpy as np
from numpy.typing import NDArray

from pup.physics.parameters import Candidates
from pup.policy.scale import UnitScale
from pup.sysid.result import FittedBounds

Array = NDArray[np.float64]

MARGIN = 0.05
"""Mu is drawn from, and told the policy within, the bounds widened by this share (authors)."""


class ParameterSampler:
    """Draws mu ~ U(-0.05, 1.05) on the unit scale of the bounds, or repeats given ones.

    On the unit scale 0 is the lower and 1 the upper bound; where these are one, 0 is drawn. No
    parameter leaves its search range: there a stiffness or a friction would be negative.

    Args:
      bounds: what pre-sysID found.
      mu: physical values of the bounded parameters, for all simulations, shape (n_parameters,), or
        one row for each, shape (n_simulations, n_parameters); None draws anew for every episode.
    """

    def __init__(self, bounds: FittedBounds, mu: Array | None = None) -> None:
        self.bounds = bounds
        self.mu = None if mu is None else np.asarray(mu, dtype=np.float64)
        self._columns = [bounds.space.names.index(name) for name in bounds.names]
        self._scale = UnitScale(bounds.lower, bounds.upper)
        free, search = bounds.upper > bounds.lower, bounds.space.select(bounds.names)
        self._lowest = np.maximum(self.unit(search.lower), np.where(free, -MARGIN, 0.0))
        self._highest = np.minimum(self.unit(search.upper), np.where(free, 1 + MARGIN, 0.0))

    @classmethod
    def nominal(cls, bounds: FittedBounds) -> "ParameterSampler":
        """The fitted values in every episode."""
        index = [bounds.space.names.index(name) for name in bounds.names]
        return cls(bounds, bounds.space.nominal[index])

    @property
    def names(self) -> tuple[str, ...]:
        """The bounded parameters."""
        return self.bounds.names

    def draw(self, rng: np.random.Generator, rows: NDArray[np.int64]) -> Array:
        """Mu of some simulations' new episodes, on the unit scale, shape (n_rows, n_parameters)."""
        shape = len(rows), len(self.names)
        if self.mu is not None:
            mu = self.mu[rows] if self.mu.ndim == 2 else np.broadcast_to(self.mu, shape)
            return self.unit(mu)
        drawn = rng.uniform(-MARGIN, 1 + MARGIN, shape)
        return np.clip(drawn, self._lowest, self._highest)

    def told(self, rng: np.random.Generator, count: int, noise: float) -> Array:
        """Mu all over what policies are told in trainings, on the unit scale.

        They are told mu with an error, within the widened bounds; of a parameter whose bounds are
        one, so, nothing but the error.

        Args:
          rng: source of all that is random.
          count: how many.
          noise: the largest error.

        Returns:
          Shape (count, n_parameters).
        """
        free = self.bounds.upper > self.bounds.lower
        lowest = np.where(free, -MARGIN, -min(noise, MARGIN))
        highest = np.where(free, 1 + MARGIN, min(noise, 1 + MARGIN))
        return rng.uniform(lowest, highest, (count, len(self.names)))

    def largest(self) -> Candidates:
        """All of the robot's parameters, in size no smaller than any drawn; one row."""
        if self.mu is not None:
            told = np.atleast_2d(self.mu)
        else:
            told = self.physical(np.stack([self._highest, self._lowest]))
        largest = told[np.abs(told).argmax(axis=0), np.arange(told.shape[1])]
        return self.candidates(self.unit(largest)[None])

    def unit(self, mu: Array) -> Array:
        """Physical values on the unit scale of the bounds, shape (..., n_parameters)."""
        return self._scale.unit(mu)

    def physical(self, unit: Array) -> Array:
        """The inverse of `unit`."""
        return self._scale.physical(unit)

    def candidates(self, unit: Array) -> Candidates:
        """All of the robot's parameters for mu on the unit scale, shape (n, n_parameters)."""
        space = self.bounds.space
        values = np.tile(space.nominal, (len(unit), 1))
        values[:, self._columns] = self.physical(unit)
        return space.candidates(values)
