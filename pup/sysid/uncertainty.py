"""What the recordings say about each parameter around a fitted point."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pup.sysid.gauss_newton import Confidence, LeastSquares, confidence, least_squares
from pup.sysid.polish import STEP
from pup.sysid.problem import Problem

Array = NDArray[np.float64]

UNIFORM = 12.0
"""Information of a uniform prior on the unit cube: one over its variance."""
ROUNDING = 1e-6
"""Relative change of the loss that is rounding: a fixed torso's mass reaches solver tolerances."""
UNSEEN = 0.9
"""Share of the prior's spread left, above which the interval is the whole search range."""


def observable(problem: Problem, unit: Array) -> tuple[str, ...]:
    """The free parameters whose change changes the loss at all.

    A suspended robot has no ground friction: such a parameter would drift freely in a fit and
    come out as a precise number that means nothing.

    Args:
      problem: what is fitted.
      unit: a point on the unit cube, shape (n_free,).
    """
    probes = np.tile(unit, (2, len(unit), 1))
    for side, end in enumerate(
        (0.0, 1.0)
    ):  # a limit that does not bite at one end may at the other
        np.fill_diagonal(probes[side], end)
    losses = problem.losses(np.vstack([unit, *probes]))
    moved = np.abs(losses[1:] - losses[0]).reshape(2, -1).max(axis=0) > ROUNDING * losses[0]
    return tuple(n for n, seen in zip(problem.free, moved, strict=True) if seen)


def confidence_at(problem: Problem, unit: Array) -> Confidence:
    """90 % intervals and correlations at a fitted point, by the curvature of the squared error.

    Joints and torso count with their own root mean square errors. Residuals of a replay are far
    from independent, so the information is deflated by the (1 + r)/(1 - r) of their lag-one
    autocorrelation r. The values of parameters that are not free are taken as known. Parameters
    that the recordings cannot see get their whole search range.

    Args:
      problem: what was fitted.
      unit: the fitted point on the unit cube, shape (n_free,).
    """
    parts = [part[0] for part in problem.loss.errors(problem.replay(unit[None])) if np.any(part)]
    spreads = [np.sqrt(np.mean(part[part != 0] ** 2)) for part in parts]
    counted = np.concatenate([part.ravel() != 0 for part in parts])

    def residuals(candidates: Array) -> Array:
        both = problem.loss.errors(problem.replay(candidates))[: len(parts)]
        scaled = [e.reshape(len(candidates), -1) / s for e, s in zip(both, spreads, strict=True)]
        return np.concatenate(scaled, axis=1)[:, counted]

    with threadpool_limits(limits=1):  # the sums of BLAS depend on its threads
        fit = least_squares(residuals, unit, iterations=0, step=STEP)
    r = _lag_one(parts[0], problem)
    prior = UNIFORM * np.eye(len(unit))
    information = (np.linalg.inv(fit.covariance) - prior) * (1 - r) / (1 + r)
    covariance = np.asarray(np.linalg.inv(information + prior), dtype=np.float64)
    space = problem.free_space
    told = confidence(
        space, LeastSquares(fit.best, fit.cost, fit.converged, fit.replays, covariance, fit.noise)
    )
    unseen = np.sqrt(UNIFORM * np.diag(covariance)) > UNSEEN
    return replace(
        told,
        lower=np.where(unseen, space.lower, told.lower),
        upper=np.where(unseen, space.upper, told.upper),
    )


def _lag_one(error: Array, problem: Problem) -> float:
    """Lag-one autocorrelation of the joints' errors within recordings, at most 1 - 2/n_ticks."""
    products, squares = 0.0, 0.0
    for part in problem.loss.ticks:
        now, before = error[part][1:], error[part][:-1]
        both = (now != 0) & (before != 0)  # an error of exactly zero was not measured
        products += float((now * before)[both].sum())
        squares += float(((now**2 + before**2) / 2)[both].sum())
    longest = max(part.stop - part.start for part in problem.loss.ticks)
    return float(np.clip(products / max(squares, 1e-300), 0.0, max(0.0, 1 - 2 / longest)))
