"""Leaving out: what is left out together, and what it costs by a fit to the rest."""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from pup.diagnosis.coordinates import Belief, Coordinate
from pup.diagnosis.fit import Fit
from pup.diagnosis.replays import Replays
from pup.diagnosis.residuals import Measured

Array = NDArray[np.float64]

NOMINAL, TYPICAL = 0.2, 0.5
"""How far a coordinate is believed to move when a fold is left out: a logarithm, a typical size."""


def folds(replays: Replays) -> list[list[int]]:
    """What is left out together: types of motion, or where there is one, motions."""
    types = _told(replays.measured, replays.measured.motions().values())
    return types if len(types) > 1 else apart(replays.measured)


def fold_words(measured: Measured) -> str:
    """What `folds` leaves out at a time, in words."""
    if len(_told(measured, measured.motions().values())) > 1:
        return "type of motion"
    return "motion" if len(_told(measured, measured.families().values())) > 1 else "recording"


def apart(measured: Measured) -> list[list[int]]:
    """Recordings by motion, as one done again tells little new; each alone where all are one."""
    families = _told(measured, measured.families().values())
    alone = ([i] for i in range(len(measured.recordings)))
    return families if len(families) > 1 else _told(measured, alone)


def _told(measured: Measured, sets: Iterable[list[int]]) -> list[list[int]]:
    """Those sets of recordings of which any sample is left."""
    return [members for members in sets if measured.only(members).any()]


def left_out(fit: Fit, inside: NDArray[np.bool_]) -> float:
    """What some samples cost by a fit to the others, in one Gauss-Newton step.

    It is their share of minus twice the logarithm of the evidence: their squared errors, weighed by
    how well the other samples tell where they should lie. What one type of motion alone can tell is
    then not held against a model, but its freedom is.
    """
    assert fit.residual is not None
    jacobian, residual = fit.slopes, fit.residual
    noise = _noise(fit)
    reach = _reach(fit.coordinates)[fit.movable]
    prior, outside = np.diag(1 / reach**2), jacobian[~inside]
    normal = outside.T @ outside / noise + prior
    step = np.linalg.solve(normal, outside.T @ residual[~inside] / noise)
    own, here = jacobian[inside], residual[inside]
    spread = np.linalg.slogdet(np.linalg.solve(normal, own.T @ own / noise) + np.eye(len(reach)))[1]
    return float(max(here @ (here - own @ step), here @ here) + spread)


def without_samples(fit: Fit, inside: NDArray[np.bool_]) -> Fit:
    """A fit to the other samples, which starts from one to all.

    What the others do not tell is believed to be near to what all do, as in `left_out`; noise alone
    would lead it anywhere.
    """
    assert fit.jacobian is not None and fit.residual is not None
    weight = np.where(inside, 0.0, 1.0)
    return Fit(
        fit.coordinates,
        fit.at,
        fixed=fit.fixed,
        weight=weight,
        belief=Belief(fit.at, _noise(fit) / _reach(fit.coordinates) ** 2),
        residual=fit.residual,
        jacobian=fit.jacobian,
        chi2=float((fit.residual * weight) @ fit.residual),
        thorough=False,
        age=1,
    )


def _noise(fit: Fit) -> float:
    """What counts as noise: what a model leaves too, else a wrong form would be sure of itself."""
    assert fit.residual is not None
    return max(1.0, fit.chi2 / len(fit.residual))


def _reach(coordinates: Sequence[Coordinate]) -> Array:
    return np.array([NOMINAL if c.scale is None else TYPICAL for c in coordinates])


def scatter(refits: Array) -> Array:
    """Reach of 90 % intervals by what coordinates become when a fold is left out, shape (n_free,).

    A model's own covariance takes its form for right. Where it is not, motions of another type ask
    for other values, by more than noise (the jackknife of Quenouille and Tukey, by groups).

    Args:
      refits: coordinates of the fits without each fold, shape (n_folds, n_free).
    """
    count = len(refits)
    variance = (count - 1) * refits.var(axis=0)
    return np.asarray(stats.t.ppf(0.95, count - 1) * np.sqrt(variance))
