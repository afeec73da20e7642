"""The noise floor: what differs between repeats of a motion, else what flickers at rest."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.residuals import Measured, Noise
from pup.physics.terms.scale import Scale
from pup.recording import Recording

Array = NDArray[np.float64]

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
BLOCK = 0.5
"""Errors are looked at in blocks of this length to tell noise from what a model lacks, s."""
PER_BLOCK = 15
"""Readings in such a block of what differs between repeats."""
FEWEST_BLOCKS = 8
"""Blocks of a channel below which they tell nothing of its noise."""
QUIET = 2.5
"""Blocks with more than so many times the usual mean square are not noise alone."""
CALMEST, UNEVEN = 0.25, 6.0
"""Where repeats differ by so many times the variance of this share of their blocks, the calmest,
what differs is more than noise."""
DIGITS = 6
"""Decimals of a radian that readings are told apart by."""
ON_GRID, MOSTLY = 0.1, 0.9
"""Readings are quantised where so many of them lie within this share of a step of a grid."""


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
    ground = any(measured.recordings[a].support == "ground" for a, _ in pairs)
    told, readings = {}, []
    for channel in range(measured.channels):
        parts = [d[channel] for d in differences if channel in d]
        if parts:
            told[channel] = _spread(parts if ground else _repeating(parts))
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


def _repeating(parts: Sequence[Array]) -> Sequence[Array]:
    """Differences of repeats less those blocks of them in which the motion itself was another.

    Commands that come late by another time each time move a servo otherwise after every step, by
    many times the noise of its readings, and not at all at rest. On the ground, impacts make
    motions differ everywhere, and no block tells the noise alone.
    """
    blocks = [b for p in parts for b in np.array_split(p, max(1, len(p) // PER_BLOCK))]
    squares = np.array([np.mean(block**2) for block in blocks])
    calm = float(np.quantile(squares, CALMEST))
    if len(blocks) < FEWEST_BLOCKS or np.mean(squares) <= UNEVEN * calm:
        return parts
    return [b for b, s in zip(blocks, squares, strict=True) if s < QUIET * calm]


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
