"""One long recording taken as several: parts that begin and end at rest.

A finding must hold on data that it was not fitted to. Where there is one recording alone, its parts
can check each other, if the robot stands still between them: there a replay can begin anew.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from pup.errors import InputError
from pup.recording import Recording
from pup.recording_cuts import between, cut

STILL = 0.2
"""At rest, nothing has changed for so long, s."""
SMALL = 0.01
"""Changes below this share of a joint's range are none."""
FLICKER = 6.0
"""Readings of a joint at rest differ by no more than so many standard deviations of their noise."""
QUIETEST = 0.25
"""Share of a recording in which joints are taken to rest, to see how their readings flicker."""
STEP = 0.3
"""Deviation of readings that are rounded to a step, as a share of it."""
SHORTEST = 2.0
"""A part lasts as long at least, s."""
FEWEST = 4
"""A recording that gives fewer parts is left whole."""
MOST = 8


def pieces(recordings: Sequence[Recording]) -> list[Recording]:
    """One recording's parts between rests, several recordings as they are.

    A recording that has fewer than four parts of two seconds stays whole too.
    """
    if len(recordings) != 1:
        return list(recordings)
    whole = recordings[0]
    elapsed = whole.time - whole.time[0]
    starts = _spaced(elapsed[_wakes(whole)], elapsed[-1])
    if len(starts) < FEWEST:
        return [whole]
    try:
        return [cut(whole, start, stop) for start, stop in pairwise([*starts, np.inf])]
    except InputError:  # in one of them a joint was never read
        return [whole]


def origins(
    recordings: Sequence[Recording], parts: Sequence[Recording]
) -> dict[str, tuple[str, float]]:
    """The recording that each part is of, and when in it the part begins, s; empty without parts.

    Args:
      recordings: as they were given.
      parts: what `pieces` made of them.
    """
    if len(parts) == len(recordings):
        return {}
    (whole,) = recordings
    rows = np.cumsum([0, *(len(part.time) for part in parts)])
    begin = (whole.time - whole.time[0])[rows[:-1]]
    return {part.id: (whole.id, float(b)) for part, b in zip(parts, begin, strict=True)}


def _wakes(recording: Recording) -> NDArray[np.bool_]:
    """The last tick of each rest."""
    moving = np.zeros(len(recording.time), bool)
    position = between(recording.time, recording.position)
    small = SMALL * (np.nanmax(recording.target, axis=0) - np.nanmin(recording.target, axis=0))
    read = np.maximum(small, FLICKER * _flicker(recording.position))
    for ago in (STILL, STILL / 2):  # at a turn, values of a while ago are the same again
        before = np.searchsorted(recording.time, recording.time - ago)
        for values, least in ((recording.target, small), (position, read)):
            moving |= (np.abs(values - values[before]) > least).any(axis=1)
    resting = ~moving & (recording.time - recording.time[0] >= STILL)
    return np.asarray(resting & np.append(moving[1:], False))


def _flicker(position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviation of each joint's readings at rest, steps of its encoder included, rad."""
    told = np.zeros(position.shape[1])
    for joint, column in enumerate(position.T):
        read = column[~np.isnan(column)]
        if len(read) < FEWEST:
            continue
        bends, steps = np.abs(np.diff(read, 2)), np.abs(np.diff(read))
        white = np.sqrt(6) * stats.norm.ppf((1 + QUIETEST) / 2)  # of second differences
        moved = steps[steps > 0]
        step = moved.min() if len(moved) else 0.0
        told[joint] = max(np.quantile(bends, QUIETEST) / white, STEP * step)
    return told


def _spaced(wakes: NDArray[np.float64], end: float) -> list[float]:
    """Where parts start: at rests that lie far enough apart, the first with the recording."""
    apart, starts = max(SHORTEST, end / MOST), [0.0]
    for wake in wakes:
        if wake - starts[-1] >= apart and end - wake >= apart:
            starts.append(float(wake))
    return starts
