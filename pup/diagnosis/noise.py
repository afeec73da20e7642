"""The noise floor: what differs between repeats of a motion, else what flickers at rest."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.lateness import NORMAL_MIDDLE, Difference, lateness, trimmed
from pup.diagnosis.residuals import Measured, Noise
from pup.diagnosis.steady import steady
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
BLOCK = 0.5
"""Errors are looked at in blocks of this length to tell noise from what a model lacks, s."""
FEWEST_BLOCKS = 8
"""Blocks of a channel below which they tell nothing of its noise."""
QUIET = 2.5
"""Blocks with more than so many times the usual mean square are not noise alone."""
SAME_SIGMA, SAME_RHO = 0.1, 0.15
"""Noise told anew that differs by less, as a share and in its memory, is what was assumed."""
ASTRAY = 1.7
"""Noise told anew that is larger by more is no noise: the model is wrong at that channel."""
GAP = 1.7
"""Readings further apart than so many of the usual times have lost some between them."""
DIGITS = 6
"""Decimals of a radian that readings are told apart by."""
WHOLE = 2.65
"""By so much the deviation of normal noise is larger than that of its quieter half."""
ON_GRID, MOSTLY = 0.1, 0.9
"""Readings are quantised where so many of them lie within this share of a step of a grid."""
KIND = 30
"""A channel is as noisy as its kind until more than so many readings of its own tell more."""


@dataclass(frozen=True)
class Spread:
    """What a channel tells of its noise.

    Attributes:
      sigma: standard deviation, rad.
      rho: lag-one correlation.
      readings: that tell no more than noise; 0 where what a model lacks may be among it.
    """

    sigma: float
    rho: float
    readings: int = 0


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
      errors: measured minus simulated, shape (n_samples,), rad; NaN says nothing, here and below.
    """
    pairs = repeats(measured)
    differing = differences(measured, errors)
    told: dict[int, Spread] = {}
    readings, late = [], None
    if differing:
        # On the ground, impacts make motions differ everywhere, and no rest tells the noise alone.
        ground = any(measured.recordings[a].support == "ground" for a, _ in pairs)
        late = None if ground else lateness(differing, _least(measured))
        told = spreads(differing)
        readings = [spread.readings for spread in told.values()]
        if late:
            told = {c: replace(told[c], sigma=s, rho=late.rho) for c, s in late.sigma.items()}
    source: Literal["repeats", "assumed"] = "repeats" if told else "assumed"
    for kind in _kinds(measured):
        if told.keys().isdisjoint(kind):  # such as tilts, where only what hangs was done again
            flickers = ((c, _flicker(measured, errors, c)) for c in kind)
            told |= {c: flicker for c, flicker in flickers if flicker}
    noise = _pooled(measured, told, source, int(np.median(readings)) if readings else 0)
    return replace(noise, late=late.spread, rho_late=late.memory) if late else noise


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
        usual = np.median(squares)  # 0 of a joint at rest that is simulated to the last digit
        kept = [b for b, s in zip(blocks, squares, strict=True) if s <= QUIET * usual]
        variance = float(np.mean(np.concatenate(kept) ** 2))
        follows = float(np.mean(np.concatenate([b[1:] * b[:-1] for b in kept])))
        rho = max(follows / max(variance, 1e-300), 0.0)
        told[channel] = Spread(float(np.sqrt(variance)), rho)
    return _pooled(measured, told, "assumed", 0)


def told_anew(before: Noise, measured: Measured, errors: Array) -> Noise | None:
    """Noise to weigh by from now on, by what a model leaves; None where it stays as it was.

    A channel that the model is wrong at keeps what it had, and where it is wrong at most of them,
    what it leaves says nothing of noise. Wrong is a model that leaves much more than was thought,
    unless that is noise by its looks: how errors flicker tells little of noise with a memory.

    Args:
      before: the noise that the model was fitted by.
      measured: the samples.
      errors: measured minus simulated, shape (n_samples,), rad.
    """
    after = quiet_noise(measured, errors)
    seen = np.unique(measured.channel)
    larger = after.sigma / before.sigma
    astray = (larger > ASTRAY) & ~steady(measured, errors)
    same = np.abs(larger - 1) < SAME_SIGMA
    unchanged = same & (np.abs(after.rho - before.rho) < SAME_RHO)
    if unchanged.all() or np.mean(astray[seen]) > 0.5:
        return None
    return replace(
        after,
        sigma=np.where(astray, before.sigma, after.sigma),
        rho=np.where(astray, before.rho, after.rho),
    )


