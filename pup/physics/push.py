"""Torques from outside, given over time: what a simulation lacks, tried out."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pup.physics.model import Model

Array = NDArray[np.float64]

WRENCH = 6
"""Components of the wrench on a free torso."""


@dataclass(frozen=True, eq=False)
class Push:
    """Extra torques of candidates, linear from knot to knot and nothing after the last.

    Attributes:
      period: time between knots, s; the first is at the recording's start.
      values: shape (n_candidates, n_recordings, n_knots, n_joints + WRENCH): torques of the joints
        (N m); then, where the torso is free, the force on it (N, the world's axes) and the torque
        (N m, its own axes).
    """

    period: float
    values: Array

    def of(self, candidates: slice, recordings: Sequence[int]) -> "Push":
        """The part of some candidates and recordings."""
        return Push(self.period, self.values[candidates][:, list(recordings)])


class Pushing:
    """A push on the simulations of one batch, which stand recording by recording.

    Args:
      push: of the batch's candidates and recordings.
      model: what is pushed.
      timestep: sub-step, s.
    """

    def __init__(self, push: Push, model: Model, timestep: float) -> None:
        knots, channels = push.values.shape[2:]
        table = push.values.transpose(2, 1, 0, 3).reshape(knots, -1, channels)
        self._table = np.concatenate([table, np.zeros_like(table[:1])])
        self._scale = timestep / push.period
        self._model = model

    def add(self, force: Array, step: int, n: int) -> None:
        """Add to the applied torques (n_simulations, n_dofs) of the first n, in one sub-step."""
        where = min(step * self._scale, len(self._table) - 1.0)
        knot = min(int(where), len(self._table) - 2)
        share = where - knot
        now = (1 - share) * self._table[knot, :n] + share * self._table[knot + 1, :n]
        force[:n, self._model.dofs] += now[:, :-WRENCH]
        if self._model.floating:
            force[:n, :WRENCH] = now[:, -WRENCH:]
