"""The last stretch of a fit: equation 1 by iteratively reweighted least squares.

Equation 1 sums norms of errors. A norm lies below the parabola |e|²/(2 n) + n/2 that touches it at
the current n = |e|, so a least-squares step on errors weighted by 1/sqrt(n) lowers the sum of norms
too. Where recordings determine parameters sharply, these few Jacobians go where CMA-ES would take
hundreds of generations to contract to.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pup.sysid.fit import W_REG
from pup.sysid.gauss_newton import least_point

Array = NDArray[np.float64]
Errors = Callable[[Array], tuple[Array, NDArray[np.int64]]]
"""Candidates (n, n_parameters) on the unit cube to weighted errors and their blocks' starts."""

STEP = 0.002
"""Finite-difference step on the unit cube: a coarser one misses the turns of sharp valleys."""
SQUARES = 5
"""Iterations of plain least squares: equal weights lead along a valley, unequal ones hold there."""
ANCHORED = 2
"""The same where the start is near the anchor, at which a fit of more recordings ended."""
ROUNDS = 5
"""Times the weights are renewed, at most."""
ITERATIONS = 2
"""Iterations under the same weights."""
GAIN = 1e-3
"""A round that lowers the objective by less than this share is the last."""
FLOOR = 1e-3
"""Norms below this share of their mean are not weighted any higher."""


def polish(errors: Errors, start: Array, anchor: Array | None = None) -> Array:
    """Lower equation 1, and the regulariser where there is one, from a point near its minimum.

    Args:
      errors: evaluates a batch of candidates.
      start: shape (n_parameters,), on the unit cube.
      anchor: where the regulariser pulls to.

    Returns:
      A point on the unit cube whose objective is not higher than the start's.
    """
    squares = SQUARES if anchor is None else ANCHORED
    at = _squares(errors, start, anchor, squares, equal=True)
    objective = _objective(errors, at, anchor)
    for _ in range(ROUNDS):
        reached = _squares(errors, at, anchor, ITERATIONS, equal=False)
        lower = _objective(errors, reached, anchor)
        gain = objective - lower
        if gain > 0:
            at, objective = reached, lower
        if gain < GAIN * objective:
            break
    return at if objective < _objective(errors, start, anchor) else start


def _squares(
    errors: Errors, at: Array, anchor: Array | None, iterations: int, *, equal: bool
) -> Array:
    """Where least squares leads under the weights of a point, or under their mean."""
    error, blocks = errors(at[None])
    norms = _norms(error, blocks)[0]
    widths = np.diff([*blocks, error.shape[1]])
    typical = norms.mean() + 1e-12
    each = np.full(len(norms), typical) if equal else np.maximum(norms, FLOOR * typical)
    weight = np.repeat(each, widths) ** -0.5

    def weighted(unit: Array) -> Array:
        return np.asarray(errors(unit)[0] * weight)

    return least_point(weighted, at, anchor, (2 * W_REG) ** -0.5, iterations, STEP)


def _norms(error: Array, blocks: NDArray[np.int64]) -> Array:
    return np.asarray(np.sqrt(np.add.reduceat(error**2, blocks, axis=1)))


def _objective(errors: Errors, at: Array, anchor: Array | None) -> float:
    loss = float(_norms(*errors(at[None])).sum())
    return loss if anchor is None else loss + W_REG * float(((at - anchor) ** 2).sum())
