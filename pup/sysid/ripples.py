"""What recordings with contact tell of parameters: a quadratic surface through many replays.

An impact comes a tick earlier or later, a foot slips or does not: equation 1 has ripples, and a fit
ends in one of them. Slopes taken there are the ripple's, and claim ten times more than the
recordings know. A surface through replays around the fit, so far away that equation 1 rises well
above its ripples, looks over them: its curvature tells how sharp the minimum is, and the scatter of
its slopes from recording to recording where it would be with others (sandwich, by recordings).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Shares = Callable[[Array], Array]
"""Candidates (n, k) on the unit cube to each recording's share, shape (n, n_recordings)."""

ROUNDS = (3, 3, 4, 12)
"""Replays per coefficient of the surface; each round draws where the one before says to."""
FIRST = 4.0
"""Times as far as the local slopes say, in the first round."""
WIDEST = 0.15
"""Standard deviation of the draws, at most, on the unit cube."""
SIGNIFICANT = 3.0
"""Standard errors of a curvature from which it is one."""
BATCH = 256
"""Replays held in memory at once."""


@dataclass(frozen=True, eq=False)
class Surface:
    """What recordings on the ground add to equation 1 around a fit, without its ripples.

    All on the unit cube of k parameters.

    Attributes:
      slopes: of each recording's share, shape (n_recordings, k); their mean is equation 1's.
      slope_error: covariance of a slope by the ripples left in it, shape (k, k).
      curvature: as far as it is significant, shape (k, k).
      at_least: the same with its error where it is not, shape (k, k).
      draws: covariance of where it was looked at, shape (k, k).
    """

    slopes: Array
    slope_error: Array
    curvature: Array
    at_least: Array
    draws: Array


def replays(parameters: int) -> int:
    """How many replays a surface takes."""
    return sum(ROUNDS) * _coefficients(parameters)


def surface(shares: Shares, unit: Array, covariance: Array, hanging: Array, rise: float) -> Surface:
    """Fit the surface around a point.

    Args:
      shares: what each recording on the ground adds to equation 1.
      unit: the point on the unit cube, shape (k,).
      covariance: of the parameters by the local slopes, shape (k, k): where to begin.
      hanging: curvature that the other recordings give equation 1, shape (k, k).
      rise: of equation 1, on average, where it is looked at.
    """
    rng = np.random.default_rng(0)
    width = FIRST**2 * covariance
    for count in ROUNDS:
        fitted = _fitted(shares, unit, _bounded(width), count, rng)
        width = np.asarray(2 * rise / len(unit) * np.linalg.inv(fitted.at_least + hanging))
    return fitted


def _coefficients(parameters: int) -> int:
    return 1 + parameters + parameters * (parameters + 1) // 2


def _bounded(covariance: Array) -> Array:
    """A covariance no wider than WIDEST in any direction."""
    narrow = np.linalg.inv(covariance) + np.eye(len(covariance)) / WIDEST**2
    return np.asarray(np.linalg.inv(narrow))


def _fitted(
    shares: Shares, unit: Array, covariance: Array, per_term: int, rng: np.random.Generator
) -> Surface:
    k = len(unit)
    root = np.linalg.cholesky(covariance)
    count = per_term * _coefficients(k)
    drawn = np.clip(unit + rng.normal(size=(count, k)) @ root.T, 0, 1)
    batches = np.array_split(drawn, -(-count // BATCH))
    told = np.concatenate([shares(batch) for batch in batches])

    z = np.linalg.solve(root, (drawn - unit).T).T
    first, second = np.triu_indices(k)
    squares = z[:, first] * z[:, second] * np.where(first == second, 0.5, 1.0)
    terms = np.column_stack([np.ones(count), z, squares])
    coefficients = np.linalg.lstsq(terms, told, rcond=None)[0]
    left = (told - terms @ coefficients).mean(axis=1)
    ripple = float(left @ left) / (count - terms.shape[1])
    error = ripple * np.linalg.inv(terms.T @ terms)

    hessian = np.zeros((k, k))
    hessian[first, second] = hessian[second, first] = coefficients[1 + k :].mean(axis=1)
    curvature, directions = np.linalg.eigh(hessian)
    least = SIGNIFICANT * np.sqrt(np.diag(error)[1 + k :].mean())
    axes = np.linalg.solve(root.T, directions)  # from draws' standard deviations to the cube
    back = np.linalg.inv(root)
    return Surface(
        slopes=coefficients[1 : 1 + k].T @ back,
        slope_error=back.T @ error[1 : 1 + k, 1 : 1 + k] @ back,
        curvature=(axes * np.where(curvature > least, curvature, 0.0)) @ axes.T,
        at_least=(axes * np.maximum(curvature, least)) @ axes.T,
        draws=covariance,
    )
