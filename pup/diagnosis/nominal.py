"""The nominal model's fit, and whether it may be trusted.

An optimiser that stops short looks exactly like missing physics. So the fit is made from several
starts, which must agree, and of a simulation of itself, whose parameters it must find again.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.fitting import Coordinate, Fit, differentiate, fit_together, nominal_coordinate
from pup.diagnosis.replays import Replays
from pup.diagnosis.residuals import Noise, noise_floor
from pup.physics.parameters import ParameterSpace

Array = NDArray[np.float64]

STARTS = 3
SPREAD = 0.35
"""Of the starts around the nominal values, in logarithms."""
AGREEMENT = 3e-3
"""Two starts agree in chi-squared to this share of it, to ABSOLUTE, or to EXCESS of what is more
than noise: where much is missing, a fit has many ends that lack it all the same."""
EXCESS = 0.03
ABSOLUTE = 5.0
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
      recovered: largest error of a refit of its own simulation, in standard deviations.
    """

    starts: tuple[float, ...]
    agree: bool
    recovered: float

    @property
    def holds(self) -> bool:
        """Whether a verdict may be given."""
        return self.agree and self.recovered <= SELF


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
    """What the nominal fit may move (CONTRACTS.md, section 2)."""
    return tuple(
        name
        for name in space.names
        if name.split("/")[0] in FREE and (ground or name != "ground_friction") and "@" not in name
    )


def fit_nominal(replays: Replays, first: Noise, rng: np.random.Generator) -> Nominal:
    """Fit the nominal parameters from several starts, with noise as it then appears.

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
    fit_together(tried, replays, first)
    tried.sort(key=lambda fit: fit.chi2)
    noise = noise_floor(measured, measured.values - replays([tried[0].row()])[0])
    fits = [Fit(coordinates, fit.at) for fit in tried[:2]]
    fit_together(fits, replays, noise)
    for width in WIDER:
        if _agree(*fits):
            break
        for fit in fits:  # kinks stop a fit short; differences of another width lead over them
            fit.done, fit.jacobian, fit.damping, fit.width = False, None, 1e-3, width
        fit_together(fits, replays, noise, iterations=6)
    agreed = _agree(*fits)
    best, second = sorted(fits, key=lambda fit: fit.chi2)
    if best.jacobian is None:
        differentiate([best], replays, noise)
    own = _refit_of_itself(best, replays, noise, rng)
    return Nominal(best, noise, Certificate((best.chi2, second.chi2), agreed, own))


def _agree(first: Fit, second: Fit) -> bool:
    assert first.residual is not None
    least, apart = min(first.chi2, second.chi2), abs(first.chi2 - second.chi2)
    excess = least - len(first.residual)
    return apart <= max(AGREEMENT * least, EXCESS * excess, ABSOLUTE)


def _start(
    coordinates: Sequence[Coordinate],
    space: ParameterSpace,
    spread: float,
    rng: np.random.Generator,
) -> Fit:
    """A rough fit from somewhere around the nominal values."""
    at = [
        c.coordinate(space.nominal[space.names.index(c.name)]) + spread * rng.normal()
        for c in coordinates
    ]
    low, high = ([getattr(c, end) for c in coordinates] for end in ("lower", "upper"))
    return Fit(tuple(coordinates), np.clip(at, low, high), slack=ROUGH)


def _refit_of_itself(fit: Fit, replays: Replays, noise: Noise, rng: np.random.Generator) -> float:
    """How far a fit of its own simulation ends from it, in standard deviations."""
    # What the model leaves counts as noise here too: nothing is known better than that.
    misfit = max(1.0, fit.chi2 / len(replays.measured.values))
    deviation = np.sqrt(misfit * np.diag(fit.covariance()))
    low, high = ([getattr(c, end) for c in fit.coordinates] for end in ("lower", "upper"))
    simulated, off = replays([fit.row()])[0], np.inf
    for _ in range(SELVES):  # a kink on the way says nothing of where the way leads
        away = np.clip(4 * deviation, 0.01, 0.15) * rng.choice([-1.0, 1.0], len(fit.at))
        start = np.clip(fit.at + away, low, high)
        own = Fit(fit.coordinates, start, data=simulated, jacobian=fit.jacobian, age=1)
        fit_together([own], replays, noise, iterations=8)
        off = min(off, float(np.max(np.abs(own.at - fit.at) / deviation)))
        if off <= SELF:
            break
    return off
