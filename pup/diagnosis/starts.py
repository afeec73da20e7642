"""Where fits of finalists start: from a model, a score, a rival, or all samples."""

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.evidence import Score
from pup.diagnosis.fitting import Fit
from pup.diagnosis.hypotheses import Hypothesis

Array = NDArray[np.float64]

ROUGHLY = 1e-3
"""Relative gain of chi-squared at which a finalist's fit may end."""
SHARES = (1.0, 0.4)
"""Shares of its linear size at which a finalist may start."""
DAMPED, FURTHEST = 0.01, 0.5
"""Damping and reach of the step that the other coordinates may take with it."""


def options(before: Fit, score: Score, fit: Fit) -> list[Array]:
    """Where a finalist may start: all or some of what slopes promise, with or without the others.

    Many an effect acts from some size on, and then more than its slope says.
    """
    assert before.jacobian is not None and before.residual is not None
    n, trace = len(before.at), score.trace.whole
    sizes = fit.at[n : n + trace.shape[1]]
    normal = before.jacobian.T @ before.jacobian
    normal[np.diag_indices(n)] += 1 + DAMPED * np.diag(normal)
    low, high = ([getattr(c, end) for c in before.coordinates] for end in ("lower", "upper"))
    places = []
    for share in SHARES:
        at = fit.at.copy()
        at[n : n + len(sizes)] = share * sizes
        left = before.jacobian.T @ (before.residual - trace @ (share * sizes))
        step = np.clip(np.linalg.solve(normal, left), -FURTHEST, FURTHEST)
        places += [at, np.r_[np.clip(before.at + step, low, high), at[n:]]]
    return places


def joined(fit: Fit, rival: Fit, own: Hypothesis) -> Fit:
    """A fit with an effect of another one, as that found it."""
    names = {*own.magnitudes, *(name for name, _ in own.shape)}
    kept = [i for i, c in enumerate(rival.coordinates) if c.name in names]
    return Fit(
        fit.coordinates + tuple(rival.coordinates[i] for i in kept),
        np.r_[fit.at, rival.at[kept]],
        fixed={**fit.fixed, **{n: v for n, v in rival.fixed.items() if n in names}},
        thorough=False,
        slack=ROUGHLY,
    )


def without_samples(fit: Fit, inside: NDArray[np.bool_]) -> Fit:
    """A fit to the other samples, which starts from one to all."""
    assert fit.jacobian is not None and fit.residual is not None
    weight = np.where(inside, 0.0, 1.0)
    return Fit(
        fit.coordinates,
        fit.at,
        fixed=fit.fixed,
        weight=weight,
        residual=fit.residual,
        jacobian=fit.jacobian,
        chi2=float((fit.residual * weight) @ fit.residual),
        thorough=False,
        age=1,
        slack=ROUGHLY,
    )
