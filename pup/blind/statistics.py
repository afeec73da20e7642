"""Rates with their exact intervals, and how far probabilities can be trusted."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta

Array = NDArray[np.float64]

BINS = 10
DRAWS = 2000
LEVEL = 0.95


def rate(hits: int, total: int) -> dict[str, Any]:
    """A share with its 95 % interval by Clopper and Pearson; None where there is nothing."""
    if not total:
        return {"hits": 0, "of": 0, "rate": None, "ci95": None}
    tail = (1 - LEVEL) / 2
    low = float(beta.ppf(tail, hits, total - hits + 1)) if hits else 0.0
    high = float(beta.ppf(1 - tail, hits + 1, total - hits)) if hits < total else 1.0
    return {"hits": hits, "of": total, "rate": hits / total, "ci95": [low, high]}


def share(flags: Sequence[bool]) -> dict[str, Any]:
    """The rate of true flags."""
    return rate(sum(flags), len(flags))


def mean(values: Sequence[float]) -> dict[str, Any]:
    """Mean and median; None where there is nothing."""
    if not values:
        return {"of": 0, "mean": None, "median": None}
    return {"of": len(values), "mean": float(np.mean(values)), "median": float(np.median(values))}


def calibration(confidences: Sequence[float], right: Sequence[bool]) -> dict[str, Any]:
    """How far the probabilities of some claims can be trusted.

    Args:
      confidences: probability of each claim.
      right: whether it was true.

    Returns:
      `ece`, the expected calibration error over ten equal bins; `ece_chance`, below which it is in
      95 of 100 such sets of claims though the probabilities are exact; `brier`, the Brier score.
    """
    if not confidences:
        return {"of": 0, "ece": None, "ece_chance": None, "brier": None}
    told, true = np.array(confidences), np.array(right, dtype=np.float64)
    drawn = (np.random.default_rng(0).random((DRAWS, len(told))) < told).astype(np.float64)
    return {
        "of": len(told),
        "ece": float(_ece(told, true[None])[0]),
        "ece_chance": float(np.quantile(_ece(told, drawn), LEVEL)),
        "brier": float(np.mean((told - true) ** 2)),
    }


def _ece(told: Array, right: Array) -> Array:
    """Expected calibration errors of rows of outcomes, shape (n, n_claims)."""
    bins = np.minimum((told * BINS).astype(int), BINS - 1)
    within = (bins == np.arange(BINS)[:, None]).astype(np.float64)
    return np.asarray(np.abs((told - right) @ within.T).sum(axis=1) / len(told))
