"""Rivals that refit the simulation with effects of the library, and choose by BIC.

The Bayesian information criterion is chi-squared plus the logarithm of the number of samples for
each number that a model has beyond the nominal one, shapes of a grid included.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.rivals.case import Case, Named, Verdict
from pup.diagnosis.coordinates import term_coordinate
from pup.diagnosis.fit import Fit
from pup.diagnosis.fitting import fit_together, start_best
from pup.diagnosis.hypotheses import Hypothesis, hypotheses
from pup.diagnosis.starts import ROUGHLY
from pup.diagnosis.verdict import WORTH_SAYING
from pup.physics.terms import Place

Array = NDArray[np.float64]

STRONG = 10.0
"""Difference of BIC that counts as very strong evidence (Kass and Raftery 1995)."""
SIZES = (0.1, 0.5, 1.0)
"""Typical sizes that a refit may start at."""
ITERATIONS = 8
TOGETHER = 16
"""Refits in step: more would only take more memory."""
LADDER = (
    ("coulomb_friction", None),
    ("stribeck_friction", None),
    ("load_dependent_friction", "stribeck_friction"),
    ("quadratic_damping", "load_dependent_friction"),
)
"""Effects, each with the one it stands on; the library's Stribeck friction has Coulomb's in it."""


@dataclass(frozen=True, eq=False)
class Refit:
    """A model with one effect more than another, refitted.

    Attributes:
      hypothesis: the effect.
      fit: of the model.
      bic: of the model.
    """

    hypothesis: Hypothesis
    fit: Fit
    bic: float


def exhaustive(case: Case) -> Verdict:
    """Refit every effect of the library at every place and in every shape, one at a time."""
    return chosen(case, refitted(case, case.nominal.fit, hypotheses(case.measured)))


def chosen(case: Case, refits: Sequence[Refit]) -> Verdict:
    """The best of some refits of the nominal model by BIC, and what might stand in its place."""
    best, nominal = _best(refits), case.nominal.fit.chi2
    if not best or best[0].bic > nominal - STRONG:
        return Verdict(mismatch=False)
    weights = _weights(np.array([nominal, *(refit.bic for refit in best)]))[1:]
    named = [
        Named(*refit.hypothesis.key, float(weight))
        for refit, weight in zip(best, weights, strict=True)
        if weight >= WORTH_SAYING
    ]
    return Verdict(True, tuple(named[:1]), tuple(named[1:]), best[0].fit)


def ladder(case: Case) -> Verdict:
    """Climb BAM's ladder of friction models at each joint, and choose a rung by BIC.

    The rung chosen names all that it stands on, by how much each lowered chi-squared.
    """
    every = [h for h in hypotheses(case.measured) if h.place.kind == "joint"]
    rungs: dict[tuple[str, Place], Refit] = {}
    bases: dict[Place, Fit] = dict.fromkeys((h.place for h in every), case.nominal.fit)
    for effect, below in LADDER:
        tried = []
        for place, nominal in bases.items():
            stands_on = nominal if below is None else rungs[below, place].fit
            tried += refitted(case, stands_on, [h for h in every if h.key == (effect, place)])
        rungs |= {refit.hypothesis.key: refit for refit in _best(tried)}
    top = min(rungs.values(), key=lambda refit: refit.bic)
    nominal_bic = case.nominal.fit.chi2
    if top.bic > nominal_bic - STRONG:
        return Verdict(mismatch=False)
    gains = _gains(top, rungs, nominal_bic)
    whole = sum(gains.values())
    named = [
        Named(effect, top.hypothesis.place, gain / whole)
        for effect, gain in sorted(gains.items(), key=lambda told: -told[1])
    ]
    return Verdict(True, tuple(named), fit=top.fit)


def refitted(case: Case, base: Fit, some: Sequence[Hypothesis]) -> list[Refit]:
    """Refit a model with each of some effects added.

    Args:
      case: the case.
      base: a fit of the model without them.
      some: the effects.
    """
    fits = [with_effect(base, hypothesis) for hypothesis in some]
    places = [_starts(h, fit, len(base.at)) for h, fit in zip(some, fits, strict=True)]
    for first in range(0, len(fits), TOGETHER):
        part = slice(first, first + TOGETHER)
        start_best(fits[part], places[part], case.replays, case.noise)
        fit_together(fits[part], case.replays, case.noise, ITERATIONS)
    price = float(np.log(len(case.measured.values)))
    nominal = len(case.nominal.fit.coordinates)
    return [
        Refit(h, fit, fit.chi2 + price * (len(fit.coordinates) + len(fit.fixed) - nominal))
        for h, fit in zip(some, fits, strict=True)
    ]


def with_effect(base: Fit, hypothesis: Hypothesis) -> Fit:
    """A fit of a model with one effect more; where it starts is still open."""
    shape = dict(hypothesis.shape)
    names = hypothesis.magnitudes + hypothesis.continuous
    coordinates = tuple(term_coordinate(name, hypothesis.scale) for name in names)
    start = [c.coordinate(shape[c.name]) if c.name in shape else 0.0 for c in coordinates]
    return Fit(
        base.coordinates + coordinates,
        np.r_[base.at, start],
        fixed={**base.fixed, **{n: v for n, v in shape.items() if n not in names}},
        thorough=False,
        slack=ROUGHLY,
    )


def _starts(hypothesis: Hypothesis, fit: Fit, known: int) -> list[Array]:
    """Places to start at: sizes of the effect, of both signs where it has two."""
    own = slice(known, known + len(hypothesis.magnitudes))
    lower, upper = (np.array([getattr(c, e) for c in fit.coordinates]) for e in ("lower", "upper"))
    sizes = [s for size in SIZES for s in ((size, -size) if hypothesis.signed else (size,))]
    places = []
    for size in sizes:
        at = fit.at.copy()
        at[own] = size  # what has several magnitudes may have some that are not signed
        places.append(np.clip(at, lower, upper))
    return places


def _best(refits: Sequence[Refit]) -> list[Refit]:
    """The best shape of each effect and place, best first."""
    best: dict[tuple[str, Place], Refit] = {}
    for refit in sorted(refits, key=lambda r: r.bic):
        best.setdefault(refit.hypothesis.key, refit)
    return list(best.values())


def _weights(bic: Array) -> Array:
    """Probabilities of models, as BIC approximates them."""
    weights = np.exp(-(bic - bic.min()) / 2)
    return np.asarray(weights / weights.sum())


def _gains(top: Refit, rungs: dict[tuple[str, Place], Refit], nominal: float) -> dict[str, float]:
    """What each effect of a rung lowered chi-squared by; those that did nothing are left out."""
    below = dict(LADDER)
    gains, effect, place = {}, top.hypothesis.effect, top.hypothesis.place
    step: str | None = effect
    while step is not None:
        under = below[step]
        before = nominal if under is None else rungs[under, place].fit.chi2
        gains[step] = before - rungs[step, place].fit.chi2
        step = under
    return {name: gain for name, gain in gains.items() if gain > 0}
