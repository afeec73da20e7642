"""How far a model's errors are from noise, channel by channel."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.locate import MissingInput
from pup.diagnosis.noise import repeats
from pup.diagnosis.residuals import Measured

Array = NDArray[np.float64]

BLOCK = 0.5
"""Errors nearer than this in time are not taken for independent, s."""
FEWEST = 40
"""Samples of a channel below which nothing is said of it."""


@dataclass(frozen=True)
class Lack:
    """How far a channel's errors are from noise.

    Attributes:
      channel: which.
      excess: mean square of its whitened errors, less 1.
      surprise: by how many standard deviations that is above 0.
      repeated: mean product of the errors of repeats, which noise leaves at 0; None without any.
      repeated_surprise: by how many standard deviations that is above 0.
      explained: mean square of what missing torques would explain of it.
    """

    channel: int
    excess: float
    surprise: float
    repeated: float | None
    repeated_surprise: float
    explained: float


@dataclass(frozen=True)
class Repeated:
    """What errors of one channel do again where a motion is done again.

    Attributes:
      mean: product of the errors of repeats, which noise leaves at 0.
      surprise: by how many standard deviations that is above 0.
    """

    mean: float
    surprise: float


def lack_of_fit(
    measured: Measured, residual: Array, missing: MissingInput, unsure: float
) -> list[Lack]:
    """How far each channel's errors are from noise.

    Args:
      measured: the samples.
      residual: whitened, shape (n_samples,).
      missing: the torques that would explain it.
      unsure: share by which the noise's variance may be wrong.
    """
    shared = repeated(measured, residual)
    told = []
    for channel in range(measured.channels):
        own = measured.channel == channel
        if own.sum() < FEWEST:
            continue
        squares = residual[own] ** 2 - 1
        blocks = measured.recording[own] * 10_000 + (measured.time[own] / BLOCK).astype(np.int64)
        _, number = np.unique(blocks, return_inverse=True)
        sums = np.bincount(number, squares - squares.mean())
        excess = float(squares.mean())
        spread = float(np.sqrt((sums**2).sum())) / len(squares)
        again = shared.get(channel)
        told.append(
            Lack(
                channel,
                excess,
                excess / float(np.hypot(spread, unsure)),
                again.mean if again else None,
                again.surprise if again else 0.0,
                float(np.mean(missing.explained[own] ** 2)),
            )
        )
    return told


def repeated(measured: Measured, residual: Array) -> dict[int, Repeated]:
    """What a model's errors share between a motion and its repeats, by channel."""
    told: dict[int, list[Array]] = {}
    for first, second in repeats(measured):
        for channel in range(measured.channels):
            one, other = (
                (measured.recording == n) & (measured.channel == channel) for n in (first, second)
            )
            if min(one.sum(), other.sum()) < FEWEST:
                continue
            matched = np.interp(measured.time[one], measured.time[other], residual[other])
            told.setdefault(channel, []).append(residual[one] * matched)
    return {channel: _shared(np.concatenate(parts)) for channel, parts in told.items()}


def _shared(products: Array) -> Repeated:
    """From the products of errors of repeats, which may be as uneven as the errors are."""
    deviation = max(np.sqrt((products**2).sum()), 1e-300)
    return Repeated(float(products.mean()), float(products.sum() / deviation))
