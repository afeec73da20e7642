"""The nominal model's fit, and whether it may be trusted.

An optimiser that stops short looks exactly like missing physics. So the fit is made from several
starts, which must agree, and of a simulation of itself, whose parameters it must find again.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.beginnings import SPARE, begun, moved, nearer, noise_like
from pup.diagnosis.coordinates import Coordinate, described_at, nominal_coordinate
from pup.diagnosis.fit import Fit
from pup.diagnosis.fitting import complete, fit_together, start_best
from pup.diagnosis.noise import noise_floor
from pup.diagnosis.replays import Replays
from pup.diagnosis.residuals import Noise
from pup.physics.parameters import ParameterSpace

Array = NDArray[np.float64]

STARTS, LANDED = 3, 2
FLOORS = (0.2, 0.35, 0.5, 0.7, 0.9, 1.2)
"""Frictions that a fit may start from on the ground."""
LIMITS = 8
"""Torque limits of a group that a fit on the ground may go on from, over the whole search range."""
SPREAD = 0.35
"""Of the starts around the nominal values, in logarithms."""
NEAR = (0.1, 0.025, 0.025, 0.01)
"""Spreads of starts around the best fit, where far ones disagree, one after the other. The smaller
are for where a start may lead nowhere: a robot on the ground falls, a servo gets out of step."""
AGREEMENT = 3e-3
"""Two starts agree in chi-squared to this share of it, to ABSOLUTE, to SPARE of the noise, or to
EXCESS of what is more than noise: where much is missing, a fit has many ends that lack it all the
same."""
EXCESS = 0.03
ABSOLUTE = 5.0
OTHER = 1.5
"""A start that ends so far above a fit to the noise has ended elsewhere and says nothing of it."""
SHORT = 0.06
"""Share of the noise that a fit may leave whose starts agree: it counts against every effect, and
only large ones are told."""
ROUGH = 2e-3
"""Relative gain of chi-squared at which the starts may end: all that follows is the noise floor."""
WIDER = (4.0, 1.0, 10.0, 4.0, 1.0, 0.3)
"""Widths of finite differences with which starts that disagree are taken further."""
SELF = 3.0
"""A refit of the fit's own simulation may be off by so many standard deviations."""
SELVES = 3
"""Refits of its own simulation, of which one must find it again."""
FREE = ("kp", "kd", "tau_max", "armature", "ground_friction")


@dataclass(frozen=True)
class Certificate:
    """Whether the nominal fit has converged.

    Attributes:
      starts: chi-squared that the two best starts lead to.
      agree: whether they agree.
      recovered: largest error of a refit of its own simulation, in standard deviations; infinite
        until that is made, see `certified`, and where starts do not agree.
      left: chi-squared by which that refit stops short, and starts that end near each other or near
        the noise: kinks and motions out of step catch a fit. What gains no more is no evidence.
      samples: number of samples.
    """

    starts: tuple[float, ...]
    agree: bool
    recovered: float = np.inf
    left: float = np.inf
    samples: int = 0

    def beside(self, whole: "Certificate") -> "Certificate":
        """That of some recordings, with what a fit to all of them stops short by, in contact.

        A nominal fit that has lost track of motions stops further off than a better one would: no
        more counts than a certificate allows.
        """
        left = max(self.left, min(whole.left, SHORT * whole.samples))
        return replace(self, left=left, samples=whole.samples)

    @property
    def made(self) -> bool:
        """Whether anything was fitted at all; see `unfitted`."""
        return len(self.starts) > 1

    @property
    def holds(self) -> bool:
        """Whether a verdict may be given."""
        found_again = self.recovered <= SELF or self.left <= SHORT * self.samples
        return self.agree and found_again


@dataclass(frozen=True)
class Nominal:
    """The nominal model fitted.

    Attributes:
      fit: with its Jacobian.
      noise: the noise floor that it leads to.
      certificate: whether it has converged.
    """

    fit: Fit
    noise: Noise
    certificate: Certificate


def free_names(space: ParameterSpace, ground: bool) -> tuple[str, ...]:
    """What the nominal fit may move (docs/diagnosis.md)."""
    return tuple(
        name
        for name in space.names
        if name.split("/")[0] in FREE and (ground or name != "ground_friction") and "@" not in name
    )


