"""What was measured, as one vector, and what in it is noise.

All that follows compares trajectories with this vector. Its samples stand recording by recording,
channel by channel, in order of time: a channel is a joint's position or, on the ground, the torso's
roll or pitch. Errors of one channel in one recording form a run, whose noise may be correlated from
tick to tick; `whiten` makes any such errors, or sensitivities, of unit variance and uncorrelated.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_banded

from pup.diagnosis.falls import standing
from pup.diagnosis.knocks import knocked
from pup.physics.simulator import Trajectories, tick_slices
from pup.physics.terms.scale import Scale
from pup.recording import Recording, originals
from pup.recording_cuts import with_commands
from pup.robot import RobotDescription

Array = NDArray[np.float64]

SETTLING = 0.1
"""Time after a recording's start that is left out: its first readings carry noise too, s."""
UNSURE = {"repeats": 0.05, "assumed": 0.15}
"""By what share a noise floor's variance may be wrong, however many readings tell it."""
AROUND = 0.06
"""Time before and after a sample whose speed counts as that of the motion about it, s."""
NEARBY = 0.045
"""The same for the readings that tell a speed: through several, noise hardly tilts a line."""
BESIDE = 1.2
"""Both reach this share of the time between readings at least: the next ones to both sides."""
CALM = 0.012
"""Readings that differ by less are of a joint at rest, rad."""
FLAT = 1.4
"""Pitch beyond which the torso lies on its face or back, rad."""
TILTS = "roll", "pitch"
"""The torso's channels, which follow those of the joints."""
LOST = 3.0
"""Error counted for a simulation that broke down, rad."""


@dataclass(frozen=True)
class Noise:
    """Noise of the channels.

    Attributes:
      sigma: standard deviation of each channel, shape (n_channels,), rad.
      rho: its correlation from tick to tick, same shape.
      source: whether repeated recordings tell it or it is assumed.
      readings: differences of repeats that tell a channel's; 0 where none do.
      late: standard deviation of the time by which motions come early or late when they are done
        again, s: of errors that grow with the speed.
      rho_late: correlation of these errors from tick to tick.
    """

    sigma: Array
    rho: Array
    source: Literal["repeats", "assumed"]
    readings: int = 0
    late: float = 0.0
    rho_late: float = 0.0

    @property
    def unsure(self) -> float:
        """Standard deviation of the floor's variance, as a share of it."""
        few = np.sqrt(2 / self.readings) if self.readings else 0.0
        return float(np.hypot(UNSURE[self.source], few))


@dataclass(frozen=True, eq=False)
class Measured:
    """Samples of some recordings.

    Attributes:
      robot: the robot.
      recordings: what was measured, each with its start steadied.
      index: where the samples stand in the trajectories' positions and tilts, shape (n_samples,).
      values: what was measured, shape (n_samples,), rad.
      recording: which recording a sample is of.
      channel: which channel: the joints in the robot's order, then roll and pitch.
      time: of the sample since the recording's start, s.
    """

    robot: RobotDescription
    recordings: tuple[Recording, ...]
    index: NDArray[np.int64]
    values: Array
    recording: NDArray[np.int64]
    channel: NDArray[np.int64]
    time: Array

    @classmethod
    def of(
        cls,
        robot: RobotDescription,
        recordings: Sequence[Recording],
        wholes: Sequence[Recording] | None = None,
    ) -> "Measured":
        """The samples of some recordings.

        Args:
          robot: the robot.
          recordings: its recordings.
          wholes: what each is the beginning of: whether a stop was met, a whole recording tells.
        """
        angle, joints = Scale.of(robot).angle, len(robot.joints)
        steadied = tuple(steady_start(with_commands(standing(r)), CALM * angle) for r in recordings)
        ticks = sum(len(r.time) for r in steadied)
        parts = []
        for number, (recording, whole, part) in enumerate(
            zip(steadied, wholes or steadied, tick_slices(steadied), strict=True)
        ):
            elapsed = recording.time - recording.time[0]
            rows = np.arange(part.start, part.stop)
            told = (elapsed >= SETTLING) & ~knocked(robot, whole)[: len(elapsed)]
            for channel, values in enumerate(_channels(robot, recording)):
                kept = ~np.isnan(values) & told
                where = rows * joints + channel
                if channel >= joints:
                    where = ticks * joints + rows * 2 + channel - joints
                n = int(kept.sum())
                parts.append(
                    (where[kept], values[kept], [number] * n, [channel] * n, elapsed[kept])
                )
        index, values, of_recording, of_channel, time = (
            np.concatenate([np.asarray(p[i]) for p in parts]) for i in range(5)
        )
        return cls(
            robot, steadied, index, values, of_recording.astype(int), of_channel.astype(int), time
        )

    @property
    def channels(self) -> int:
        """Joints, roll and pitch."""
        return len(self.robot.joints) + 2

    @cached_property
    def grounded(self) -> NDArray[np.bool_]:
        """Which samples are of recordings on the ground, shape (n_samples,)."""
        return np.array([r.support == "ground" for r in self.recordings], dtype=bool)[
            self.recording
        ]

    @cached_property
    def _follows(self) -> NDArray[np.bool_]:
        """Whether a sample follows another of its run."""
        same = (np.diff(self.recording) == 0) & (np.diff(self.channel) == 0)
        return np.concatenate([[False], same])

    @cached_property
    def speed(self) -> Array:
        """How fast each channel moves about each sample, shape (n_samples,), rad/s."""
        told = np.zeros(len(self.values))
        for run in np.split(np.arange(len(self.values)), np.flatnonzero(~self._follows)[1:]):
            if len(run):
                told[run] = _speeds(self.time[run], self.values[run])
        return told

    def deviation(self, noise: Noise) -> Array:
        """Standard deviation of each sample's noise, shape (n_samples,), rad."""
        return np.hypot(noise.sigma[self.channel], noise.late * self.speed)

    def pick(self, trajectories: Trajectories) -> Array:
        """The trajectories at the samples, shape (n_candidates, n_samples); NaN where diverged."""
        n = len(trajectories.position)
        flat = np.hstack([trajectories.position.reshape(n, -1), trajectories.tilt.reshape(n, -1)])
        picked = flat[:, self.index]
        tilts = self.channel >= len(self.robot.joints)  # a turn more or less is the same
        turns = np.round((picked[:, tilts] - self.values[tilts]) / (2 * np.pi))
        picked[:, tilts] -= 2 * np.pi * turns
        return np.asarray(picked)

    def memory(self, noise: Noise) -> Array:
        """Correlation of each sample's noise with that of the one before, shape (n_samples,)."""
        # The share of readings in the variance.
        read = (noise.sigma[self.channel] / self.deviation(noise)) ** 2
        rho = noise.rho[self.channel] * read + noise.rho_late * (1 - read)
        return np.where(self._follows, rho, 0.0)

    def whiten(self, errors: Array, noise: Noise) -> Array:
        """Errors (..., n_samples), rad, in units of uncorrelated noise."""
        rho = self.memory(noise)
        scaled = errors / self.deviation(noise)
        before = np.concatenate([scaled[..., :1], scaled[..., :-1]], axis=-1)
        before = np.where(self._follows, before, 0.0)  # another run's may be lost
        return np.asarray((scaled - rho * before) / np.sqrt(1 - rho**2))

    def coloured(self, white: Array, noise: Noise) -> Array:
        """Errors (..., n_samples), rad, whose whitening is given."""
        rho = self.memory(noise)
        system = np.stack([np.ones_like(rho), np.append(-rho[1:], 0.0)])  # bidiagonal
        right = (white * np.sqrt(1 - rho**2)).reshape(-1, len(rho)).T
        scaled = solve_banded((1, 0), system, right).T.reshape(white.shape)
        return np.asarray(scaled * self.deviation(noise))

    def only(self, recordings: Sequence[int]) -> NDArray[np.bool_]:
        """Which samples are of some recordings."""
        return np.isin(self.recording, recordings)

    def motions(self) -> dict[str, list[int]]:
        """The recordings of each motion type."""
        types: dict[str, list[int]] = {}
        for number, recording in enumerate(self.recordings):
            types.setdefault(recording.motion, []).append(number)
        return types

    def families(self) -> dict[str, list[int]]:
        """The recordings of each motion, with those that do it again."""
        told: dict[str, list[int]] = {}
        for number, first in enumerate(originals(self.recordings)):
            told.setdefault(first, []).append(number)
        return told


