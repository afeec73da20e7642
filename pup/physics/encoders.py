"""What a recording's ticks see of the simulations: encoders and IMU, read between sub-steps.

Readings are interpolated between sub-steps. Some are older than their rows say, by a time of their
own for each simulation and joint: the last sub-steps are kept for them.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Event:
    """The ticks that fall between a sub-step and the next.

    Attributes:
      rows: of which recordings.
      ticks: where they are stored in packed arrays.
      fraction: how far after the sub-step, of one.
    """

    rows: NDArray[np.int64]
    ticks: NDArray[np.int64]
    fraction: Array


@dataclass(frozen=True)
class Readings:
    """All ticks of some recordings, in the order of the sub-steps after which they fall.

    Attributes:
      step: the last sub-step before each, shape (n_ticks,).
      rows: of which recording.
      ticks: where they are stored in packed arrays.
      fraction: how far after the sub-step, of one.
    """

    step: NDArray[np.int64]
    rows: NDArray[np.int64]
    ticks: NDArray[np.int64]
    fraction: Array

    def events(self, steps: int) -> tuple[Event | None, ...]:
        """The same by sub-steps, of which there are so many."""
        edges = np.searchsorted(self.step, np.arange(steps + 1))
        return tuple(
            Event(self.rows[a:b], self.ticks[a:b], self.fraction[a:b]) if b > a else None
            for a, b in pairwise(edges)
        )


class History:
    """The last values of a signal of all simulations, readable between sub-steps.

    Args:
      simulations: how many.
      width: values of each.
      age: how old the readings are, broadcastable to (n_simulations, width), sub-steps; None where
        none is.
    """

    def __init__(self, simulations: int, width: int, age: Array | None) -> None:
        self.age = age
        depth = 2 if age is None else int(np.ceil(age.max())) + 2
        self.values = np.zeros((depth, simulations, width))
        self.count = 0

    def begin(self, rows: NDArray[np.int64], values: Array, age: Array) -> None:
        """Let some simulations, which start one by one, have stood still until now.

        Args:
          rows: which.
          values: theirs, shape (n_rows, width).
          age: how old their readings are from now on, sub-steps; at most as old as any first was.
        """
        assert self.age is not None
        self.age[rows] = np.minimum(age, len(self.values) - 2)
        self.values[:, rows] = values
        self.count = max(self.count, len(self.values))

    def push(self, values: Array) -> None:
        """Take the values of the first simulations at one more sub-step."""
        self.values[self.count % len(self.values), : len(values)] = values
        self.count += 1

    def read(self, rows: NDArray[np.int64], fraction: Array) -> Array:
        """Values of some simulations, a fraction (n, 1) of a sub-step after the last but one."""
        last = self.count - 2
        if self.age is None:
            before, after = (self.values[(last + i) % 2, rows] for i in (0, 1))
            return np.asarray(before + fraction * (after - before))
        whole, share = aged(last, fraction, self.age[rows])
        depth, column = len(self.values), np.arange(self.values.shape[2])
        before, after = (self.values[(whole + i) % depth, rows[:, None], column] for i in (0, 1))
        return np.asarray(before + share * (after - before))

    def state(self) -> Array:
        """What is kept, the newest last, shape (n_simulations, n_kept, width)."""
        newest_last = np.roll(self.values, -(self.count % len(self.values)), axis=0)
        return np.ascontiguousarray(newest_last.swapaxes(0, 1))

    def restore(self, state: Array) -> None:
        """Take up a state of simulations that were all started by `begin`."""
        self.values[:], self.count = state.swapaxes(0, 1), len(self.values)


def aged(
    step: int | NDArray[np.int64], fraction: Array, age: Array
) -> tuple[NDArray[np.int64], Array]:
    """When it was that old readings are of, as a sub-step and a share of the next.

    Args:
      step: the last sub-step before they are read.
      fraction: how far after it, of one.
      age: how old they are, sub-steps; what is older than the start stood still before it.
    """
    since = np.maximum(fraction - age, -step)
    floor = np.floor(since)
    return step + floor.astype(np.int64), since - floor