def fit_nominal(replays: Replays, first: Noise, rng: np.random.Generator) -> Nominal:
    """Fit the nominal parameters from several starts, with noise as it then appears.

    Whether the starts agree is told; the rest of the certificate takes longer, see `certified`.

    Args:
      replays: simulates.
      first: noise to begin with.
      rng: draws the starts.
    """
    measured = replays.measured
    ground = any(r.support == "ground" for r in measured.recordings)
    space = replays.space
    coordinates = tuple(nominal_coordinate(space, n) for n in free_names(space, ground))
    spreads = [0.0] + [SPREAD] * (STARTS - 1)
    tried = [_start(coordinates, space, spread, rng) for spread in spreads]
    tried = _landed(tried, replays, first)
    fit_together(tried, replays, first)
    tried.sort(key=lambda fit: fit.chi2)
    noise = noise_floor(measured, replays.errors(tried[0].row()))
    fits = [Fit(coordinates, fit.at) for fit in tried[:2]]
    fit_together(fits, replays, noise)
    nearer(fits, replays, noise)
    for fit in fits:
        if ground and not noise_like(fit):
            fit.narrow, fit.done = True, False
    fit_together(fits, replays, noise)
    if ground:
        fits = otherwise_limited(fits, replays, noise)
    for away in NEAR:
        if _agree(*fits):
            break
        fits = _around(min(fits, key=lambda fit: fit.chi2), away, replays, noise, rng)
    for width in WIDER:
        if _agree(*fits):
            break
        for fit in fits:  # kinks stop a fit short; differences of another width lead over them
            fit.done, fit.jacobian, fit.damping, fit.width = False, None, 1e-3, width
        fit_together(fits, replays, noise, iterations=6)
    agreed = _agree(*fits)
    best, second = sorted(fits, key=lambda fit: fit.chi2)
    complete([best], replays, noise)
    starts = (best.chi2, second.chi2)
    return Nominal(best, noise, Certificate(starts, agreed, samples=len(measured.values)))


def certified(nominal: Nominal, replays: Replays, rng: np.random.Generator) -> Nominal:
    """A nominal fit with the whole of its certificate, where its starts agree: else none holds.

    Args:
      nominal: as `fit_nominal` leaves it.
      replays: simulates.
      rng: draws where refits of its own simulation start.
    """
    told, fit = nominal.certificate, nominal.fit
    if not told.agree:
        return nominal
    recovered, left = _refit_of_itself(fit, replays, nominal.noise, rng)
    apart, near = told.starts[1] - told.starts[0], SPARE * told.samples
    if apart < ((OTHER - 1) * fit.chi2 if noise_like(fit) else near):
        left = max(left, min(apart, near))  # a fit to the noise has no more to gain
    return replace(nominal, certificate=replace(told, recovered=recovered, left=left))


def unfitted(replays: Replays, noise: Noise) -> Nominal:
    """The nominal model as the robot describes it, for recordings that nothing can be fitted to."""
    space = replays.space
    ground = any(r.support == "ground" for r in replays.measured.recordings)
    names = free_names(space, ground)
    fit = _start(
        [nominal_coordinate(space, n) for n in names], space, 0.0, np.random.default_rng(0)
    )
    fit_together([fit], replays, noise, iterations=0)
    return Nominal(
        fit, noise, Certificate((fit.chi2,), False, 0.0, 0.0, len(replays.measured.values))
    )


def _landed(fits: Sequence[Fit], replays: Replays, noise: Noise) -> list[Fit]:
    """Fits to begin with on the ground: brought near in the air, then on the floor that suits each.

    Recordings without contact cost a fifth, and gains that are far off would make the robot fall,
    which teaches nothing; so does a floor on which it slips. The best are returned.
    """
    recordings = replays.measured.recordings
    air = [i for i, r in enumerate(recordings) if r.support != "ground"]
    if len(air) == len(recordings):
        begun(fits, replays, noise)
        return list(fits)
    if air:
        part = replays.narrowed(air)
        begun(fits, part, noise)
        moved(fits, part, noise, replays.measured.only(air))
        replays.simulated += part.simulated
    else:
        begun(fits, replays, noise)
    start_best(fits, [floors(fit) for fit in fits], replays, noise)
    return sorted(fits, key=lambda fit: fit.chi2)[:LANDED]


