"""Parameters that differ between halves of the data: the print of a mechanism that is missing.

Under a right model a servo's gains and limit are the same whether a foot touches the floor or not,
and whether the joint is fast or slow. Each half of the data asks for its own; how they differ is a
fingerprint, and with the missing effect in the model the two come together.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from pup.diagnosis.evidence import Projector
from pup.diagnosis.fit import Fit
from pup.diagnosis.replays import Replays
from pup.diagnosis.residuals import LOST, Measured, Noise
from pup.diagnosis.signals import Servo, servos, signals

Array = NDArray[np.float64]

KINDS = ("kp", "kd", "tau_max")
EXPECTED = float(np.log(2))
"""Standard deviation of a split before anything is known, of a logarithm."""
FURTHEST = 0.7
"""A split is followed at most so far in one step, of a logarithm."""
LEAST = 40
"""Samples that each half of a joint group needs."""
WORTH = 0.01
"""Splits that are less probable than this by chance are replayed."""
BAND = 1.645
"""Standard deviations of a 90 % interval."""


@dataclass(frozen=True)
class Half:
    """Two parts of the data.

    Attributes:
      first: name of one, such as `fast`.
      second: name of the other.
      sign: 1 in the one, -1 in the other, 0 in neither, shape (n_samples,).
    """

    first: str
    second: str
    sign: Array


@dataclass(frozen=True)
class Ratio:
    """A parameter of the first half over that of the second, with its 90 % interval."""

    parameter: str
    value: float
    lower: float
    upper: float
    surprise: float
    """By how many standard deviations it differs from 1."""


@dataclass(frozen=True)
class Split:
    """How one group's servos differ between two halves of the data.

    Attributes:
      group: the joint group.
      first: name of one half.
      second: name of the other.
      ratios: of kp, kd and tau_max.
      wald: squared difference in units of its covariance.
      chance: probability that a right model differs as much.
      promised: drop of chi-squared of two sets of parameters, by the linear model.
      gained: the same by simulation; None where it was not worth one.
    """

    group: str
    first: str
    second: str
    ratios: tuple[Ratio, ...]
    wald: float
    chance: float
    promised: float
    gained: float | None

    @property
    def key(self) -> tuple[str, str]:
        """What is told apart, for comparing fits before and after a term was added."""
        return self.group, self.first


def splits(fit: Fit, replays: Replays, noise: Noise) -> tuple[Split, ...]:
    """Test each group's parameters for a difference between halves of the data.

    Args:
      fit: with its Jacobian; a nominal one, or one with terms, to see whether they close the gap.
      replays: simulates.
      noise: weighs the samples.
    """
    assert fit.jacobian is not None and fit.residual is not None
    simulated = replays([fit.row()])[0]
    laws = servos(replays, fit.values)
    found = [
        _Split(group, columns, half, fit)
        for group, columns in _groups(replays.measured, fit)
        for half in _halves(replays.measured, simulated, laws, group)
    ]
    worth = [split for split in found if split.chance < WORTH]
    gained = _replayed(worth, fit, replays, noise)
    by_split = dict(zip(map(id, worth), gained, strict=True))
    return tuple(split.told(by_split.get(id(split))) for split in found)


def _groups(measured: Measured, fit: Fit) -> Iterator[tuple[str, list[int]]]:
    """Each group and the columns of its parameters."""
    for group in measured.robot.groups:
        names = [f"{kind}/{group}" for kind in KINDS]
        yield group, [fit.names.index(n) for n in names if n in fit.names]


class _Split:
    """One group's parameters, free to differ between two halves."""

    def __init__(self, group: str, columns: list[int], half: Half, fit: Fit) -> None:
        assert fit.jacobian is not None and fit.residual is not None
        self.group, self.half, self.columns = group, half, columns
        self.names = [fit.names[i].partition("/")[0] for i in columns]
        contrast = fit.jacobian[:, columns] * half.sign[:, None] / 2
        left = Projector(fit.jacobian)(contrast)
        precision = left.T @ left + np.eye(len(columns)) / EXPECTED**2
        self.covariance = np.linalg.inv(precision)
        self.shift = self.covariance @ (left.T @ fit.residual)
        self.promised = float(2 * self.shift @ (left.T @ fit.residual) - self._square(left))
        # What the data alone say: in directions they do not see there is nothing to test.
        vectors, lengths, _ = np.linalg.svd(left, full_matrices=False)
        seen = lengths > 1 / EXPECTED
        self.wald = float(((vectors[:, seen].T @ fit.residual) ** 2).sum())
        self.chance = float(stats.chi2.sf(self.wald, int(seen.sum()))) if seen.any() else 1.0
        shared = np.linalg.lstsq(fit.jacobian, contrast @ self.shift, rcond=1e-6)[0]
        self.moved = -shared  # of all parameters, so that the halves differ but not their mean
        self.fit = fit

    def _square(self, left: Array) -> float:
        moved = left @ self.shift
        return float(moved @ moved)

    def rows(self) -> list[dict[str, float]]:
        """The model as each half would have it."""
        told = []
        low, high = ([getattr(c, e) for c in self.fit.coordinates] for e in ("lower", "upper"))
        for sign in (0.5, -0.5):
            step = self.moved.copy()
            step[self.columns] += sign * self.shift
            at = self.fit.at + np.clip(step, -FURTHEST, FURTHEST)
            told.append(self.fit.row(np.clip(at, low, high)))
        return told

    def told(self, gained: float | None) -> Split:
        """What is said of it."""
        deviation = np.sqrt(np.diag(self.covariance))
        ratios = tuple(
            Ratio(
                name,
                float(np.exp(shift)),
                float(np.exp(shift - BAND * sd)),
                float(np.exp(shift + BAND * sd)),
                float(shift / sd),
            )
            for name, shift, sd in zip(self.names, self.shift, deviation, strict=True)
        )
        return Split(
            self.group,
            self.half.first,
            self.half.second,
            ratios,
            self.wald,
            self.chance,
            self.promised,
            gained,
        )