def _blocks(measured: Measured, errors: Array, channel: int) -> list[Array]:
    """Errors of a channel, in blocks of some time."""
    told: list[Array] = []
    for number in range(len(measured.recordings)):
        own = _told(measured, errors, number, channel)
        edges = np.flatnonzero(np.diff(np.floor(measured.time[own] / BLOCK))) + 1
        told += [part for part in np.split(errors[own], edges) if len(part) >= 4]
    return told


def _kinds(measured: Measured) -> tuple[range, range]:
    """The channels of joints and those of tilts."""
    joints = len(measured.robot.joints)
    return range(joints), range(joints, joints + 2)


def _pooled(
    measured: Measured,
    told: dict[int, Spread],
    source: Literal["repeats", "assumed"],
    readings: int,
) -> Noise:
    """Channels that say nothing take the median of their kind, which shares its correlation."""
    noise = assumed_noise(measured)
    least = _least(measured)
    sigma, rho = noise.sigma.copy(), noise.rho.copy()
    for kind in _kinds(measured):
        known = [told[c] for c in kind if c in told]
        if not known:
            continue
        middle = float(np.median([spread.sigma for spread in known]))
        shared = float(np.clip(np.median([spread.rho for spread in known]), 0.0, 0.9))
        for channel in kind:
            own = told.get(channel, Spread(middle, shared))
            # A channel's few samples say less than all of its kind together, and a joint that
            # friction holds may be quiet at rest alone; one that is noisier is believed.
            noisier = own.sigma > middle
            belief = own.readings / (own.readings + KIND) if noisier else 0.0
            weight = max(0.5, belief)
            variance = weight * own.sigma**2 + (1 - weight) * middle**2
            sigma[channel] = max(least[channel], np.sqrt(variance))
            rho[channel] = belief * np.clip(own.rho, 0.0, 0.9) + (1 - belief) * shared
    return Noise(sigma, rho, source, readings)


def spreads(differences: Sequence[Difference]) -> dict[int, Spread]:
    """Noise of each channel, by what differs."""
    by_channel: dict[int, list[Array]] = {}
    for difference in differences:
        by_channel.setdefault(difference.channel, []).append(difference.errors)
    return {channel: _spread(parts) for channel, parts in by_channel.items()}


def _least(measured: Measured) -> Array:
    """Standard deviation that each channel's readings have at least, rad."""
    angle = Scale.of(measured.robot).angle
    return np.asarray(np.maximum(LEAST * angle, quanta(measured) / np.sqrt(12)))


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


def _spread(parts: Sequence[Array]) -> Spread:
    """Noise by some runs of differences."""
    variance, follows = _moments(parts)
    return Spread(float(np.sqrt(variance)), follows / max(variance, 1e-300), sum(map(len, parts)))


def _moments(parts: Sequence[Array]) -> tuple[float, float]:
    """Variance and lag-one covariance of some runs."""
    variance = trimmed(np.concatenate(parts) ** 2)
    return variance, float(np.mean(np.concatenate([p[1:] * p[:-1] for p in parts])))


def repeats(measured: Measured) -> list[tuple[int, int]]:
    """Pairs of recordings of one motion done again under one setup."""
    alike: dict[object, list[int]] = {}
    for first, members in measured.families().items():
        for number in members:
            recording = measured.recordings[number]
            setup = recording.support, tuple(sorted(recording.setup.items()))
            alike.setdefault((first, setup), []).append(number)
    return [pair for members in alike.values() for pair in pairwise(members)]


def differences(measured: Measured, errors: Array) -> list[Difference]:
    """What differs between repeats, by channel.

    Args:
      measured: the samples.
      errors: measured minus simulated, shape (n_samples,), rad.
    """
    return [d for a, b in repeats(measured) for d in _differences(measured, errors, a, b)]


