"""The score test: which effect, at which place, the nominal fit's errors look like.

What the nominal parameters can imitate of a hypothesis's trace is projected out of it; what is left
is matched with the errors (a Lagrange-multiplier test). Matched filters find traces far below the
noise. How large the largest of so many scores becomes by chance follows from the traces alone.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from pup.diagnosis.fit import Fit
from pup.diagnosis.hypotheses import Hypothesis

Array = NDArray[np.float64]

SEEN = 1e-3
"""A trace of which less than this share is left after projection cannot be told at all."""
FAINT = 0.3
"""A trace whose whitened length at typical size is below this is not worth a test."""
FARTHEST = 1e-130
"""Chances below this are too small for the tables of their distributions."""


@dataclass(frozen=True, eq=False)
class Trace:
    """What a hypothesis leaves in the samples.

    Attributes:
      hypothesis: of one effect, place and shape.
      whole: whitened change of the samples per typical size, shape (n_samples, n_magnitudes).
      left: what of it the nominal parameters cannot imitate.
      directions: orthonormal columns that span `left`, shape (n_samples, n_seen); None where `left`
        is one column, for a whole robot has thousands of these.
    """

    hypothesis: Hypothesis
    whole: Array
    left: Array
    directions: Array | None = None

    @property
    def basis(self) -> Array:
        """Orthonormal columns that span `left`, shape (n_samples, n_seen)."""
        return _unit(self.left) if self.directions is None else self.directions

    @property
    def seen(self) -> int:
        """How many magnitudes the data show."""
        return 1 if self.directions is None else self.directions.shape[1]

    @property
    def absorbed(self) -> float:
        """Share of the trace that nominal parameters imitate."""
        whole = float(np.linalg.norm(self.whole))
        return 1 - float(np.linalg.norm(self.left)) / whole if whole > 0 else 1.0


@dataclass(frozen=True, eq=False)
class Score:
    """How well a trace matches the errors.

    Attributes:
      trace: the trace.
      statistic: drop of chi-squared it promises.
      freedom: magnitudes that are seen.
      sizes: magnitudes it asks for, in typical sizes.
    """

    trace: Trace
    statistic: float
    freedom: int
    sizes: Array

    @property
    def surprise(self) -> float:
        """The statistic as that of a single magnitude of the same improbability."""
        if self.freedom == 1:
            return self.statistic
        chance = float(special.chdtrc(self.freedom, self.statistic))
        if chance < FARTHEST:  # what the extra magnitudes cost there
            return float(self.statistic - (self.freedom - 1) * np.log(self.statistic))
        return float(special.chdtri(1, chance))


class Projector:
    """Takes out of traces what free parameters can imitate.

    Args:
      jacobian: whitened sensitivities, shape (n_samples, n_free).
    """

    def __init__(self, jacobian: Array) -> None:
        lengths = np.linalg.norm(jacobian, axis=0)
        scaled = jacobian / np.maximum(lengths, 1e-12)
        left, spread, _ = np.linalg.svd(scaled, full_matrices=False)
        self.basis = left[:, spread > 1e-4 * spread.max(initial=0.0)]

    def __call__(self, columns: Array) -> Array:
        """What is left of columns (n_samples, n)."""
        return np.asarray(columns - self.basis @ (self.basis.T @ columns))


def traced(hypothesis: Hypothesis, whole: Array, project: Projector) -> Trace | None:
    """The trace of a hypothesis, whitened; None where the data cannot show it."""
    return _seen(hypothesis, whole, project) if np.isfinite(whole).all() else None


def _seen(hypothesis: Hypothesis, whole: Array, project: Projector) -> Trace | None:
    left, least = project(whole), SEEN * np.linalg.norm(whole)
    if left.shape[1] == 1:  # as nearly all of them are: no decomposition
        length = float(np.linalg.norm(left))
        return Trace(hypothesis, whole, left) if length > FAINT and length > least else None
    vectors, lengths, _ = np.linalg.svd(left, full_matrices=False)
    seen = (lengths > FAINT) & (lengths > least)
    return Trace(hypothesis, whole, left, vectors[:, seen]) if seen.any() else None


def _unit(column: Array) -> Array:
    return np.asarray(column / max(float(np.linalg.norm(column)), np.finfo(float).tiny))


def scores(found: Sequence[Trace], residual: Array) -> list[Score]:
    """Match traces with errors, best first.

    Args:
      found: the traces.
      residual: whitened, measured minus simulated, shape (n_samples,).
    """
    told = []
    for trace in found:
        match = trace.basis.T @ residual
        statistic, sizes = float(match @ match), _sizes(trace, residual)
        if not trace.hypothesis.signed and sizes[0] < 0:
            statistic = 0.0
        told.append(Score(trace, statistic, trace.seen, sizes))
    return sorted(told, key=lambda s: -s.surprise)


def foremost(ranking: Sequence[Score], most: int, refitted: Collection[Hypothesis]) -> list[Score]:
    """The first scores of a ranking, and those of what was refitted."""
    return [
        score
        for rank, score in enumerate(ranking)
        if rank < most or score.trace.hypothesis in refitted
    ]


def _sizes(trace: Trace, residual: Array) -> Array:
    if trace.left.shape[1] == 1:
        return np.asarray(trace.left.T @ residual / np.sum(trace.left**2))
    return np.asarray(np.linalg.lstsq(trace.left, residual, rcond=1e-3)[0])


def threshold(
    found: Sequence[Trace], rng: np.random.Generator, false_alarms: float, draws: int = 4000
) -> float:
    """Surprise that the largest score exceeds by chance with a given probability.

    Pure noise is drawn as its products with the traces, whose covariance is that of the traces.

    Args:
      found: all traces.
      rng: draws the noise.
      false_alarms: probability that any of them exceeds it.
      draws: how many times.
    """
    basis = np.hstack([t.basis for t in found])
    gram = basis.T @ basis
    values, vectors = np.linalg.eigh(gram)
    root = vectors * np.sqrt(np.maximum(values, 0))
    products = root @ rng.normal(size=(len(root), draws))
    largest: dict[int, Array] = {}  # by freedom: of the same, the largest is the most surprising
    start = 0
    for trace in found:
        width = trace.seen
        part = products[start : start + width]
        start += width
        statistic = (part**2).sum(axis=0)
        if not trace.hypothesis.signed:
            statistic = np.where(part[0] < 0, 0.0, statistic)
        largest[width] = np.maximum(largest.get(width, 0.0), statistic)
    surprise = np.max([_as_of_one(told, width) for width, told in largest.items()], axis=0)
    # The tail of a largest of many is exponential: its far end from its near one.
    near = float(np.quantile(surprise, 0.9))
    excess = float(np.mean(surprise[surprise > near] - near))
    return near + excess * float(np.log(0.1 / false_alarms))


def _as_of_one(statistic: Array, freedom: int) -> Array:
    """Statistics as those of a single magnitude that are as improbable."""
    if freedom == 1:
        return statistic
    return np.asarray(special.chdtri(1, special.chdtrc(freedom, statistic)))


def overlap(a: Trace, b: Trace) -> float:
    """Share of one trace's direction that another can imitate, 0 to 1, at their typical sizes."""
    return float(np.linalg.norm(a.basis.T @ b.basis, 2)) if a.basis.size and b.basis.size else 0.0


def unimitated(fit: Fit) -> Array:
    """What a fit leaves that none of its own coordinates can imitate, shape (n_samples,)."""
    assert fit.residual is not None
    return Projector(fit.slopes)(fit.residual[:, None])[:, 0]
