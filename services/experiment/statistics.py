"""What many robots say together: means, shares and ratios with bootstrap intervals over robots."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

RESAMPLES = 10_000
LEVEL = 0.9
"""Of the intervals."""


@dataclass(frozen=True)
class Estimate:
    """A number of a sample of robots.

    Attributes:
      value: of the robots themselves; NaN without any.
      low: end of the 90 % interval, where other robots of their kind were drawn; NaN below two.
      high: other end.
      robots: how many there are.
    """

    value: float
    low: float
    high: float
    robots: int

    def document(self) -> dict[str, Any]:
        """As JSON values; null for what is not known or has no end."""
        interval = [_number(self.low), _number(self.high)] if self.robots > 1 else None
        return {"value": _number(self.value), "ci90": interval, "robots": self.robots}


Statistic = Callable[[Array], Array]
"""From samples of robots, shape (..., n_robots, n_columns), to a number each, shape (...)."""


def estimate(statistic: Statistic, rows: Sequence[Sequence[float]], seed: int = 0) -> Estimate:
    """A statistic with the percentile interval of robots drawn with replacement.

    Args:
      statistic: of samples of robots; what it compares of a robot stands in one row.
      rows: a row for each robot, shape (n_robots, n_columns).
      seed: of the draws.
    """
    sample = np.array(rows, dtype=np.float64)
    n = len(sample)
    if n == 0:
        return Estimate(np.nan, np.nan, np.nan, 0)
    value = float(statistic(sample))
    if n == 1:
        return Estimate(value, np.nan, np.nan, 1)
    drawn = sample[np.random.default_rng(seed).integers(n, size=(RESAMPLES, n))]
    ends = (1 - LEVEL) / 2, (1 + LEVEL) / 2
    # Of the draws themselves: between a number and infinity there is nothing to interpolate.
    low, high = np.quantile(statistic(drawn), ends, method="nearest")
    return Estimate(value, float(low), float(high), n)


def mean(sample: Array) -> Array:
    """Mean of the first column."""
    return np.asarray(sample[..., 0].mean(axis=-1))


def median(sample: Array) -> Array:
    """Median of the first column."""
    return np.asarray(np.median(sample[..., 0], axis=-1))


def ratio(sample: Array) -> Array:
    """Mean of the first column by that of the second; infinite where only the first is above 0."""
    above, below = sample[..., 0].mean(axis=-1), sample[..., 1].mean(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(below > 0, above / below, np.where(above > 0, np.inf, 0.0)))


def share_above(sample: Array) -> Array:
    """Share of robots whose first column is above all others."""
    best_other = sample[..., 1:].max(axis=-1)
    return np.asarray((sample[..., 0] > best_other).mean(axis=-1))


def share_true(sample: Array) -> Array:
    """Share of robots whose first column is not 0."""
    return np.asarray((sample[..., 0] != 0).mean(axis=-1))


def best_so_far(distances: Sequence[float]) -> list[float]:
    """The largest of the walks up to each, m."""
    return [float(d) for d in np.maximum.accumulate(np.array(distances, dtype=np.float64))]


def needed(distances: Sequence[float], goal: float) -> int | None:
    """Number of the first walk that comes as far as a goal; None where none does."""
    reached = np.flatnonzero(np.array(distances, dtype=np.float64) >= goal)
    return int(reached[0]) + 1 if len(reached) else None


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
