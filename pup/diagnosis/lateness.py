"""Motions that come at another time each time they are done, as repeats show.

Commands that are late by another time each time move a joint otherwise wherever it moves, by many
times the noise of its readings, and not at all at rest. Such errors grow with the speed, and go on
from tick to tick for as long as a motion lasts.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

EVIDENCE = 12.0
"""Logarithm of odds from which repeats are believed to come at other times; errors that follow each
other count as independent in it."""
TAILS = 3.0
"""Degrees of freedom of Student's distribution of the differences."""
SLOW = 0.25
"""Share of the differences, the slowest, that count as rest."""
NORMAL_MIDDLE = 0.455
"""Median of a normal variable's squares."""
TIMES = np.concatenate([[0.0], np.geomspace(2e-4, 0.1, 40)])
"""That motions may be late by, s."""
SIGMAS = 48
"""Standard deviations of readings that are tried, from the least to that of all differences."""
CUT, NORMAL_CUT = 0.98, 0.965
"""Quantile at which squares are cut, and the mean of those of a normal variable that are."""
MEMORY = 0.9
"""Correlation from tick to tick that errors have at most."""
FEW = 20
"""Pairs of ticks below which no correlation is told."""


@dataclass(frozen=True, eq=False)
class Difference:
    """Half the difference of two repeats' errors in one channel, of one recording's variance.

    Attributes:
      channel: which.
      errors: shape (n,), rad.
      speed: of the motion about them, by as much as lateness shows in `errors`, (n,), rad/s.
      samples: the numbers of those of the first of the two, shape (n,).
    """

    channel: int
    errors: Array
    speed: Array
    samples: NDArray[np.intp]


@dataclass(frozen=True)
class Lateness:
    """Noise of readings and of the times at which motions come.

    Attributes:
      sigma: standard deviation of the readings of each channel, rad.
      rho: correlation of readings from tick to tick, where nothing moves fast.
      spread: standard deviation of the time, s.
      memory: correlation from tick to tick of the errors that it makes.
    """

    sigma: dict[int, float]
    rho: float
    spread: float
    memory: float


def lateness(differences: Sequence[Difference], least: Array) -> Lateness | None:
    """By how much motions come earlier or later; None where repeats do not show that they do.

    Args:
      differences: between repeats.
      least: standard deviation that a channel's readings have at least, (n_channels,), rad.
    """
    channels = sorted({d.channel for d in differences})
    of = [[d for d in differences if d.channel == channel] for channel in channels]
    variances, spread = _fitted(
        [np.concatenate([d.errors for d in own]) ** 2 for own in of],
        [np.concatenate([d.speed for d in own]) ** 2 for own in of],
        least[channels] ** 2,
    )
    if not spread:
        return None
    rests, moves = [], []
    for d in differences:
        late = (spread * d.speed) ** 2
        variance = variances[channels.index(d.channel)] + late
        scaled, moving = d.errors / np.sqrt(variance), late > variance / 2
        rests.append((scaled, ~moving))
        moves.append((scaled, moving))
    sigma = {c: float(np.sqrt(v)) for c, v in zip(channels, variances, strict=True)}
    return Lateness(sigma, _memory(rests), spread, _memory(moves))


def trimmed(squares: Array) -> float:
    """Mean of some squares, as of normal variables, but for the largest.

    A foot that slips once or a packet that is lost is no noise.
    """
    cut = float(np.quantile(squares, CUT)) if len(squares) > 50 else np.inf
    mean = float(np.mean(np.minimum(squares, cut)))
    return mean / NORMAL_CUT if np.isfinite(cut) else mean


def _fitted(squares: Sequence[Array], speeds: Sequence[Array], least: Array) -> tuple[Array, float]:
    """Variance of each channel at rest, and the time by which motions are late; 0 for none.

    The likeliest of a grid, with tails that a packet which is lost now and then does not move.

    Args:
      squares: of each channel's differences, rad².
      speeds: likewise, (rad/s)².
      least: variance of each channel at least, rad².
    """
    costs = np.zeros(len(TIMES))
    best = np.zeros((len(squares), len(TIMES)))
    for k, (square, speed) in enumerate(zip(squares, speeds, strict=True)):
        grid = np.geomspace(least[k], max(float(np.mean(square)), least[k]), SIGMAS)
        for i, time in enumerate(TIMES):
            variance = grid[:, None] + time**2 * speed
            cost = (np.log(variance) + (TAILS + 1) * np.log1p(square / (TAILS * variance))).sum(1)
            best[k, i] = grid[np.argmin(cost)]
            costs[i] += cost.min() / 2
    i = int(np.argmin(costs))
    if costs[0] - costs[i] < EVIDENCE:
        return best[:, 0], 0.0
    time, variances = float(TIMES[i]), best[:, i]
    scaled = [q / (v + time**2 * s) for q, s, v in zip(squares, speeds, variances, strict=True)]
    # From the scale of such a distribution to a standard deviation.
    wider = trimmed(np.concatenate(scaled))
    rests = [own[s <= np.quantile(s, SLOW)] / wider for own, s in zip(scaled, speeds, strict=True)]
    # Most of a motion says little of its rests: those are as noisy as they look.
    looks = np.array([max(1.0, float(np.median(rest)) / NORMAL_MIDDLE) for rest in rests])
    return variances * wider * looks, time * float(np.sqrt(wider))


def _memory(runs: Sequence[tuple[Array, NDArray[np.bool_]]]) -> float:
    """Correlation from tick to tick of some of the errors in each run."""
    both = [(e[:-1][c[:-1] & c[1:]], e[1:][c[:-1] & c[1:]]) for e, c in runs]
    first, then = (np.concatenate([pair[i] for pair in both]) for i in (0, 1))
    if len(first) < FEW:
        return 0.0
    squares = float(np.mean(first**2 + then**2)) / 2
    return float(np.clip(np.mean(first * then) / max(squares, 1e-300), 0.0, MEMORY))