def _differences(measured: Measured, errors: Array, a: int, b: int) -> list[Difference]:
    """What differs between two repeats, by channel."""
    out = []
    for channel in range(measured.channels):
        first, second = (_told(measured, errors, number, channel) for number in (a, b))
        if first.sum() < 5 or second.sum() < 5:
            continue
        time, other = measured.time[first], measured.time[second]
        at = np.clip(np.searchsorted(other, time) - 1, 0, len(other) - 2)
        # Between readings that are far apart, what was lost there is no difference.
        apart = np.diff(other)
        near = (time >= other[0]) & (time <= other[-1]) & (apart[at] < GAP * np.median(apart))
        if near.sum() < 5:
            continue
        time, at = time[near], at[near]
        share = (time - other[at]) / apart[at]
        told = errors[second]
        matched = (1 - share) * told[at] + share * told[at + 1]
        variance = 1 + (1 - share) ** 2 + share**2  # of the difference, in one reading's
        difference = (errors[first][near] - matched) / np.sqrt(variance)
        speeds = measured.speed[first][near] ** 2 + measured.speed[second][at] ** 2
        speed = np.sqrt(speeds / variance)  # neighbours are late together
        samples = np.flatnonzero(first)[near]
        out.append(Difference(channel, difference, speed, samples))
    return out


def flutter(measured: Measured, errors: Array, channel: int) -> float | None:
    """What a channel's readings flutter by from tick to tick, where they are quiet, rad.

    Noise without a memory is as large; one that remembers itself is larger. None where nothing was
    read. A joint that is still on its way, or slips now and then, flutters as when it stands.
    """
    steps, bends = _changes(measured, errors, channel)
    told = _bending(bends)
    if told is None or not steps:
        return told
    middle = float(np.median(np.concatenate([np.diff(rest) for rest in steps]) ** 2))
    return min(told, float(np.sqrt(middle / NORMAL_MIDDLE / 6)))


def _flicker(measured: Measured, errors: Array, channel: int) -> Spread | None:
    """Noise of a channel, from how its errors flicker while no command changes.

    Where commands never rest, the quieter half of all that bends stands for rest; where errors
    drift at rest, bends tell the noise alone, but not its memory.
    """
    steps, bends = _changes(measured, errors, channel)
    if sum(map(len, steps)) >= 8:
        variance, follows = _moments(steps)
        rho = max(1 + 2 * follows / max(variance, 1e-300), 0.0)
        if rho <= MEMORY:
            sigma = float(np.sqrt(variance / (2 * (1 - rho))))
            return Spread(sigma, rho, sum(map(len, steps)))
    alone = _bending(bends)
    return None if alone is None else Spread(alone, 0.0, sum(map(len, bends)))


def _bending(bends: Sequence[Array]) -> float | None:
    """Standard deviation of noise without a memory, by second differences."""
    return float(np.sqrt(_moments(bends)[0] / 6)) if bends else None


def _changes(measured: Measured, errors: Array, channel: int) -> tuple[list[Array], list[Array]]:
    """First differences of errors while no command changes, and second ones of what is quiet."""
    steps: list[Array] = []
    bends: list[Array] = []
    for number, recording in enumerate(measured.recordings):
        chosen = _told(measured, errors, number, channel)
        if chosen.sum() < 8:
            continue
        step = np.diff(errors[chosen])
        calm = _calm(recording, measured.time[chosen])
        parts = np.split(step, np.flatnonzero(np.diff(calm)) + 1)[0 if calm[0] else 1 :: 2]
        rests = [part for part in parts if len(part) >= 4]
        steps += rests
        bend = np.diff(step)
        quiet = WHOLE * bend[np.abs(bend) <= np.median(np.abs(bend))]
        bends += [np.diff(rest) for rest in rests] or [quiet]
    return steps, bends


def _told(measured: Measured, errors: Array, recording: int, channel: int) -> NDArray[np.bool_]:
    """Which samples are of a channel in a recording, and of a simulation that had not diverged."""
    own = (measured.recording == recording) & (measured.channel == channel)
    return np.asarray(own & np.isfinite(errors))


def _calm(recording: Recording, time: Array) -> NDArray[np.bool_]:
    """Whether no command changes from one of some readings to the next, nor did just before."""
    changed = np.any(np.diff(recording.target, axis=0) != 0, axis=1)
    elapsed = recording.time - recording.time[0]
    last = np.maximum.accumulate(np.where(np.r_[False, changed], elapsed, 0.0))
    still = np.interp(time, elapsed, elapsed - last) > STILL
    return np.asarray(still[1:] & still[:-1])
