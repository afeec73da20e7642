"""The commands of recordings as an engine's sub-steps see them.

Sub-step n lasts, for what drives it, from n - 1/2 to n + 1/2 (see `simulator`). A command that
changes within it leaves two targets, the second for a share of it: a servo at its limit answers to
each in turn, not to their mean. Of more changes, the first target is the mean until the last one.
Commands may come late, by a time of its own for each simulation and joint, without any rounding to
sub-steps.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pup.physics import kernels
from pup.physics.simulator import Schedule
from pup.physics.terms.base import begin

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Target:
    """What a controller is told during one sub-step.

    Attributes:
      now: target at its end, shape (n_recordings, n_candidates or 1, n_joints), rad.
      before: target from its beginning until then; None where no recording's changes.
      share: of the sub-step for which `now` holds, broadcastable to them.
    """

    now: Array
    before: Array | None
    share: Array


class HeldCommands(ABC):
    """Commands, each held until the next, that may come late."""

    timestep: float | Array

    @abstractmethod
    def on_time(self, step: int | Array, running: int) -> Target:
        """Targets that arrive at once, the same for all candidates.

        Args:
          step: the sub-step; where simulations have one each, shape (n_simulations, 1).
          running: recordings that have not ended, the first ones.
        """

    @abstractmethod
    def late(self, step: int | Array, lateness: Array) -> Target:
        """Targets that arrive late.

        Args:
          step: the sub-step; where simulations have one each, shape (n_simulations, 1).
          lateness: shape (n_recordings, n_candidates, n_joints or 1), s; negative for early.
        """


class Commands(HeldCommands):
    """The commands of some recordings, each held until its next.

    Args:
      plans: the recordings on the grid of sub-steps.
      timestep: sub-step, s.
    """

    def __init__(self, plans: Sequence[Schedule], timestep: float) -> None:
        self.timestep: float = timestep
        told = [_changes(plan) for plan in plans]
        ticks = max(len(time) for time, _ in told)
        self.time = np.full((len(plans), ticks + 1), np.inf)
        self.held = np.empty((len(plans), ticks + 1, plans[0].held.shape[1]))
        for row, (time, held) in enumerate(told):
            self.time[row, : len(time)] = time
            self.held[row, : len(held)] = held
            self.held[row, len(held) :] = held[-1]
        self.steps = max(p.steps for p in plans)
        self._cells = np.arange(self.steps + 1) * timestep
        self._last = np.stack(
            [np.maximum(np.searchsorted(row, self._cells, "right") - 1, 0) for row in self.time]
        )
        ends = (np.arange(self.steps + 1) - 0.5) * timestep
        rows = np.stack(
            [np.maximum(np.searchsorted(row, ends, "right") - 1, 0) for row in self.time], axis=1
        )
        # Taken from flat arrays: twice as fast as by several indices, and done at each sub-step.
        ticks, joints = self.held.shape[1:]
        first = np.arange(len(plans)) * ticks
        self._flat = self.held.reshape(-1, joints)
        self._at, self._from = first + rows[1:], first + rows[:-1]
        self._mean_before(rows[1:] - rows[:-1] > 1)
        since = (ends[1:, None] - np.take_along_axis(self.time.T, rows[1:], axis=0)) / timestep
        changed = self._flat[self._at] != self._flat[self._from]
        self._share = np.where(changed.any(axis=2), np.clip(since, 0, 1), 1.0)
        self._changes = (self._share < 1).cumsum(axis=1)

    def on_time(self, step: int | Array, running: int) -> Target:
        """See HeldCommands; all recordings are at the same sub-step."""
        now = self._flat.take(self._at[step, :running], axis=0)[:, None]
        if not self._changes[step, running - 1]:
            return Target(now, None, _ONE)
        before = self._flat.take(self._from[step, :running], axis=0)[:, None]
        share = np.where(now == before, 1.0, self._share[step, :running, None, None])
        return Target(now, before, share)

    def late(self, step: int | Array, lateness: Array) -> Target:
        """See HeldCommands; all recordings are at the same sub-step."""
        now, before, share = self._looked_up(0, step, lateness)
        return Target(now, None, _ONE) if (share == 1).all() else Target(now, before, share)

    def tables(self) -> tuple[tuple[Array, ...], tuple[NDArray[np.int64], ...]]:
        """What the compiled loop needs of them; see `pup.physics.loop`.

        Returns:
          The commands of all recordings one after the other, since when each holds, and the shares
          of sub-steps; then where in these the targets at a sub-step's end and beginning stand, and
          which was the newest.
        """
        return (self._flat, self.time, self._share), (self._at, self._from, self._last)

    def _looked_up(
        self, first: int, step: int | Array, lateness: Array
    ) -> tuple[Array, Array, Array]:
        """Targets of as many recordings as `lateness` has rows; see kernels.look_up and `late`."""
        start, end = ((step + half) * self.timestep - lateness for half in (-0.5, 0.5))
        recordings, candidates, _ = lateness.shape
        ticks, joints = self.held.shape[1:]
        found = np.empty((3, recordings, candidates, joints))
        now, before, share = found.reshape(3, recordings, -1)
        kernels.look_up(
            now,
            before,
            share,
            start.reshape(recordings, -1),
            end.reshape(recordings, -1),
            self._flat[first * ticks :],
            self.time[first:],
            self._last[first:],
            self.timestep,
        )
        return found[0], found[1], found[2]

    def _mean_before(self, dense: NDArray[np.bool_]) -> None:
        """Let sub-steps (n_steps, n_recordings) with several commands begin with a mean of them."""
        for row in np.flatnonzero(dense.any(axis=0)):
            steps = np.flatnonzero(dense[:, row])
            at, on_time = steps[:, None].astype(float), np.zeros((1, len(steps), 1))
            _, means, _ = self._looked_up(int(row), at, on_time)
            self._from[steps, row] = len(self._flat) + np.arange(len(steps))
            self._flat = np.concatenate([self._flat, means[0]])


class LiveCommands(HeldCommands):
    """Commands that are told as simulations go, one for all joints of each at a time.

    A command holds from the beginning of the sub-step before which it was told, which is half a
    sub-step before its position (see `simulator`). The first one counts as told long before.

    Args:
      shape: (n_simulations, n_joints).
      depth: commands that are kept for those whom they reach late, the newest among them.
    """

    def __init__(self, shape: tuple[int, int], depth: int) -> None:
        n, joints = shape
        self.timestep: Array = np.ones((n, 1, 1))
        self.held = np.full((n, depth, joints), np.nan)
        self.told = np.full((n, depth), -np.inf)

    def renew(self, rows: NDArray[np.int64], timestep: Array) -> None:
        """Forget what some simulations were told.

        Args:
          rows: which.
          timestep: their sub-steps from now on, shape (n_rows, 1), s.
        """
        self.timestep[rows] = timestep[:, None]
        self.held[rows], self.told[rows] = np.nan, -np.inf

    def tell(self, target: Array, step: Array) -> None:
        """Tell all simulations a target.

        Args:
          target: shape (n_simulations, n_joints), rad.
          step: sub-steps that each has done, shape (n_simulations, 1).
        """
        self.held[:, 1:], self.told[:, 1:] = self.held[:, :-1].copy(), self.told[:, :-1].copy()
        self.held[:, 0], self.told[:, 0] = target, ((step - 0.5) * self.timestep[:, 0])[:, 0]
        begin(self.held, target[:, None])

    def on_time(self, step: int | Array, running: int) -> Target:
        """See HeldCommands; these are the newest, of all simulations."""
        return Target(self.held[:, 0], None, _ONE)

    def late(self, step: int | Array, lateness: Array) -> Target:
        """See HeldCommands; a command never comes before it is told, one in a sub-step."""
        step, lateness = np.asarray(step)[:, :, None], np.maximum(lateness, 0.0)
        end = (step + 0.5) * self.timestep - lateness
        now, told = self._held_at(end)
        since = (end - told) / self.timestep
        if (since >= 1).all():  # what is held now has been held since the sub-step's beginning
            return Target(now, None, _ONE)
        before, _ = self._held_at((step - 0.5) * self.timestep - lateness)
        share = np.where(now == before, 1.0, np.minimum(np.maximum(since, 0), 1))
        return Target(now, None, _ONE) if (share == 1).all() else Target(now, before, share)

    def _held_at(self, time: Array) -> tuple[Array, Array]:
        """What is held at some times, and since when."""
        age = (time < self.told[:, :-1, None]).sum(axis=1, keepdims=True)
        told = np.take_along_axis(self.told[:, :, None], age, axis=1)
        return np.take_along_axis(self.held, age, axis=1), told


def _changes(plan: Schedule) -> tuple[Array, Array]:
    """The ticks that tell something new, with what they tell."""
    new = np.append(True, (np.diff(plan.held, axis=0) != 0).any(axis=1))
    return plan.time[new], plan.held[new]


_ONE = np.ones(())
