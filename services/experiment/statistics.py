"""What many robots say together: means, medians, shares and ratios, with intervals over robots."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta, binom, t

Array = NDArray[np.float64]

LEVEL = 0.9
"""Of the intervals."""
TAIL = (1 - LEVEL) / 2
FEW = 6
"""Robots below which a number is an indication, whatever its interval."""


@dataclass(frozen=True)
class Estimate:
    """A number of a sample of robots.

    Attributes:
      value: of the robots themselves; NaN where there is none.
      low: end of the 90 % interval for robots of their kind; NaN where so few tell none.
      high: other end.
      robots: how many there are.
    """

    value: float
    low: float
    high: float
    robots: int

    def document(self) -> dict[str, Any]:
        """As JSON values; null for what is not known or has no end."""
        known = not np.isnan(self.low)
        interval = [_number(self.low), _number(self.high)] if known else None
        return {"value": _number(self.value), "ci90": interval, "robots": self.robots}


def mean(values: Sequence[float]) -> Estimate:
    """Mean, with Student's interval."""
    told, n = np.array(values, dtype=np.float64), len(values)
    if n == 0:
        return _unknown(0)
    value = float(told.mean())
    if n == 1:
        return Estimate(value, np.nan, np.nan, 1)
    reach = _quantile(n) * float(told.std(ddof=1)) / np.sqrt(n)
    return Estimate(value, value - reach, value + reach, n)


def median(values: Sequence[float]) -> Estimate:
    """Median, between the two robots that hold it in 90 % of samples or more; from five on."""
    told, n = np.sort(np.array(values, dtype=np.float64)), len(values)
    if n == 0:
        return _unknown(0)
    value = float(np.median(told))
    # The lower end: of n robots, this one and all below it lie below the median by a tail's chance.
    end = int(binom.ppf(TAIL, n, 0.5)) - 1
    if end < 0:
        return Estimate(value, np.nan, np.nan, n)
    return Estimate(value, float(told[end]), float(told[n - 1 - end]), n)


def share(flags: Sequence[bool]) -> Estimate:
    """Share of what is true, with the interval of Clopper and Pearson."""
    n, hits = len(flags), sum(map(bool, flags))
    if n == 0:
        return _unknown(0)
    low = float(beta.ppf(TAIL, hits, n - hits + 1)) if hits else 0.0
    high = float(beta.ppf(1 - TAIL, hits + 1, n - hits)) if hits < n else 1.0
    return Estimate(hits / n, low, high, n)


def ratio(pairs: Sequence[Sequence[float]]) -> Estimate:
    """Mean of the first by mean of the second, with the interval of Fieller's theorem.

    The interval holds the ratios r for which first - r * second, robot by robot, has a mean that
    Student's t cannot tell from 0. There is no ratio to a mean that is not above 0; where the
    second mean cannot be told from 0, the interval has no upper end, or none at all.

    Args:
      pairs: both numbers of each robot, shape (n_robots, 2).
    """
    told, n = np.array(pairs, dtype=np.float64).reshape(-1, 2), len(pairs)
    if n == 0 or told[:, 1].mean() <= 0:
        return _unknown(n)
    above, below = map(float, told.mean(axis=0))
    value = above / below
    if n == 1:
        return Estimate(value, np.nan, np.nan, 1)
    spread = np.cov(told.T) * _quantile(n) ** 2 / n
    # Ratios within: square * r**2 - 2 * middle * r + rest <= 0.
    square, rest = below**2 - spread[1, 1], above**2 - spread[0, 0]
    middle = above * below - spread[0, 1]
    root = np.sqrt(max(middle**2 - square * rest, 0.0))
    if square > 0:
        return Estimate(value, (middle - root) / square, (middle + root) / square, n)
    if rest > 0 and above > 0:  # of both roots one is below 0, where no second mean would be
        return Estimate(value, rest / (middle + root), np.inf, n)
    return Estimate(value, -np.inf, np.inf, n)


def best_so_far(distances: Sequence[float | None]) -> list[float]:
    """The largest of the walks up to each trial, m; -inf before the first.

    Args:
      distances: of the trials, m; None where eta was infeasible.
    """
    walked = np.array([-np.inf if d is None else d for d in distances])
    return [float(d) for d in np.maximum.accumulate(walked)]


def needed(distances: Sequence[float], goal: float) -> int | None:
    """Number of the first walk that comes as far as a goal; None where none does."""
    reached = np.flatnonzero(np.array(distances, dtype=np.float64) >= goal)
    return int(reached[0]) + 1 if len(reached) else None


def farther(ours: Sequence[float], others: Sequence[float]) -> bool:
    """Whether walks come farther than others of the same robot, beyond what walks differ by.

    They do where their mean is above 0, and above the others' by more than two standard errors of
    the difference; a single walk has none that is known.

    Args:
      ours: distances, m.
      others: distances, m.
    """
    told = [np.array(walks, dtype=np.float64) for walks in (ours, others)]
    errors = [walks.var(ddof=1) / len(walks) for walks in told if len(walks) > 1]
    difference = told[0].mean() - told[1].mean()
    return bool(told[0].mean() > 0 and difference > 2 * np.sqrt(sum(errors)))


def _quantile(n: int) -> float:
    """Student's, of n values."""
    return float(t.ppf(1 - TAIL, n - 1))


def _unknown(robots: int) -> Estimate:
    return Estimate(np.nan, np.nan, np.nan, robots)


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