def floors(fit: Fit) -> list[Array]:
    """Where a fit stands, with floors of different friction."""
    if "ground_friction" not in fit.names:
        return [fit.at]
    own = fit.names.index("ground_friction")
    floor = fit.coordinates[own]
    return [_with(fit.at, own, floor.coordinate(friction)) for friction in FLOORS]


def otherwise_limited(fits: Sequence[Fit], replays: Replays, noise: Noise) -> list[Fit]:
    """Fits gone on with from other torque limits, where these follow better.

    An impact may be all that asks for so much torque. Above what it asks for, a limit has no slope,
    and on the way down to what it was the robot falls in many other ways.
    """
    gone_on = [
        replace(fit.fresh(), residual=fit.residual, chi2=fit.chi2, narrow=True) for fit in fits
    ]
    for own, limit in enumerate(fits[0].coordinates):
        if limit.name.startswith("tau_max/"):
            ladder = np.linspace(limit.lower, limit.upper, LIMITS)
            places = [[_with(fit.at, own, at) for at in ladder] for fit in gone_on]
            start_best(gone_on, places, replays, noise)
    chosen = [
        after if after.chi2 < before.chi2 - before.least else before
        for before, after in zip(fits, gone_on, strict=True)
    ]
    fit_together(chosen, replays, noise)
    return chosen


def _with(at: Array, own: int, value: float) -> Array:
    """Coordinates with one of them changed."""
    changed = at.copy()
    changed[own] = value
    return changed


def _agree(first: Fit, second: Fit) -> bool:
    assert first.residual is not None
    least, apart = min(first.chi2, second.chi2), abs(first.chi2 - second.chi2)
    excess = least - len(first.residual)
    if noise_like(min(first, second, key=lambda fit: fit.chi2)):
        return True
    return apart <= max(AGREEMENT * least, EXCESS * excess, ABSOLUTE, SPARE * len(first.residual))


def _start(
    coordinates: Sequence[Coordinate],
    space: ParameterSpace,
    spread: float,
    rng: np.random.Generator,
) -> Fit:
    """A rough fit from somewhere around the nominal values."""
    at = described_at(coordinates, space) + spread * rng.normal(size=len(coordinates))
    return Fit(tuple(coordinates), _within(coordinates, at), slack=ROUGH)


def _around(
    best: Fit, away: float, replays: Replays, noise: Noise, rng: np.random.Generator
) -> list[Fit]:
    """The best two of a fit and of two that start near it.

    Contact has many hollows, and the deepest must draw what is near it.
    """
    places = [best.at + away * rng.normal(size=len(best.at)) for _ in range(2)]
    others = [Fit(best.coordinates, _within(best.coordinates, at), narrow=True) for at in places]
    begun(others[1:], replays, noise)  # how recordings begin may lead to it, or away
    fits = [best, *others]
    fit_together(fits, replays, noise)
    return sorted(fits, key=lambda fit: fit.chi2)[:2]


def _within(coordinates: Sequence[Coordinate], at: Array) -> Array:
    low, high = ([getattr(c, end) for c in coordinates] for end in ("lower", "upper"))
    return np.clip(at, low, high)


def _refit_of_itself(
    fit: Fit, replays: Replays, noise: Noise, rng: np.random.Generator
) -> tuple[float, float]:
    """How far a fit of its own simulation ends from it: standard deviations, and chi-squared."""
    # What the model leaves counts as noise here too: nothing is known better than that.
    misfit = max(1.0, fit.chi2 / len(replays.measured.values))
    deviation = np.sqrt(misfit * np.diag(fit.covariance()))
    simulated = replays([fit.row()])[0]
    ends: list[tuple[float, float]] = []
    for _ in range(SELVES):  # a kink on the way says nothing of where the way leads
        away = np.clip(4 * deviation, 0.01, 0.15) * rng.choice([-1.0, 1.0], len(fit.at))
        start = _within(fit.coordinates, fit.at + away)
        own = Fit(fit.coordinates, start, data=simulated, jacobian=fit.jacobian, age=1, narrow=True)
        if ends:
            begun([own], replays, noise)
        fit_together([own], replays, noise, iterations=8)
        ends.append((float(np.max(np.abs(own.at - fit.at) / deviation)), own.chi2))
        if ends[-1][0] <= SELF or own.chi2 < SPARE * len(simulated):
            break
    return min(ends, key=lambda end: end[1])
