"""Rates with their exact intervals, and how far probabilities can be trusted."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import beta

BINS = 10
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
    """Expected calibration error over ten equal bins, and the Brier score of the named class."""
    if not confidences:
        return {"of": 0, "ece": None, "brier": None}
    told, true = np.array(confidences), np.array(right, dtype=np.float64)
    bins = np.minimum((told * BINS).astype(int), BINS - 1)
    gaps = [
        abs(told[bins == b].mean() - true[bins == b].mean()) * (bins == b).sum()
        for b in range(BINS)
        if (bins == b).any()
    ]
    return {
        "of": len(told),
        "ece": float(sum(gaps) / len(told)),
        "brier": float(np.mean((told - true) ** 2)),
    }
