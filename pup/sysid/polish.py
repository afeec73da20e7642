"""The last stretch of a fit: equation 1 by iteratively reweighted least squares.

Equation 1 sums norms of errors. A norm lies below the parabola |e|²/(2 n) + n/2 that touches it at
the current n = |e|, so a least-squares step on errors weighted by 1/sqrt(n) lowers the sum of norms
too. Where recordings determine parameters sharply, these few Jacobians go where CMA-ES would take
hundreds of generations to contract to.
"""

from collections.abc import Callable
from dataclasses import dataclass

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
    error, blocks = errors(start[None])
    landscape = _Landscape(errors, blocks, anchor)
    begin = landscape.point(start, error[0])
    best = landscape.led(begin, SQUARES if anchor is None else ANCHORED, equal=True)
    for _ in range(ROUNDS):
        reached = landscape.led(best, ITERATIONS, equal=False)
        gain = best.objective - reached.objective
        if gain > 0:
            best = reached
        if gain < GAIN * best.objective:
            break
    return best.at if best.objective < begin.objective else start


@dataclass(frozen=True, eq=False)
class _Point:
    """A point that was simulated.

    Attributes:
      at: where it is on the unit cube, shape (n_parameters,).
      error: weighted as equation 1 has it, shape (n_errors,).
      norms: of its blocks, shape (n_blocks,).
      objective: equation 1 and the regulariser.
    """

    at: Array
    error: Array
    norms: Array
    objective: float


@dataclass(frozen=True)
class _Landscape:
    """Equation 1 and the regulariser over the unit cube.

    Attributes:
      errors: evaluates a batch of candidates.
      blocks: where the errors of each norm begin, shape (n_blocks,).
      anchor: where the regulariser pulls to, or None.
    """

    errors: Errors
    blocks: NDArray[np.int64]
    anchor: Array | None

    def point(self, at: Array, error: Array) -> _Point:
        """A point by its errors."""
        norms = np.sqrt(np.add.reduceat(error**2, self.blocks))
        pull = 0.0 if self.anchor is None else W_REG * float(((at - self.anchor) ** 2).sum())
        return _Point(at, error, norms, float(norms.sum()) + pull)

    def led(self, point: _Point, iterations: int, *, equal: bool) -> _Point:
        """Where least squares leads under the weights of a point, or under their mean."""
        typical = point.norms.mean() + 1e-12
        widths = np.diff([*self.blocks, len(point.error)])
        floored = np.maximum(point.norms, FLOOR * typical)
        each = np.full(len(floored), typical) if equal else floored
        weight = np.repeat(each, widths) ** -0.5
        told = point.at, point.error, self.anchor, (2 * W_REG) ** -0.5, iterations, STEP
        return self.point(*least_point(lambda unit: self.errors(unit)[0], weight, *told))
