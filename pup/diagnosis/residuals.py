"""What was measured, as one vector, and what in it is noise.

All that follows compares trajectories with this vector. Its samples stand recording by recording,
channel by channel, in order of time: a channel is a joint's position or, on the ground, the torso's
roll or pitch. Errors of one channel in one recording form a run, whose noise may be correlated from
tick to tick; `whiten` makes any such errors, or sensitivities, of unit variance and uncorrelated.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.knocks import knocked
from pup.physics.simulator import Trajectories, tick_slices
from pup.physics.terms.scale import Scale
from pup.recording import Recording
from pup.robot import RobotDescription

Array = NDArray[np.float64]

SETTLING = 0.1
"""Time after a recording's start that is left out: its first readings carry noise too, s."""
STILL = 0.3
"""A joint whose command has not changed for so long counts as still, s."""
ASSUMED = {"joint": 2e-3, "tilt": 5e-3}
"""Noise to begin with, rad; of a slide as much less as its range is."""
LEAST = 1e-4
"""No channel is believed to be less noisy than this, rad; slides as above."""
MEMORY = 0.85
"""Errors at rest with a longer memory from tick to tick are a drift, not noise."""
NORMAL_CUT = 0.965
"""Mean square of a normal variable whose squares are cut at their 98 % quantile."""
UNSURE = {"repeats": 0.05, "assumed": 0.15}
"""By what share a noise floor's variance may be wrong, however many readings tell it."""
BLOCK = 0.5
"""Errors are looked at in blocks of this length to tell noise from what a model lacks, s."""
FEWEST_BLOCKS = 8
"""Blocks of a channel below which they tell nothing of its noise."""
QUIET = 2.5
"""Blocks with more than so many times the usual mean square are not noise alone."""
DIGITS = 6
"""Decimals of a radian that readings are told apart by."""
ON_GRID, MOSTLY = 0.1, 0.9
"""Readings are quantised where so many of them lie within this share of a step of a grid."""
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
    """

    sigma: Array
    rho: Array
    source: Literal["repeats", "assumed"]
    readings: int = 0

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
    def of(cls, robot: RobotDescription, recordings: Sequence[Recording]) -> "Measured":
        """The samples of some recordings."""
        steadied = tuple(steady_start(recording) for recording in recordings)
        joints = len(robot.joints)
        ticks = sum(len(r.time) for r in steadied)
        parts = []
        for number, (recording, part) in enumerate(
            zip(steadied, tick_slices(steadied), strict=True)
        ):
            elapsed = recording.time - recording.time[0]
            rows = np.arange(part.start, part.stop)
            told = (elapsed >= SETTLING) & ~knocked(robot, recording)
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
    def _follows(self) -> NDArray[np.bool_]:
        """Whether a sample follows another of its run."""
        same = (np.diff(self.recording) == 0) & (np.diff(self.channel) == 0)
        return np.concatenate([[False], same])

    def pick(self, trajectories: Trajectories) -> Array:
        """The trajectories at the samples, shape (n_candidates, n_samples); NaN where diverged."""
        n = len(trajectories.position)
        flat = np.hstack([trajectories.position.reshape(n, -1), trajectories.tilt.reshape(n, -1)])
        return flat[:, self.index]

    def whiten(self, errors: Array, noise: Noise) -> Array:
        """Errors (..., n_samples), rad, in units of uncorrelated noise."""
        rho = np.where(self._follows, noise.rho[self.channel], 0.0)
        before = np.concatenate([errors[..., :1], errors[..., :-1]], axis=-1)
        sigma = noise.sigma[self.channel] * np.sqrt(1 - rho**2)
        return np.asarray((errors - rho * before) / sigma)

    def only(self, recordings: Sequence[int]) -> NDArray[np.bool_]:
        """Which samples are of some recordings."""
        return np.isin(self.recording, recordings)

    def motions(self) -> dict[str, list[int]]:
        """The recordings of each motion type."""
        types: dict[str, list[int]] = {}
        for number, recording in enumerate(self.recordings):
            types.setdefault(recording.motion, []).append(number)
        return types


def assumed_noise(measured: Measured) -> Noise:
    """Noise to weigh a first fit with."""
    joints = len(measured.robot.joints)
    angle = Scale.of(measured.robot).angle
    sigma = np.r_[np.full(joints, ASSUMED["joint"] * angle), np.full(2, ASSUMED["tilt"])]
    return Noise(sigma, np.zeros(joints + 2), "assumed")


def noise_floor(measured: Measured, errors: Array) -> Noise:
    """Noise of the channels, from what differs between repeats, else from what flickers at rest.

    Errors of a model that fits but roughly will do: what they share with the same motion done again
    is not noise, and what changes from one tick to the next while nothing is commanded is.

    Args:
      measured: the samples.
      errors: measured minus simulated, shape (n_samples,), rad.
    """
    pairs = repeats(measured)
    differences = [_difference(measured, errors, a, b) for a, b in pairs]
    told, readings = {}, []
    for channel in range(measured.channels):
        parts = [d[channel] for d in differences if channel in d]
        if parts:
            told[channel] = _spread(parts)
            readings.append(sum(map(len, parts)))
    source: Literal["repeats", "assumed"] = "repeats" if told else "assumed"
    if not told:
        for channel in range(measured.channels):
            flicker = _flicker(measured, errors, channel)
            if flicker:
                told[channel] = flicker
    return _pooled(measured, told, source, int(np.median(readings)) if readings else 0)


def quiet_noise(measured: Measured, errors: Array) -> Noise:
    """Noise of the channels where nothing was repeated, from what a good model leaves.

    Noise is everywhere alike; what a model still lacks shows in some motions and not in others.

    Args:
      measured: the samples.
      errors: measured minus simulated, shape (n_samples,), rad.
    """
    told = {}
    for channel in range(measured.channels):
        blocks = _blocks(measured, errors, channel)
        if len(blocks) < FEWEST_BLOCKS:
            continue
        squares = np.array([np.mean(block**2) for block in blocks])
        kept = [b for b, s in zip(blocks, squares, strict=True) if s < QUIET * np.median(squares)]
        variance = float(np.mean(np.concatenate(kept) ** 2))
        follows = float(np.mean(np.concatenate([b[1:] * b[:-1] for b in kept])))
        told[channel] = np.sqrt(variance), max(follows / max(variance, 1e-300), 0.0)
    return _pooled(measured, told, "assumed", 0)


def _blocks(measured: Measured, errors: Array, channel: int) -> list[Array]:
    """Errors of a channel, in blocks of some time."""
    told: list[Array] = []
    for number in range(len(measured.recordings)):
        own = (measured.recording == number) & (measured.channel == channel)
        edges = np.flatnonzero(np.diff(np.floor(measured.time[own] / BLOCK))) + 1
        told += [part for part in np.split(errors[own], edges) if len(part) >= 4]
    return told


def _pooled(
    measured: Measured,
    told: dict[int, tuple[float, float]],
    source: Literal["repeats", "assumed"],
    readings: int,
) -> Noise:
    """Channels that say nothing take the median of their kind; one kind shares its correlation."""
    joints = len(measured.robot.joints)
    noise = assumed_noise(measured)
    least = np.maximum(LEAST * Scale.of(measured.robot).angle, quanta(measured) / np.sqrt(12))
    sigma, rho = noise.sigma.copy(), noise.rho.copy()
    for kind in (range(joints), range(joints, joints + 2)):
        known = [told[c] for c in kind if c in told]
        if not known:
            continue
        middle = float(np.median([s for s, _ in known]))
        shared = float(np.clip(np.median([r for _, r in known]), 0.0, 0.9))
        for channel in kind:
            own = told.get(channel, (middle, shared))[0]
            # One channel's few samples say less than all of its kind together.
            sigma[channel] = max(least[channel], np.sqrt((own**2 + middle**2) / 2))
            rho[channel] = shared
    return Noise(sigma, rho, source, readings)


def quanta(measured: Measured) -> Array:
    """Steps that the channels are read in, shape (n_channels,), rad; 0 where they have none.

    A coarse encoder at rest tells the same value again and again, which is not to know it exactly.
    """
    steps = np.zeros(measured.channels)
    for channel in np.unique(measured.channel):
        values = measured.values[measured.channel == channel]
        gaps = np.diff(np.unique(np.round(values, DIGITS)))
        if not len(gaps):
            continue
        rounded = np.round(gaps, DIGITS - 1)
        _, which, counts = np.unique(rounded, return_inverse=True, return_counts=True)
        step = float(np.mean(gaps[which == np.argmax(counts)]))  # the commonest
        turns = values / step  # starts are means, and stand between steps
        off = turns - np.angle(np.mean(np.exp(2j * np.pi * turns))) / (2 * np.pi)
        if np.mean(np.abs(off - np.round(off)) < ON_GRID) > MOSTLY:
            steps[channel] = step
    return steps


def _spread(parts: Sequence[Array]) -> tuple[float, float]:
    """Standard deviation and lag-one correlation of some runs of differences."""
    variance, follows = _moments(parts)
    return float(np.sqrt(variance)), follows / max(variance, 1e-300)


def _moments(parts: Sequence[Array]) -> tuple[float, float]:
    """Variance and lag-one covariance of some runs."""
    squares = np.concatenate([p**2 for p in parts])
    # A foot that slips once or a lost packet is no noise: the mean of all but the largest.
    cut = float(np.quantile(squares, 0.98)) if len(squares) > 50 else np.inf
    variance = float(np.mean(np.minimum(squares, cut)))
    if np.isfinite(cut):
        variance /= NORMAL_CUT
    return variance, float(np.mean(np.concatenate([p[1:] * p[:-1] for p in parts])))


def repeats(measured: Measured) -> list[tuple[int, int]]:
    """Pairs of recordings of one motion done again under one setup."""
    names = {r.id: i for i, r in enumerate(measured.recordings)}
    families: dict[str, list[int]] = {}
    for number, recording in enumerate(measured.recordings):
        first = recording.repeat_of if recording.repeat_of in names else recording.id
        families.setdefault(str(first), []).append(number)
    pairs = []
    for members in families.values():
        pairs += list(pairwise(members))
    return pairs


def _difference(measured: Measured, errors: Array, a: int, b: int) -> dict[int, Array]:
    """Half the difference of two repeats' errors by channel, of one recording's variance."""
    out = {}
    for channel in range(measured.channels):
        first = (measured.recording == a) & (measured.channel == channel)
        second = (measured.recording == b) & (measured.channel == channel)
        if first.sum() < 5 or second.sum() < 5:
            continue
        time, other = measured.time[first], measured.time[second]
        inside = (time >= other[0]) & (time <= other[-1])
        if inside.sum() < 5:
            continue
        at = np.clip(np.searchsorted(other, time[inside]) - 1, 0, len(other) - 2)
        share = (time[inside] - other[at]) / (other[at + 1] - other[at])
        told = errors[second]
        matched = (1 - share) * told[at] + share * told[at + 1]
        variance = 1 + (1 - share) ** 2 + share**2  # of the difference, in one reading's
        out[channel] = (errors[first][inside] - matched) / np.sqrt(variance)
    return out


def _flicker(measured: Measured, errors: Array, channel: int) -> tuple[float, float] | None:
    """Noise of a channel, from how its errors flicker while no command changes.

    Where commands never rest, the quieter half of all that bends stands for rest; where errors
    drift at rest, bends tell the noise alone, but not its memory.
    """
    steps: list[Array] = []
    bends: list[Array] = []
    for number, recording in enumerate(measured.recordings):
        chosen = (measured.recording == number) & (measured.channel == channel)
        if chosen.sum() < 8:
            continue
        step = np.diff(errors[chosen])
        calm = _calm(recording, measured.time[chosen])
        parts = np.split(step, np.flatnonzero(np.diff(calm)) + 1)[0 if calm[0] else 1 :: 2]
        rests = [part for part in parts if len(part) >= 4]
        steps += rests
        bend = np.diff(step)
        quiet = 2 * bend[np.abs(bend) <= np.median(np.abs(bend))]
        bends += [np.diff(rest) for rest in rests] or [quiet]
    if sum(map(len, steps)) >= 8:
        variance, follows = _moments(steps)
        rho = max(1 + 2 * follows / max(variance, 1e-300), 0.0)
        if rho <= MEMORY:
            return float(np.sqrt(variance / (2 * (1 - rho)))), rho
    return (float(np.sqrt(_moments(bends)[0] / 6)), 0.0) if bends else None


def _calm(recording: Recording, time: Array) -> NDArray[np.bool_]:
    """Whether no command changes from one of some readings to the next, nor did just before."""
    changed = np.any(np.diff(recording.target, axis=0) != 0, axis=1)
    elapsed = recording.time - recording.time[0]
    last = np.maximum.accumulate(np.where(np.r_[False, changed], elapsed, 0.0))
    still = np.interp(time, elapsed, elapsed - last) > STILL
    return np.asarray(still[1:] & still[:-1])


def _channels(robot: RobotDescription, recording: Recording) -> list[Array]:
    """Positions in the robot's order, then roll and pitch where the torso is free."""
    columns = [recording.position[:, recording.joints.index(name)] for name in robot.joint_names]
    if recording.support == "ground":
        absent = np.full(len(recording.time), np.nan)
        columns += [recording.extras.get(f"imu/{a}", absent) for a in ("roll", "pitch")]
    return columns


def steady_start(recording: Recording) -> Recording:
    """The recording with its first positions averaged over the time before anything moves.

    Where a joint stands at the start is where its simulation starts, and a joint with dry friction
    stays there: one reading's noise would stay with it.
    """
    moved = np.flatnonzero(np.any(recording.target != recording.target[0], axis=1))
    rest = int(moved[0]) if len(moved) else len(recording.time)
    rest = min(rest, 30)
    if rest < 3:
        return recording
    position = recording.position.copy()
    first = position[:rest]
    spread = np.nanmax(first, axis=0) - np.nanmin(first, axis=0)
    calm = spread < 0.012  # noise and quantisation, no motion
    position[0, calm] = np.nanmean(first[:, calm], axis=0)
    return replace(recording, position=position)