def _channels(robot: RobotDescription, recording: Recording) -> list[Array]:
    """Positions in the robot's order, then roll and pitch where the torso is free.

    Where the torso lies on its face or back, roll turns over at once and tells nothing.
    """
    columns = [recording.position[:, recording.joints.index(name)] for name in robot.joint_names]
    if recording.support == "ground":
        absent = np.full(len(recording.time), np.nan)
        roll, pitch = (recording.extras.get(f"imu/{a}", absent) for a in TILTS)
        columns += [np.where(np.abs(pitch) > FLAT, np.nan, roll), pitch]
    return columns


def _speeds(time: Array, values: Array) -> Array:
    """Root mean square, about each time, of the slopes of lines through the values nearby."""
    apart = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    squares = _slopes(time, values, max(NEARBY, BESIDE * apart)) ** 2
    (total,), count = _sums(time, max(AROUND, BESIDE * apart), squares)
    return np.asarray(np.sqrt(np.maximum(total, 0.0) / count))


def _slopes(time: Array, values: Array, reach: float) -> Array:
    """Slopes of lines through the values near each time; 0 where there is only one."""
    x, y = time - time.mean(), values - values.mean()
    (sx, sy, sxx, sxy), count = _sums(time, reach, x, y, x * x, x * y)
    alone = count < 2
    return np.where(alone, 0.0, (count * sxy - sx * sy) / np.where(alone, 1, count * sxx - sx * sx))


def _sums(time: Array, reach: float, *values: Array) -> tuple[list[Array], NDArray[np.int64]]:
    """Sums of some values within reach of each time, and how many are summed."""
    first = np.searchsorted(time, time - reach)
    last = np.searchsorted(time, time + reach, side="right")
    sums = [np.concatenate([[0.0], np.cumsum(v)]) for v in values]
    return [s[last] - s[first] for s in sums], last - first


def steady_start(recording: Recording, small: float) -> Recording:
    """The recording with its first positions averaged over the time before anything moves.

    Where a joint stands at the start is where its simulation starts, and a joint with dry friction
    stays there: one reading's noise would stay with it.

    Args:
      recording: with the commands that each row holds.
      small: by what readings may differ that are noise and quantisation, no motion, rad.
    """
    moved = np.flatnonzero(np.any(recording.target != recording.target[0], axis=1))
    rest = int(moved[0]) if len(moved) else len(recording.time)
    rest = min(rest, 30)
    if rest < 3:
        return recording
    position = recording.position.copy()
    first = position[:rest]
    spread = np.nanmax(first, axis=0) - np.nanmin(first, axis=0)
    calm = spread < small
    position[0, calm] = np.nanmean(first[:, calm], axis=0)
    return replace(recording, position=position)
