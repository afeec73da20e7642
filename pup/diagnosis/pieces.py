"""One long recording taken as several: parts that begin and end at rest.

A finding must hold on data that it was not fitted to. Where there is one recording alone, its parts
can check each other, if the robot stands still between them: there a replay can begin anew.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pup.recording import Recording
from pup.recording_cuts import cut

STILL = 0.2
"""At rest, nothing has changed for so long, s."""
SMALL = 0.01
"""Changes below this share of a joint's range are none."""
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
    return [cut(whole, start, stop) for start, stop in pairwise([*starts, np.inf])]


def _wakes(recording: Recording) -> NDArray[np.bool_]:
    """The last tick of each rest."""
    moving = np.zeros(len(recording.time), bool)
    small = SMALL * (np.nanmax(recording.target, axis=0) - np.nanmin(recording.target, axis=0))
    for ago in (STILL, STILL / 2):  # at a turn, values of a while ago are the same again
        before = np.searchsorted(recording.time, recording.time - ago)
        for values in (recording.target, recording.position):
            moving |= (np.abs(values - values[before]) > small).any(axis=1)
    resting = ~moving & (recording.time - recording.time[0] >= STILL)
    return np.asarray(resting & np.append(moving[1:], False))


def _spaced(wakes: NDArray[np.float64], end: float) -> list[float]:
    """Where parts start: at rests that lie far enough apart, the first with the recording."""
    apart, starts = max(SHORTEST, end / MOST), [0.0]
    for wake in wakes:
        if wake - starts[-1] >= apart and end - wake >= apart:
            starts.append(float(wake))
    return starts
