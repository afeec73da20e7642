"""Levenberg-Marquardt on batched finite differences, with bounds, priors and confidence.

One iteration is two batches: the Jacobian's columns are candidates of one replay, and so are the
trial steps, tried at many dampings at once. That is what makes it the quick fitter: the number of
batches does not grow with the number of parameters.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from pup.physics.parameters import ParameterSpace

Array = NDArray[np.float64]
Residuals = Callable[[Array], Array]
"""Candidates (n, n_parameters) on the unit cube to residuals (n, n_residuals)."""

STEPS = (1e-4, 1e-3, 1e-2)
"""Finite-difference steps on the unit cube, the next one when the one before leads no further.

A torque that clips and a foot that lands kink what a replay returns: a narrow difference sees one
side of a kink, a wide one the slope across many.
"""
CURVATURE_STEP = 1e-3
"""The same for the covariance: a wider one takes kinks for information."""
TOLERANCE = 1e-4
"""Relative improvement of the cost below which it stops."""
FIRST_DAMPING = 1e-2
DAMPINGS = 10.0 ** np.arange(-3.0, 2.0)
"""Damping factors tried at once, relative to the current one."""
UPDATES = 2
"""Steps that are taken on a Jacobian that is updated instead of made anew (Broyden), at most."""
HEAVIER = 1e5
"""Relative damping of a second try, where none of the first improves."""
WEAKEST = 1e-6
"""Of the stiffest direction: what is weaker is not followed as far as its slope says."""
IDENTIFIED_SHARE = 0.5
"""A parameter is identified when its 90 % interval covers at most this share of its range."""


@dataclass(frozen=True)
class LeastSquares:
    """Outcome of a least-squares fit.

    Attributes:
      best: on the unit cube, shape (n_parameters,).
      cost: half the sum of squared residuals there, the prior's included.
      converged: whether it stopped because no step improves any more.
      replays: candidates simulated.
      covariance: of the parameters on the unit cube, shape (n_parameters, n_parameters), with a
        unit-cube-wide uniform prior, so that what the data do not see stays finite.
      noise: residual standard deviation, in the residuals' unit.
    """

    best: Array
    cost: float
    converged: bool
    replays: int
    covariance: Array
    noise: float


@dataclass(frozen=True)
class Confidence:
    """Intervals and correlations of a fit's parameters, in the units of their space.

    Attributes:
      lower: lower ends of the intervals, clipped to the search range.
      upper: upper ends.
      correlation: shape (n_parameters, n_parameters).
      identified: whether the data narrow each parameter to less than IDENTIFIED_SHARE of its range.
    """

    lower: Array
    upper: Array
    correlation: Array
    identified: NDArray[np.bool_]


def least_squares(
    residuals: Residuals,
    start: Array,
    *,
    iterations: int = 30,
    prior_mean: Array | None = None,
    prior_sd: Array | None = None,
    tolerance: float = TOLERANCE,
    step: float | None = None,
) -> LeastSquares:
    """Minimise the sum of squared residuals over the unit cube.

    Args:
      residuals: weighted residuals of a batch of candidates; must not be NaN.
      start: shape (n_parameters,), on the unit cube.
      iterations: at most this many Jacobians.
      prior_mean: centre of a Gaussian prior on the unit cube, shape (n_parameters,).
      prior_sd: its standard deviations in units of the cube, for residuals of unit variance;
        infinite where there is none.
      tolerance: relative improvement of the cost below which it stops.
      step: of the finite differences on the unit cube; without one, those of STEPS in turn.
    """
    total = _Sum(residuals, 1.0, start, prior_mean, prior_sd)
    steps = STEPS if step is None else (step,)
    begin = np.clip(start, 0.0, 1.0)
    reached = _descend(total, begin, residuals(begin[None])[0], iterations, tolerance, steps)
    at, value = reached.at, reached.value
    jacobian = differences(residuals, at, value, CURVATURE_STEP if step is None else step)
    freedom = max(1, len(value) - len(at))
    noise = float(np.sqrt(value @ value / freedom))
    covariance = _covariance(jacobian, noise, total)
    replays = 1 + reached.replays + len(at)
    return LeastSquares(at, reached.cost, reached.converged, replays, covariance, noise)


def least_point(
    residuals: Residuals,
    weight: Array,
    start: Array,
    value: Array,
    anchor: Array | None,
    sd: float,
    iterations: int,
    step: float,
) -> tuple[Array, Array]:
    """Where the sum of squared residuals is least, without what `least_squares` tells besides.

    Args:
      residuals: of a batch of candidates, without their weights; must not be NaN.
      weight: of each residual, shape (n_residuals,).
      start: shape (n_parameters,), within the unit cube.
      value: the residuals there, shape (n_residuals,).
      anchor: centre of the prior, or None for no prior.
      sd: its standard deviation, the same for all parameters.
      iterations: at most this many Jacobians.
      step: of the finite differences on the unit cube.

    Returns:
      The point and its residuals, without their weights.
    """
    total = _Sum(
        residuals, weight, start, anchor, None if anchor is None else np.full(len(start), sd)
    )
    reached = _descend(total, start, value, iterations, TOLERANCE, (step,), UPDATES)
    return reached.at, reached.value


@dataclass(frozen=True)
class _Reached:
    """Where a descent has led."""

    at: Array
    value: Array
    cost: float
    converged: bool
    replays: int


def _descend(
    total: "_Sum",
    at: Array,
    value: Array,
    iterations: int,
    tolerance: float,
    steps: Sequence[float],
    updates: int = 0,
) -> _Reached:
    """Levenberg-Marquardt from a point within the cube and its residuals."""
    cost = total.cost(value, at)
    replays, width, damping = 0, 0, FIRST_DAMPING
    for _ in range(iterations):
        jacobian = total.jacobian(at, value, steps[width])
        replays += len(at)
        enough = cost - tolerance * cost
        for factors in (DAMPINGS, HEAVIER * DAMPINGS):
            trials = _trial_steps(jacobian, value, at, damping * factors, total)
            values, costs = total.tried(trials)
            replays += len(trials)
            pick = int(np.argmin(costs))
            if costs[pick] < enough:
                break
        else:
            parts = _component_steps(jacobian, value, at, total)
            trials, values, costs = _best_parts(parts, at, cost, total)
            replays += len(trials)
            pick, factors = int(np.argmin(costs)), np.ones(len(trials))
        improved = costs[pick] < enough
        for _ in range(updates):
            if not costs[pick] < enough:
                break
            change = total.weighted(values[pick]) - total.weighted(value)
            jacobian = updated(jacobian, trials[pick] - at, change)
            at, value, cost = trials[pick], values[pick], costs[pick]
            damping = float(np.clip(damping * factors[pick], 1e-4, 1e6))
            enough, factors = cost - tolerance * cost, DAMPINGS
            trials = _trial_steps(jacobian, value, at, damping * factors, total)
            values, costs = total.tried(trials)
            replays += len(trials)
            pick = int(np.argmin(costs))
        if costs[pick] < cost:
            at, value, cost = trials[pick], values[pick], costs[pick]
        if improved:
            damping = float(np.clip(damping * factors[pick], 1e-4, 1e6))
        elif width + 1 < len(steps):
            width, damping = width + 1, FIRST_DAMPING
        else:
            return _Reached(at, value, cost, True, replays)
    return _Reached(at, value, cost, False, replays)


def confidence(
    space: ParameterSpace,
    best: Array,
    covariance: Array,
    freedom: Array | float = np.inf,
    level: float = 0.9,
) -> Confidence:
    """Intervals and correlations of a fit, assuming the model right.

    Args:
      space: the parameters.
      best: where the fit ended on the unit cube, shape (n_parameters,).
      covariance: there, shape (n_parameters, n_parameters).
      freedom: degrees of freedom that each variance was estimated with, shape (n_parameters,).
      level: how often an interval is to hold the truth.
    """
    sd = np.sqrt(np.diag(covariance))
    reach = stats.t.ppf((1 + level) / 2, freedom) * sd
    correlation = covariance / np.maximum(np.outer(sd, sd), 1e-300)
    return Confidence(
        space.denormalise(np.clip(best - reach, 0, 1)),
        space.denormalise(np.clip(best + reach, 0, 1)),
        correlation,
        2 * reach <= IDENTIFIED_SHARE,
    )


class _Sum:
    """What is minimised: squares of weighted residuals, and of a Gaussian prior as extra ones.

    Residuals go in and out without their weights, so that those of a point that was reached serve
    under other weights too.
    """

    def __init__(
        self,
        residuals: Residuals,
        weight: Array | float,
        start: Array,
        mean: Array | None,
        sd: Array | None,
    ) -> None:
        self.residuals, self.weight = residuals, weight
        self.mean = start if mean is None else mean
        self.pull = np.zeros(len(start)) if sd is None else 1.0 / sd

    def weighted(self, values: Array) -> Array:
        """Residuals times their weights."""
        return values * self.weight

    def cost(self, value: Array, at: Array) -> float:
        """Half the sum at a point with these residuals."""
        weighted, pull = self.weighted(value), self.pull * (at - self.mean)
        return float(weighted @ weighted + pull @ pull) / 2

    def tried(self, points: Array) -> tuple[Array, list[float]]:
        """Residuals and costs of points."""
        values = self.residuals(points)
        return values, [self.cost(v, p) for v, p in zip(values, points, strict=True)]

    def jacobian(self, at: Array, value: Array, width: float) -> Array:
        """Of the weighted residuals, see `differences`."""
        return differences(
            lambda unit: self.weighted(self.residuals(unit)), at, self.weighted(value), width
        )


def differences(residuals: Residuals, at: Array, value: Array, width: float) -> Array:
    """Jacobian by one-sided differences into the cube, one batch.

    Args:
      residuals: of a batch of candidates.
      at: shape (n_parameters,), on the unit cube.
      value: the residuals there, shape (n_residuals,).
      width: of the differences.

    Returns:
      Shape (n_residuals, n_parameters).
    """
    step = np.where(at + width <= 1.0, width, -width)
    moved = at + np.diag(step)
    return np.asarray(((residuals(moved) - value) / step[:, None]).T)


def step_within(system: Array, gradient: Array, at: Array) -> Array:
    """Where a Newton step leads; what hits a wall stays there and the rest is solved again.

    Args:
      system: curvature, shape (n_parameters, n_parameters).
      gradient: shape (n_parameters,).
      at: where it is taken, within the unit cube.
    """
    free = ~(((at <= 0) & (gradient > 0)) | ((at >= 1) & (gradient < 0)))
    goal = at.copy()
    while free.any():
        pull = gradient[free] + system[np.ix_(free, ~free)] @ (goal - at)[~free]
        goal[free] = at[free] - np.linalg.solve(system[np.ix_(free, free)], pull)
        beyond = (goal < 0) | (goal > 1)
        if not beyond.any():
            break
        goal = np.clip(goal, 0.0, 1.0)
        free &= ~beyond
    return goal


def updated(jacobian: Array, step: Array, change: Array) -> Array:
    """A Jacobian after a step, by Broyden: right along it, as before across it.

    Args:
      jacobian: shape (n_residuals, n_parameters).
      step: not zero, shape (n_parameters,).
      change: of what it is of, shape (n_residuals,).
    """
    return np.asarray(jacobian + np.outer(change - jacobian @ step, step) / (step @ step))


def _trial_steps(jacobian: Array, value: Array, at: Array, dampings: Array, total: _Sum) -> Array:
    """Points of damped Gauss-Newton steps within the cube, shape (n_dampings, n_parameters)."""
    normal, gradient, scale = _normal_equations(jacobian, value, at, total)
    systems = normal + dampings[:, None, None] * np.diag(scale)
    return np.array([step_within(system, gradient, at) for system in systems])


def _normal_equations(
    jacobian: Array, value: Array, at: Array, total: _Sum
) -> tuple[Array, Array, Array]:
    """Normal matrix, gradient, and the matrix's diagonal with a floor."""
    normal = jacobian.T @ jacobian + np.diag(total.pull**2)
    gradient = jacobian.T @ total.weighted(value) + total.pull**2 * (at - total.mean)
    scale = np.diag(normal)
    return normal, gradient, np.maximum(scale, 1e-6 * scale.max() or 1.0)


