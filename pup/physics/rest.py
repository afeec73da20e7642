"""Where a replay starts: the first reading, or the mean of those of a robot that rests.

On the ground a start's noise does not die out as it does where a fixed torso holds the joints: it
grows with every impact, and a fit pays for it with parameters. Most motions begin at rest.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from pup.recording import Recording

Array = NDArray[np.float64]
Units = Mapping[str, float]

HINGES: Units = {}
"""Units of a robot whose joints all turn."""
FEWEST = 4
"""Ticks of rest worth a mean: two in each half that are compared."""
DRIFT = 0.004
"""By how much the means of a rest's halves may differ, rad: less than three steps of a 12-bit
encoder. What drifts less is hardly misread by its mean. Of a slide, what stands for it."""
MEDIAN_OF_DIFFERENCES = 0.954
"""Of two normal variables, in absolute value, for a standard deviation of one."""
CHANCE = 3.0
"""Standard errors that they may differ by besides."""


def ticks_at_rest(recording: Recording, units: Units = HINGES) -> int:
    """Ticks at the beginning in which a robot on the ground is told nothing and does not move.

    Args:
      recording: its targets tell how long nothing is asked, its readings whether nothing happens.
      units: what stands for a radian in its joints, by name; 1 where it is not told.

    Returns:
      Their number; 1 where the robot hangs, where the first reading alone must do, or where it
      moves from the start.
    """
    if recording.support != "ground":
        return 1
    moved = (recording.target[1:] != recording.target[:-1]) & ~np.isnan(recording.target[1:])
    asked = moved.any(axis=1)
    still = int(np.argmax(asked)) + 1 if asked.any() else len(recording.time)
    position = recording.position / [units.get(name, 1.0) for name in recording.joints]
    readings = np.column_stack([position, *_tilts(recording)])[:still]
    judged = [column for column in readings.T if _tells(column)]
    if not judged or any(_drifts(column) for column in judged):
        return 1
    return still


def at_rest(values: Array, ticks: int) -> Array:
    """Mean of the known readings at rest, shape (n,); NaN where none is known."""
    known = ~np.isnan(values[:ticks])
    total = np.where(known, values[:ticks], 0.0).sum(axis=0)
    return np.asarray(np.where(known.any(axis=0), total / np.maximum(known.sum(axis=0), 1), np.nan))


def _tilts(recording: Recording) -> list[Array]:
    return [v for n in ("imu/roll", "imu/pitch") if (v := recording.extras.get(n)) is not None]


def _tells(readings: Array) -> bool:
    """Whether enough is known of both halves of a rest (n_ticks,) to compare them."""
    return all((~np.isnan(half)).sum() >= FEWEST // 2 for half in np.array_split(readings, 2))


def _drifts(readings: Array) -> bool:
    """Whether what is known of the two halves of a rest (n_ticks,) differs."""
    before, after = (half[~np.isnan(half)] for half in np.array_split(readings, 2))
    # Of what jumps from reading to reading, whichever way they drift.
    jumps = np.diff(np.concatenate([before, after]))
    noise = np.median(np.abs(jumps)) / MEDIAN_OF_DIFFERENCES
    error = noise * np.sqrt(1 / len(before) + 1 / len(after))
    return bool(abs(after.mean() - before.mean()) > DRIFT + CHANCE * error)
