"""From fitted models to what is said of them: findings, alternatives, probabilities."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.doubts import doubt, left_over
from pup.diagnosis.evidence import overlap
from pup.diagnosis.folds import scatter
from pup.diagnosis.hypotheses import Hypothesis
from pup.diagnosis.jitter import jitter
from pup.diagnosis.laws import EQUATIONS, NAMELESS
from pup.diagnosis.locate import BAND
from pup.diagnosis.models import TEMPERATURE, Model, Round, chosen_in
from pup.diagnosis.regimes import Regime, Window, strongest, windows
from pup.diagnosis.residuals import Measured, Noise
from pup.diagnosis.selection import Selector
from pup.physics.terms import CLASS_OF, TERMS, Place, Quantity, split_column

Array = NDArray[np.float64]
Answer = Literal["mismatch", "none", "undetermined"]

BLUR = 0.5
"""Difference of worth, in what is left, at which rivals count as equals but for a factor of e."""
OWN_FORM, FORM = 0.2, 0.03
"""Probability that what is there acts in no form of the library, but near those of a class; and
the share of what the best of them explains that another one may leave and be as near."""
OTHER_FORM = 0.13
"""Share of a law's magnitude by which a real one, of another form, differs from what is fitted: of
33 in sealed sets nine of ten were nearer (docs/results/diagnosis.md)."""
SLIGHT = 0.25
"""Share of its typical size below which an effect is what every robot has a little of."""
DOMINANT = 30.0
"""What explains so many times as much as all others is first whatever its size."""
WORTH_SAYING = 0.03
"""Alternatives less probable than this are not told."""
JITTERY = ("command_delay", "measurement_delay")
"""Effects whose ticks may be late by another time each."""
LASTING = 10
"""Ticks for which the errors of one that was late go on."""
TWIN = 0.995
"""Traces that overlap by so much cannot be told apart, refitted or not."""


@dataclass(frozen=True)
class Parameter:
    """One fitted quantity of a finding, in its unit."""

    value: float
    unit: str
    lower: float
    upper: float


@dataclass(frozen=True)
class Alternative:
    """Another effect that would explain the same."""

    effect: str
    place: Place
    probability: float
    seat: Place | None = None
    """Where it shows, if that is not its place: the joint that moves a link."""


@dataclass(frozen=True)
class Finding:
    """One effect that the nominal model leaves out; fields as in docs/diagnosis.md."""

    effect: str
    place: Place
    regime: str
    when: tuple[Window, ...]
    parameters: Mapping[str, Parameter]
    probability: float
    equivalents: tuple[Alternative, ...]
    absorbed_by: Mapping[str, float]
    law: str | None
    gain: float = 0.0
    """Drop of chi-squared that it alone is worth."""
    size: float = np.inf
    """Of its largest magnitude, in what is typical of its kind; infinite of what has no kind."""
    seat: Place | None = None
    """As of an alternative."""

    @property
    def of_class(self) -> float:
        """Probability of something of its class at its place, whatever its form."""
        alike = (e.probability for e in self.equivalents if _cause(e) == _cause(self))
        return self.probability + sum(alike)

    @property
    def believed(self) -> bool:
        """Whether it or what it cannot be told from is more likely there than not."""
        return self.probability + sum(e.probability for e in self.equivalents) > 0.5


def probabilities(models: Sequence[Model], before: Model, noise: Noise) -> Array:
    """Of some rival models by their worth, if the cause is known to the library.

    Where the best leaves more than noise, other effects are still hidden or forms are not quite
    right, and rivals that leave as much more are as good. What acts in a form of its own may look
    more like another effect of its class, so that siblings that explain nearly as much share a part
    of what their class is given.

    Args:
      models: the rivals, the best first.
      before: the model that each adds one effect to.
      noise: that the samples are weighed by.
    """
    worth = np.array([m.worth for m in models])
    worth -= worth.min()
    weights = np.exp(-worth / (2 * TEMPERATURE + BLUR * left_over(models[0], noise)))
    best = models[0].hypotheses[-1]
    siblings = np.array([m.hypotheses[-1].sibling_of(best) for m in models])
    explained = max(before.fit.chi2 - models[0].fit.chi2, 0.0)
    alike = siblings * np.exp(-worth / (2 * TEMPERATURE + FORM * explained))
    shared = OWN_FORM * weights[siblings].sum() * alike / alike.sum()
    weights = np.where(siblings, (1 - OWN_FORM) * weights, weights) + shared
    return np.asarray(weights / weights.sum())


def findings(
    final: Model,
    rounds: Sequence[Round],
    selector: Selector,
    measured: Measured,
    found: Sequence[Regime],
    corrected: Model,
) -> tuple[Finding, ...]:
    """What the final model adds to the nominal one, most important first.

    Args:
      final: the model that selection has left.
      rounds: how it came about.
      selector: knows the traces and simulates.
      measured: the samples.
      found: the regimes of motion.
      corrected: the final model, or with a law that was read off beside its effects: that of the
        corrected robot, whose sizes are told.
    """
    nominal = selector.nominal
    left = left_over(final, selector.noise)
    told = []
    for hypothesis, less in zip(final.hypotheses, selector.without_class(final), strict=True):
        assert less.residual is not None and final.fit.residual is not None
        squares = less.residual**2 - final.fit.residual**2
        gain = less.chi2 - final.fit.chi2
        chosen = chosen_in(rounds, hypothesis.key)
        # What is hardly more than chance counts little, and so comes after what explains much.
        known = 1 - doubt(gain, left + selector.enough, hypothesis.family)
        probability, rivals = _rivals(hypothesis, chosen, selector, known)
        told.append(
            Finding(
                effect=hypothesis.effect,
                place=hypothesis.place,
                regime=strongest(found, squares),
                when=tuple(windows(measured, squares)),
                parameters=_parameters(hypothesis, corrected)
                | _uneven(hypothesis, corrected, selector.noise),
                probability=probability,
                equivalents=rivals,
                absorbed_by=_absorbed(nominal, corrected),
                law=EQUATIONS[hypothesis.effect],
                gain=gain,
                size=final.size(hypothesis),
                seat=hypothesis.seat,
            )
        )
    return in_order(shared(told))


def shared(found: Sequence[Finding]) -> list[Finding]:
    """Findings, those of one class at one place each a rival of the other.

    What takes two forms of a class at one place acts in neither of them but in one of its own, and
    nobody can say which of the two that is nearer to: the usual one, more often than not.
    """
    told = []
    for finding in found:
        kin = [f for f in found if _cause(f) == _cause(finding)]
        known = {e.effect for e in finding.equivalents}
        others = [f for f in kin if f is not finding and f.effect not in known]
        usual = np.exp([-_rarity(f.effect) for f in (finding, *others)])
        own, *rest = (float(p) for p in finding.probability * usual / usual.sum())
        more = tuple(
            Alternative(f.effect, f.place, p, f.seat) for f, p in zip(others, rest, strict=True)
        )
        told.append(replace(finding, probability=own, equivalents=more + finding.equivalents))
    return told


def _rarity(effect: str) -> float:
    """As of its term; 0 of what is none."""
    return TERMS[effect].rarity if effect in TERMS else 0.0


def _cause(finding: Finding | Alternative) -> tuple[object, Place]:
    return CLASS_OF.get(finding.effect, finding), finding.seat or finding.place


def in_order(found: Sequence[Finding]) -> tuple[Finding, ...]:
    """Findings, most important first: by what they explain.

    Beside an effect of a usual size, those of which every robot has a little come after, though
    more of the error is theirs (a clock that is off by a little moves everything), unless nearly
    all of it is. Of two forms of one class at one place the likelier is first. What has no name is
    first only where it is surer than the first that has one: a torque that may be anything explains
    the most.
    """
    usual = [f for f in found if f.effect != NAMELESS and f.believed and f.size >= SLIGHT]
    most = max((f.gain for f in usual), default=np.inf)

    def slight(finding: Finding) -> bool:
        return bool(usual) and finding.size < SLIGHT and finding.gain < DOMINANT * most

    ordered = sorted(found, key=lambda f: (slight(f), -f.gain))
    for i, finding in enumerate(ordered):
        kin = [j for j in range(i, len(ordered)) if _cause(ordered[j]) == _cause(finding)]
        likeliest = max(kin, key=lambda j: ordered[j].probability)
        ordered[i], ordered[likeliest] = ordered[likeliest], finding
    named = next((f for f in ordered if f.effect != NAMELESS), None)
    if named and named.probability >= ordered[0].probability and ordered[0].effect == NAMELESS:
        ordered.remove(named)
        ordered.insert(0, named)
    return tuple(ordered)


def reaches(model: Model) -> Array:
    """Half the width of 90 % intervals of coordinates: by noise, or by how motions differ."""
    noise = BAND * np.sqrt(np.diag(model.fit.covariance()))
    return np.asarray(np.maximum(noise, scatter(model.refits)))


def _rivals(
    hypothesis: Hypothesis, chosen: Round, selector: Selector, known: float
) -> tuple[float, tuple[Alternative, ...]]:
    """The probability of a finding and of what else it might be, `known` in all."""
    models = chosen.finalists[: chosen.holding]
    chances = known * probabilities(models, chosen.before, selector.noise)
    by_key: dict[tuple[str, Place], float] = {}
    for model, chance in zip(models, chances, strict=True):
        key = model.hypotheses[-1].key
        by_key[key] = by_key.get(key, 0.0) + float(chance)
    own = by_key.pop(hypothesis.key)
    twins = twins_of(hypothesis, by_key, chosen)
    share = own / (1 + len(twins))
    by_key |= dict.fromkeys(twins, share)
    known_of = [*(m.hypotheses[-1] for m in models), *(s.trace.hypothesis for s in chosen.ranking)]
    seats = {h.key: h.seat for h in known_of}
    told = [Alternative(*key, p, seats[key]) for key, p in by_key.items() if p >= WORTH_SAYING]
    return share, tuple(sorted(told, key=lambda a: -a.probability))


def twins_of(
    hypothesis: Hypothesis, known: Mapping[tuple[str, Place], float], chosen: Round
) -> list[tuple[str, Place]]:
    """Hypotheses that were not refitted but leave the same trace, at sizes that they can have."""
    told = {score.trace.hypothesis: score for score in chosen.ranking}
    if hypothesis not in told:
        return []
    own = told[hypothesis].trace
    change = own.left @ told[hypothesis].sizes
    refitted = {m.hypotheses[-1].key for m in chosen.finalists} | set(known) | {hypothesis.key}
    return list(
        dict.fromkeys(
            other.key
            for other, trace in ((h, score.trace) for h, score in told.items())
            if other.key not in refitted
            and trace.seen == own.seen == 1
            and overlap(trace, own) > TWIN
            and (other.signed or float(trace.left[:, 0] @ change) > 0)
        )
    )


def _parameters(hypothesis: Hypothesis, final: Model) -> dict[str, Parameter]:
    """What was fitted of an effect, and the shapes that were chosen."""
    reach, term = reaches(final), TERMS[hypothesis.effect]
    quantities = {q.name: q for q in term.quantities}
    told = {}
    for i, coordinate in enumerate(final.fit.coordinates):
        quantity = _quantity(coordinate.name, hypothesis)
        if quantity is None:
            continue
        at = float(final.fit.at[i])
        ends = (max(at - reach[i], coordinate.lower), min(at + reach[i], coordinate.upper))
        fitted = Parameter(
            coordinate.value(at), quantities[quantity].unit, *(coordinate.value(e) for e in ends)
        )
        factor = hypothesis.scale.factor(quantities[quantity].unit)
        law = of_other_form(fitted, quantities[quantity], factor)
        told[quantity] = fitted if term.constant else law
    for name, value in final.fit.fixed.items():
        quantity = _quantity(name, hypothesis)
        if quantity is not None:
            told[quantity] = Parameter(value, quantities[quantity].unit, value, value)
    return told


def of_other_form(fitted: Parameter, quantity: Quantity, factor: float = 1.0) -> Parameter:
    """A law's fitted quantity, its interval widened by what a real law's own form may make of it.

    A shape says how the form acts that was fitted; a real one's need not have it.

    Args:
      fitted: as the law has it.
      quantity: what it is.
      factor: of the robot's scale on the quantity's ends.
    """
    if quantity.shape:
        return fitted
    value, form = fitted.value, OTHER_FORM * abs(fitted.value)
    lower = value - float(np.hypot(value - fitted.lower, form))
    upper = value + float(np.hypot(fitted.upper - value, form))
    ends = factor * quantity.lower, factor * quantity.limit
    return replace(fitted, lower=max(lower, ends[0]), upper=min(upper, ends[1]))


def _uneven(hypothesis: Hypothesis, final: Model, noise: Noise) -> dict[str, Parameter]:
    """By how much a delay changes from tick to tick, where it does: what repeats tell, and more."""
    if hypothesis.effect not in JITTERY:
        return {}
    more = jitter(final)
    if more is None and not noise.late:
        return {}
    reach = BAND / np.sqrt(2 * max(noise.readings / LASTING, 1))
    sure = max(1 - reach, 0.0), 1 + reach
    ends = (more.lower, more.upper) if more else (0.0, 0.0)
    return {
        "jitter": Parameter(
            float(np.hypot(noise.late, more.spread if more else 0.0)),
            "s",
            *(float(np.hypot(noise.late * s, e)) for s, e in zip(sure, ends, strict=True)),
        )
    }


def _quantity(name: str, hypothesis: Hypothesis) -> str | None:
    """The quantity of a hypothesis that a parameter is; None for a parameter of something else."""
    named = split_column(name)
    return named[1] if named is not None and (named[0], named[2]) == hypothesis.key else None


def _absorbed(nominal: Model, final: Model) -> dict[str, float]:
    """By how much nominal parameters were wrong to make up for what was missing."""
    before, after = nominal.fit.values, final.fit.values
    shifts = {n: before[n] / after[n] - 1 for n in before if "@" not in n and after.get(n)}
    return {
        n: float(s) for n, s in sorted(shifts.items(), key=lambda p: -abs(p[1])) if abs(s) > 0.01
    }
