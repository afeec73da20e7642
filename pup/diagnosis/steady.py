"""Whether errors are noise by their looks: as large in every motion, and fading as noise does."""

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.residuals import Measured

Array = NDArray[np.float64]

EVEN = 2.0
"""Mean squares of noise in recordings of some seconds differ by less than this factor."""
FEWEST, SHORTEST = 2, 60
"""Recordings that tell it, and readings of each."""
REMEMBERED, SLOW = 0.2, 0.9
"""Correlations of neighbours between which errors can be told: noise with less memory is told by
how it flickers, and what has more may be anything that is slow."""


def steady(measured: Measured, errors: Array) -> NDArray[np.bool_]:
    """Channels whose errors are noise with a memory by their looks, shape (n_channels,).

    Noise of that kind (of first order) halves as fast from the first reading to the second as from
    the second to the third. What a model lacks is smooth, swings, or is larger in some motions.

    Args:
      measured: the samples.
      errors: measured minus simulated, shape (n_samples,), rad; NaN says nothing.
    """
    told = np.zeros(measured.channels, dtype=bool)
    for channel in range(measured.channels):
        own = (measured.channel == channel) & np.isfinite(errors)
        runs = [errors[own & (measured.recording == n)] for n in range(len(measured.recordings))]
        runs = [run for run in runs if len(run) >= SHORTEST]
        if len(runs) < FEWEST:
            continue
        squares = [float(np.mean(run**2)) for run in runs]
        told[channel] = max(squares) < EVEN * min(squares) and _fades(runs)
    return told


def _fades(runs: list[Array]) -> bool:
    """Whether a correlation falls from lag to lag by the same share."""
    variance = np.mean(np.concatenate(runs) ** 2)
    first, second = (
        float(np.mean(np.concatenate([r[lag:] * r[:-lag] for r in runs])) / max(variance, 1e-300))
        for lag in (1, 2)
    )
    return REMEMBERED < first < SLOW and abs(second - first**2) < first * (1 - first) / 2