def _replayed(found: Sequence[_Split], fit: Fit, replays: Replays, noise: Noise) -> list[float]:
    """Drops of chi-squared by simulation, each half with its own parameters."""
    if not found:
        return []
    measured = replays.measured
    simulated = replays([row for split in found for row in split.rows()])
    out = []
    for split, first, second in zip(found, simulated[::2], simulated[1::2], strict=True):
        mine = np.where(split.half.sign > 0, first, second)
        mine = np.where(split.half.sign == 0, (first + second) / 2, mine)
        errors = measured.values - np.where(np.isnan(mine), measured.values + LOST, mine)
        out.append(fit.chi2 - float((measured.whiten(errors, noise) ** 2).sum()))
    return out


def _halves(
    measured: Measured, simulated: Array, laws: Sequence[Servo], group: str
) -> Iterator[Half]:
    """Halves of the data of which both show the group."""
    robot = measured.robot
    members = np.flatnonzero(robot.group_index == robot.groups.index(group))
    own = np.isin(measured.channel, members)
    speed, load = _motion(measured, simulated, laws)
    ground = np.array([r.support == "ground" for r in measured.recordings])[measured.recording]
    lasted = np.array([r.time[-1] - r.time[0] for r in measured.recordings])[measured.recording]

    def half(first: str, second: str, inside: NDArray[np.bool_]) -> Iterator[Half]:
        if min((own & inside).sum(), (own & ~inside).sum()) >= LEAST:
            yield Half(first, second, np.where(inside, 1.0, -1.0))

    def middle(values: Array) -> float:
        return float(np.median(values[own])) if own.any() else np.inf

    yield from half("on the ground", "in the air", ground)
    yield from half("fast", "slow", speed > middle(speed))
    numbers = range(len(measured.recordings))
    burden = np.array([_mean(load, own & (measured.recording == n)) for n in numbers])
    yield from half("loaded", "unloaded", (burden > np.nanmedian(burden))[measured.recording])
    yield from half("late", "early", measured.time > lasted / 2)


def _mean(values: Array, inside: NDArray[np.bool_]) -> float:
    return float(values[inside].mean()) if inside.any() else np.nan


def _motion(measured: Measured, simulated: Array, laws: Sequence[Servo]) -> tuple[Array, Array]:
    """Speed (rad/s) and share of its largest torque of each sample's joint."""
    speed, load = np.zeros(len(simulated)), np.zeros(len(simulated))
    for recording in range(len(measured.recordings)):
        for joint, law in enumerate(laws):
            told = signals(measured, simulated, law, recording, joint)
            if told is not None:
                run = (measured.recording == recording) & (measured.channel == joint)
                speed[run], load[run] = np.abs(told.velocity), np.abs(told.torque) / law.limit
    return speed, load
