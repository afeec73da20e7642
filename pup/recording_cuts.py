"""Parts of recordings: a stretch of time, or fewer readings."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.recording import Recording

Array = NDArray[np.float64]

FEWEST = 2
"""Rows that a part must have."""


def cut(recording: Recording, start: float, stop: float, id: str = "") -> Recording:
    """A stretch of a recording; its time starts again at 0.

    Where the stretch starts, its replay starts from rest, or from the speeds that were read: cut
    where the robot stands still. Commands that stand only where they change are written out, for
    the stretch must know what was held when it began.

    Args:
      recording: the whole.
      start: of the stretch, since the recording's first row, s.
      stop: its end, s; a row at the end itself belongs to what follows.
      id: of the part; the recording's with the start in it where none is given.

    Raises:
      InputError: the stretch holds fewer than two rows.
    """
    since = recording.time - recording.time[0]
    kept = (since >= start) & (since < stop)
    if kept.sum() < FEWEST:
        raise InputError(
            f"recording {recording.id!r}: {start:g} to {stop:g} s holds {kept.sum()} rows; "
            f"it lasts {since[-1]:g} s"
        )
    part = _rows(with_commands(recording), kept)
    return replace(
        part,
        id=id or f"{recording.id}_{start:g}s",
        time=part.time - part.time[0],
        repeat_of=None,
        notes=f"{recording.notes} From {start:g} to {stop:g} s.".strip(),
    )


def beginning(recording: Recording, until: float) -> Recording:
    """The recording up to some time after its start, s; two rows of it at least."""
    last = max(FEWEST, int(np.sum(recording.time - recording.time[0] < until)))
    return _rows(_with_power(recording), np.arange(len(recording.time)) < last)


def _rows(recording: Recording, kept: NDArray[np.bool_]) -> Recording:
    """Some rows of a recording, all else as it is."""
    return replace(
        recording,
        time=recording.time[kept],
        target=recording.target[kept],
        position=recording.position[kept],
        extras={name: values[kept] for name, values in recording.extras.items()},
    )


def with_commands(recording: Recording) -> Recording:
    """The recording with the commands that each row holds; before the first one there is none."""
    return replace(_with_power(recording), target=_held(recording.target))


def _with_power(recording: Recording) -> Recording:
    """The recording with the torque on or off in each row, so that no part of it has no sample.

    Rows before the first sample have its value, as in a replay.
    """
    power = recording.extras.get("torque_enabled")
    if power is None:
        return recording
    power = _held(power)
    power[np.isnan(power)] = power[~np.isnan(power)][0]
    return replace(recording, extras={**recording.extras, "torque_enabled": power})


def _held(values: Array) -> Array:
    """Values of shape (n_ticks, ...), each missing one as the one before it."""
    rows = np.arange(len(values)).reshape(-1, *[1] * (values.ndim - 1))
    last = np.maximum.accumulate(np.where(np.isnan(values), 0, rows), axis=0)
    return np.asarray(np.take_along_axis(values, last, axis=0))


def thinned(recording: Recording, every: int) -> Recording:
    """A recording with one in so many readings of position; all commands stay.

    Args:
      recording: the whole.
      every: keep the first row with a reading, and each so many of them another. Rows of commands
        alone, as a log has that tells both at times of their own, do not count.

    Raises:
      InputError: `every` is less than 1.
    """
    if every < 1:
        raise InputError(f"one in {every} readings: there is no such share; give 1 or more")
    position = recording.position.copy()
    read = np.flatnonzero(~np.isnan(position).all(axis=1))
    position[np.delete(read, np.s_[::every])] = np.nan
    return replace(recording, position=position)


def between(time: Array, readings: Array) -> Array:
    """Readings (n_ticks, n_joints) with lines through the ticks that have none; NaN without any."""
    told = readings.copy()
    for column in told.T:
        read = ~np.isnan(column)
        if read.any():
            column[~read] = np.interp(time[~read], time[read], column[read])
    return told