def _component_steps(jacobian: Array, value: Array, at: Array, total: _Sum) -> Array:
    """The components of a Gauss-Newton step by the normal matrix's eigenvectors, a row each."""
    normal, gradient, scale = _normal_equations(jacobian, value, at, total)
    root = np.sqrt(scale)
    stiffness, directions = np.linalg.eigh(normal / np.outer(root, root))
    along = (
        directions.T @ (gradient / root) / np.maximum(stiffness, WEAKEST * stiffness.max() or 1.0)
    )
    return np.asarray(-(directions * along).T / root)


def _best_parts(
    parts: Array, at: Array, cost: float, total: _Sum
) -> tuple[Array, Array, list[float]]:
    """Points, residuals and costs of each part of a step alone and of all that help together.

    A kink that one parameter meets holds a whole step back; the others go on without it.
    """
    points = np.clip(at + parts, 0.0, 1.0)
    values, costs = total.tried(points)
    helping = np.array(costs) < cost
    if helping.sum() < 2:
        return points, values, costs
    together = np.clip(at + parts[helping].sum(axis=0), 0.0, 1.0)[None]
    value, least = total.tried(together)
    return np.vstack([points, together]), np.vstack([values, value]), costs + least


def _covariance(jacobian: Array, noise: float, total: _Sum) -> Array:
    """Inverse of the information, with the variance of a uniform unit prior (12) as a floor."""
    information = jacobian.T @ jacobian / max(noise, 1e-12) ** 2
    information += np.diag(total.pull**2 + 12.0)
    return np.asarray(np.linalg.inv(information))
