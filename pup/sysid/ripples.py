"""What recordings with contact tell of parameters: a quadratic surface through many replays.

An impact comes a tick earlier or later, a foot slips or does not: equation 1 has ripples, and a fit
ends in one of them. Slopes taken there are the ripple's, and claim ten times more than the
recordings know. A surface through replays around the fit, so far away that equation 1 rises well
above its ripples, looks over them: its curvature tells how sharp the minimum is, and the scatter of
its slopes from motion to motion where it would be with others (sandwich, by motions with their
repeats).
"""

from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.float64]
Shares = Callable[[Array], Array]
"""Candidates (n, k) on the unit cube to each motion's share, shape (n, n_motions)."""

ROUNDS = (3, 6)
"""Replays per coefficient of the surface: of a rough one that tells in which directions to look how
far, and of the one that counts; replays of the first count again where the second looks too."""
SCALES = 2.0 ** np.arange(4, -8, -1)
"""Times as far as the local slopes say: one of these is about right, as slopes of ripples claim too
much, and far away a robot falls, upon which all that follows has nothing to do with the fit."""
LOOKS = 24
"""Replays that tell how much equation 1 rises at one of these scales."""
INSIDE = 0.99
"""Share of a normal distribution that counts as where it looks."""
WIDEST = 0.15
"""Standard deviation of the draws, at most, on the unit cube."""
SIGNIFICANT = 3.0
"""Standard errors of a curvature from which it is one."""
BATCH = 256
"""Replays asked for at once; how many are in memory is their maker's to say."""


@dataclass(frozen=True, eq=False)
class Surface:
    """What recordings on the ground add to equation 1 around a fit, without its ripples.

    All on the unit cube of k parameters.

    Attributes:
      slopes: of each motion's share, shape (n_motions, k); their mean is equation 1's.
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
    """How many replays a surface takes, at most."""
    looks = len(SCALES).bit_length()  # of a bisection
    return 1 + LOOKS * looks + sum(ROUNDS) * _coefficients(parameters)


def surface(shares: Shares, unit: Array, covariance: Array, hanging: Array, rise: float) -> Surface:
    """Fit the surface around a point.

    Args:
      shares: what each motion on the ground, with its repeats, adds to equation 1.
      unit: the point on the unit cube, shape (k,).
      covariance: of the parameters by the local slopes, shape (k, k): where to begin.
      hanging: curvature that the other recordings give equation 1, shape (k, k).
      rise: of equation 1, on average, where it is looked at.
    """
    rng = np.random.default_rng(0)
    width = _scaled(shares, unit, covariance, hanging, rise, rng)
    seen: _Seen | None = None
    for count in ROUNDS:
        root = np.linalg.cholesky(width)
        drawn = rng.normal(size=(count * _coefficients(len(unit)), len(unit))) @ root.T
        seen = _look(shares, unit, drawn).beside(seen, width)
        fitted = _fitted(seen, unit, width)
        narrower = np.linalg.inv(fitted.at_least + hanging)
        width = _bounded(np.asarray(2 * rise / len(unit) * narrower))
    return fitted


@dataclass(frozen=True, eq=False)
class _Seen:
    """Replays around a point.

    Attributes:
      off: where they are, from that point, shape (n, k).
      told: each motion's share, shape (n, n_motions).
    """

    off: Array
    told: Array

    def beside(self, before: "_Seen | None", covariance: Array) -> "_Seen":
        """These and those before that lie within where draws of a covariance are."""
        if before is None:
            return self
        away = (before.off * np.linalg.solve(covariance, before.off.T).T).sum(axis=1)
        near = away < stats.chi2.ppf(INSIDE, before.off.shape[1])
        off = np.concatenate([before.off[near], self.off])
        return _Seen(off, np.concatenate([before.told[near], self.told]))


def _look(shares: Shares, unit: Array, off: Array) -> _Seen:
    """Replay around a point, within the cube."""
    places = np.clip(unit + off, 0, 1)
    batches = np.array_split(places, -(-len(places) // BATCH))
    return _Seen(places - unit, np.concatenate([shares(batch) for batch in batches]))


def _scaled(
    shares: Shares,
    unit: Array,
    covariance: Array,
    hanging: Array,
    rise: float,
    rng: np.random.Generator,
) -> Array:
    """The covariance so much wider or narrower that equation 1 rises by as much, on average.

    It rises the more the wider, so that few of the scales are looked at.
    """
    widths = [_bounded(scale**2 * covariance) for scale in SCALES]
    drawn = rng.normal(size=(LOOKS, len(unit)))

    def level(off: Array) -> float:
        seen = _look(shares, unit, off)
        hang = ((seen.off @ hanging) * seen.off).sum(axis=1) / 2
        return float((seen.told.mean(axis=1) + hang).mean())

    highest = level(np.zeros((1, len(unit)))) + rise

    def fits(scale: int) -> bool:
        return level(drawn @ np.linalg.cholesky(widths[scale]).T) <= highest

    return widths[min(bisect_left(range(len(widths)), True, key=fits), len(widths) - 1)]


def _coefficients(parameters: int) -> int:
    return 1 + parameters + parameters * (parameters + 1) // 2


def _bounded(covariance: Array) -> Array:
    """A covariance no wider than WIDEST in any direction."""
    narrow = np.linalg.inv(covariance) + np.eye(len(covariance)) / WIDEST**2
    return np.asarray(np.linalg.inv(narrow))


def _fitted(seen: _Seen, unit: Array, covariance: Array) -> Surface:
    k, count = len(unit), len(seen.off)
    root = np.linalg.cholesky(covariance)
    z = np.linalg.solve(root, seen.off.T).T
    first, second = np.triu_indices(k)
    squares = z[:, first] * z[:, second] * np.where(first == second, 0.5, 1.0)
    terms = np.column_stack([np.ones(count), z, squares])
    coefficients = np.linalg.lstsq(terms, seen.told, rcond=None)[0]
    left = (seen.told - terms @ coefficients).mean(axis=1)
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
