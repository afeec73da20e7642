"""Joint by regime: where and when the errors are larger than the noise."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from pup.diagnosis.regimes import Regime
from pup.diagnosis.residuals import Measured

Array = NDArray[np.float64]

UNSURE = 0.1
"""By what share the variance of the noise floor may be wrong."""
LEAST = 20
"""Samples that a cell needs."""
FALSE_ALARMS = 0.01
"""Chance that noise alone makes any cell significant."""
WHOLE = "throughout"
TILTS = ("roll", "pitch")


@dataclass(frozen=True)
class Cell:
    """Errors of one channel in one regime.

    Attributes:
      channel: a joint, or `roll` or `pitch` of the torso.
      regime: its name; `throughout` for all samples of the channel.
      samples: how many.
      mean_square: of the whitened errors; 1 for noise alone.
      surprise: by how many standard deviations that is above 1.
      significant: whether chance hardly explains it, with so many cells to choose from.
    """

    channel: str
    regime: str
    samples: int
    mean_square: float
    surprise: float
    significant: bool


def error_map(measured: Measured, residual: Array, found: Sequence[Regime]) -> tuple[Cell, ...]:
    """All cells with enough samples, joint by joint.

    Args:
      measured: the samples.
      residual: whitened, measured minus simulated, shape (n_samples,).
      found: the regimes.
    """
    every = Regime(WHOLE, np.ones(len(residual), dtype=bool))
    told = []
    for channel, name in enumerate((*measured.robot.joint_names, *TILTS)):
        own = measured.channel == channel
        for regime in (every, *found):
            inside = own & regime.inside
            count = int(inside.sum())
            if count >= LEAST:
                square = float(np.mean(residual[inside] ** 2))
                spread = float(np.sqrt(2 / count + UNSURE**2))
                told.append((name, regime.name, count, square, (square - 1) / spread))
    limit = float(stats.norm.isf(FALSE_ALARMS / max(len(told), 1)))
    return tuple(Cell(*cell, significant=cell[-1] > limit) for cell in told)
