"""A least-squares fit: where it stands, and what its Jacobian promises."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.coordinates import Belief, Coordinate

Array = NDArray[np.float64]

WIDE = 50.0
"""Width of finite differences in contact, in their usual one, until they are narrowed."""
ENOUGH = 0.2
"""A fit has ended when no step lowers chi-squared by as much."""
NOISY = 1.5
"""Up to so many times the noise slopes that are nearly right tell where a fit ends: errors that are
noise are like no slope, and large ones are like what is wrong with one."""
ALMOST = 1e-9
NEAR = 0.05
"""Coordinates so near an end of their range count as there: a twentieth of what is positive."""


@dataclass
class Fit:
    """A least-squares fit under way.

    Attributes:
      coordinates: what is free.
      at: where it stands, shape (n_free,).
      fixed: other parameters that differ from their nominal values.
      weight: of the samples, shape (n_samples,): 0 leaves one out.
      data: what it fits, shape (n_samples,), rad; None for what was measured.
      belief: where it is believed to lie; None where the samples alone say so.
      residual: whitened, measured minus simulated, shape (n_samples,).
      jacobian: of the simulated samples, whitened, shape (n_samples, n_free).
      chi2: sum of squared weighted residuals, and what it costs to leave what is believed.
      done: whether no step leads further.
      thorough: whether it ends on a Jacobian of where it stands, not on an updated one.
      narrow: whether it ends on narrow differences in contact.
      exact: whether its differences are of simulations in the robot's own sub-steps.
      damping: of Levenberg and Marquardt.
      age: steps since the Jacobian was fresh.
      width: of its finite differences, in their usual one.
      contact: the same of recordings in contact, in that one.
      slack: relative gain of chi-squared below which it has ended.
      stuck: times in a row that no trial was better.
      moved: whether any was so far.
    """

    coordinates: tuple[Coordinate, ...]
    at: Array
    fixed: Mapping[str, float] = field(default_factory=dict)
    weight: Array | None = None
    data: Array | None = None
    belief: Belief | None = None
    residual: Array | None = None
    jacobian: Array | None = None
    chi2: float = np.inf
    done: bool = False
    thorough: bool = True
    narrow: bool = False
    exact: bool = False
    damping: float = 1e-2
    age: int = 0
    stuck: int = 0
    moved: bool = False
    width: float = 1.0
    contact: float = WIDE
    slack: float = 1e-5

    def fresh(self) -> "Fit":
        """One of the same to the same, from where this stands, that has not begun."""
        return Fit(
            self.coordinates, self.at.copy(), fixed=self.fixed, data=self.data, slack=self.slack
        )

    @property
    def least(self) -> float:
        """Gain of chi-squared that counts."""
        return max(ENOUGH, self.slack * self.chi2)

    @property
    def near_noise(self) -> bool:
        """Whether it leaves little more than noise."""
        assert self.residual is not None
        return self.chi2 < NOISY * len(self.residual)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return tuple(c.name for c in self.coordinates)

    def row(self, at: Array | None = None) -> dict[str, float]:
        """The candidate at some coordinates; where the fit stands when none are given."""
        where = self.at if at is None else at
        free = {c.name: c.value(x) for c, x in zip(self.coordinates, where, strict=True)}
        return {**self.fixed, **free}

    @property
    def values(self) -> dict[str, float]:
        """All parameters that are not nominal."""
        return self.row()

    @property
    def slopes(self) -> Array:
        """The Jacobian's columns of what can move, shape (n_samples, n_movable).

        A coordinate that the data press against an end of its range stays there, and imitates
        nothing of what they ask for beyond it.
        """
        assert self.jacobian is not None
        return self.jacobian[:, self.movable]

    @property
    def movable(self) -> NDArray[np.bool_]:
        """Whether each coordinate can go where chi-squared is lower, shape (n_free,)."""
        downhill = self.downhill()
        above = self.at > np.array([c.upper for c in self.coordinates]) - ALMOST
        below = self.at < np.array([c.lower for c in self.coordinates]) + ALMOST
        return ~(above & (downhill > 0) | below & (downhill < 0))

    def at_an_end(self, names: Collection[str]) -> bool:
        """Whether any of some coordinates is at an end of its range."""
        return any(
            min(at - c.lower, c.upper - at) < NEAR
            for c, at in zip(self.coordinates, self.at, strict=True)
            if c.name in names
        )

    def covariance(self) -> Array:
        """Of the coordinates, shape (n_free, n_free); what the data do not see has its range."""
        weighted = self._weighted()
        span = np.array([c.upper - c.lower for c in self.coordinates])
        return np.asarray(np.linalg.inv(weighted.T @ weighted + np.diag(12 / span**2)))

    def downhill(self) -> Array:
        """Half of chi-squared's slope downhill, shape (n_free,)."""
        assert self.jacobian is not None and self.residual is not None
        squares = 1.0 if self.weight is None else self.weight**2
        pull = self.belief.pull(self.at) if self.belief else 0.0
        return np.asarray(self.jacobian.T @ (self.residual * squares) + pull)

    def normal(self) -> Array:
        """Half of chi-squared's second derivatives, as the Jacobian has them, (n_free, n_free)."""
        weighted = self._weighted()
        normal = weighted.T @ weighted
        if self.belief:
            normal[np.diag_indices_from(normal)] += self.belief.precision
        return np.asarray(normal)

    def _weighted(self) -> Array:
        assert self.jacobian is not None
        return self.jacobian if self.weight is None else self.jacobian * self.weight[:, None]

    def promise(self, to: Array) -> float:
        """Gain of chi-squared at a point, as the Jacobian has it."""
        step = to - self.at
        return float(2 * self.downhill() @ step - step @ self.normal() @ step)

    def cost(self, residual: Array, at: Array) -> float:
        """Chi-squared of a residual at a point."""
        weighted = residual if self.weight is None else residual * self.weight
        return float(weighted @ weighted) + (self.belief.cost(at) if self.belief else 0.0)
