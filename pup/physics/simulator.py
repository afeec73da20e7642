"""The replay protocol: recordings times candidate parameters in, trajectories out.

Everything that asks what the robot would have done stands on it. A recording is first put on the
engine's sub-step grid (`Schedule`): positions are interpolated back to the ticks, so any spacing of
time is as good as another.

An engine that moves with the velocity it has just changed keeps velocities half a sub-step behind
positions. A force then acts at its position's time, and what belongs to sub-step n is what is
commanded from n - 1/2 to n + 1/2: taken from n to n + 1, the joints would run ahead by half of one.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pup.physics.parameters import Candidates
from pup.physics.rest import HINGES, Units, at_rest, ticks_at_rest
from pup.recording import Recording

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Schedule:
    """One recording on a grid of sub-steps.

    Attributes:
      time: of the ticks since the first, shape (n_ticks,), s.
      held: target from each tick on, shape (n_ticks, n_joints), rad.
      power: share of each sub-step, from half a one before to half a one after its
        beginning, with the torque on, shape (n_steps,).
      start: joint positions to start from, shape (n_joints,), rad.
      start_velocity: first joint velocity, shape (n_joints,), rad/s.
      tick_step: sub-step in which each tick falls, shape (n_ticks,).
      tick_fraction: where in it, 0 to 1, shape (n_ticks,).
    """

    time: Array
    held: Array
    power: Array
    start: Array
    start_velocity: Array
    tick_step: NDArray[np.int64]
    tick_fraction: Array

    @property
    def steps(self) -> int:
        """Number of sub-steps."""
        return len(self.power)


def schedule(
    recording: Recording, joints: Sequence[str], timestep: float, units: Units = HINGES
) -> Schedule:
    """Put a recording on a sub-step grid.

    Args:
      recording: its commands are held from row to row; a missing one holds the one before.
      joints: the order of the joints.
      timestep: sub-step, s.
      units: see `ticks_at_rest`.
    """
    order = [recording.joints.index(name) for name in joints]
    elapsed = recording.time - recording.time[0]
    where = elapsed / timestep + 1e-9  # ticks on the grid stay on it
    step = where.astype(np.int64)
    grid = (np.arange(step[-1] + 2) - 0.5) * timestep
    target = _held(recording.target[:, order])
    power = _held(recording.extras.get("torque_enabled", np.ones(len(elapsed)))[:, None])
    speeds = [recording.extras.get(f"velocity/{name}", np.zeros(1))[0] for name in joints]
    return Schedule(
        time=elapsed,
        held=target,
        power=_mean_over_steps(elapsed, power, grid)[:, 0],
        start=_start(recording, order, target, units),
        start_velocity=np.nan_to_num(np.array(speeds)),
        tick_step=step,
        tick_fraction=np.clip(where - step - 1e-9, 0.0, 1.0),
    )


def _held(values: Array) -> Array:
    """Fill missing rows with the row before (the first rows with the first known value)."""
    known = ~np.isnan(values)
    rows = np.where(known, np.arange(len(values))[:, None], 0)
    rows = np.maximum.accumulate(rows, axis=0)
    first = np.argmax(known, axis=0)
    return np.asarray(np.take_along_axis(values, np.maximum(rows, first), axis=0))


def _start(recording: Recording, order: Sequence[int], target: Array, units: Units) -> Array:
    """Positions to start from, shape (n_joints,): the mean of a rest, or the first ones.

    Where the first reading is missing, the next one counts as long as no target has changed
    before it; else the joint stood at its first target.
    """
    position = recording.position[:, order]
    resting = at_rest(position, ticks_at_rest(recording, units))
    read = np.argmax(~np.isnan(position), axis=0)
    joints = np.arange(position.shape[1])
    moved = np.argmax(
        np.append(target != target[0], np.ones((1, len(joints)), bool), axis=0), axis=0
    )
    known = ~np.isnan(position[read, joints]) & (read <= moved)
    first = np.where(known, position[read, joints], target[0])
    return np.asarray(np.where(np.isnan(resting), first, resting))


def _mean_over_steps(time: Array, held: Array, grid: Array) -> Array:
    """Mean over each grid cell of a signal (n_ticks, n) held from tick to tick, and before them."""
    knots = np.concatenate([[time[0] - 1.0], time, [max(grid[-1], time[-1]) + 1.0]])
    held = np.concatenate([held[:1], held])
    area = np.zeros((len(knots), held.shape[1]))
    area[1:] = np.cumsum(np.diff(knots)[:, None] * held, axis=0)
    at = np.stack([np.interp(grid, knots, column) for column in area.T], axis=1)
    return np.diff(at, axis=0) / np.diff(grid)[:, None]


@dataclass(frozen=True)
class Trajectories:
    """What the candidates did at the recordings' ticks.

    Ticks of all recordings stand behind one another. Where a simulation has diverged, from that
    tick on every value is NaN.

    Attributes:
      ticks: the ticks of each recording.
      position: joint positions, shape (n_candidates, n_ticks, n_joints), rad.
      tilt: torso roll and pitch, shape (n_candidates, n_ticks, 2), rad; NaN unless on the ground.
      feet: foot positions, shape (n_candidates, n_ticks, n_feet, 3), m; NaN unless on the ground.
    """

    ticks: tuple[slice, ...]
    position: Array
    tilt: Array
    feet: Array

    @property
    def diverged(self) -> NDArray[np.bool_]:
        """Whether a candidate's simulation broke down, shape (n_candidates, n_recordings)."""
        last = [np.isnan(self.position[:, part.stop - 1]).any(axis=-1) for part in self.ticks]
        return np.stack(last, axis=1)


def tick_slices(recordings: Sequence[Recording]) -> tuple[slice, ...]:
    """Where each recording's ticks stand in packed arrays."""
    ends = np.cumsum([len(r.time) for r in recordings])
    return tuple(slice(int(e - len(r.time)), int(e)) for r, e in zip(recordings, ends, strict=True))


class Simulator(Protocol):
    """Replays one fixed set of recordings under any number of candidates."""

    recordings: tuple[Recording, ...]

    def replay(self, candidates: Candidates) -> Trajectories:
        """Simulate every recording under every candidate.

        A simulation that breaks down is reported in the trajectories, never raised. Results do
        not depend on how candidates are grouped into calls.
        """
        ...
