"""Refit what the score test shortlists, and keep what holds on motions it was not fitted to.

Scores are linear and so are their rankings; a refit of each finalist together with all nominal
parameters is not. Effects are added one by one, the best first, as long as they lower chi-squared
by more than chance and predict types of motion that were left out; then each is tried without.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.beginnings import begun, nearer
from pup.diagnosis.doubts import spare
from pup.diagnosis.evidence import Score, Trace, foremost, scores, unimitated
from pup.diagnosis.fit import Fit
from pup.diagnosis.fitting import complete, fit_together, start_best
from pup.diagnosis.folds import folds, left_out, without_samples
from pup.diagnosis.gains import explains, material
from pup.diagnosis.hypotheses import Hypothesis, hypotheses
from pup.diagnosis.models import Model, Round
from pup.diagnosis.replays import Replays
from pup.diagnosis.residuals import LOST, Noise
from pup.diagnosis.retracing import Retracer
from pup.diagnosis.shortlist import FAINT, FURTHER, in_contact, shortlist, suspected, untried
from pup.diagnosis.starts import (
    DRIVEN,
    LIMB,
    Tried,
    begun_anew,
    closely,
    described,
    distinct,
    glaring,
    less,
    options,
    puzzling,
    started,
)
from pup.diagnosis.tracing import traces

Array = NDArray[np.float64]

FIRST, ROUGH = 2, 5
"""Steps of all finalists until they are compared, and of those promising then."""
HOPE = 0.65
"""Share of the best one's gain by which a finalist may be behind at first."""
CLOSE, MARGIN = 4, 40.0
"""So many of other classes than the best one's are refitted to the end, if they are within so much
chi-squared of it."""
REMEMBERED = 150
"""Scores of a later round that are kept until the end."""
PLACES = 16
"""Places that all effects together may act at."""
KEPT = 0.25
"""Share of its gain that an effect must keep on motions left out."""
FORM, OF_CONTACT = 0.03, 0.25
"""Share of its own trace by which an effect's form may be wrong: what is left of one that was found
is no evidence of another. Of contact another impedance and integrator leave a fifth, even the same
law at another time step a tenth (docs/results/diagnosis.md)."""
WHOLE = 0.7
"""Share of what is left beyond noise from which an effect is the law of it, however little it is
next to what was found before: a flex behind a limit of the rate that explains 1,600 times as much.
"""


class Selector:
    """Adds effects to a nominal fit.

    Args:
      replays: simulates.
      noise: weighs the samples.
      found: traces of all hypotheses around the nominal fit, or around `base`.
      enough: surprise that chance does not reach.
      nominal: the nominal fit, with its Jacobian.
      base: the fit to start from, where some effects are known already.
      most: effects that are looked for.
      told: of each effect that is added.
      followed: the samples that the nominal fit keeps track of; None for all.
    """

    def __init__(
        self,
        replays: Replays,
        noise: Noise,
        found: Sequence[Trace],
        enough: float,
        nominal: Fit,
        base: Fit | None = None,
        most: int = 8,
        told: Callable[[Model], None] = lambda model: None,
        followed: NDArray[np.bool_] | None = None,
    ) -> None:
        self.replays = replays
        self.noise = noise
        self.traces = Retracer(replays, noise, found, base or nominal)
        self.enough, self.most, self.told = enough, most, told
        self.followed = followed
        self.folds = folds(replays)
        self._lesser: tuple[Model | None, list[Fit]] = None, []
        self.nominal = self.predicting(self.model((), nominal))

    def added(self, model: Model, rounds: list[Round]) -> Model:
        """The model with effects added as long as one holds; notes the rounds."""
        while not full(model, self.most):
            chosen = self._round(model)
            if chosen is None:
                break
            rounds.append(chosen)
            if not chosen.accepted:
                break
            model = chosen.finalists[0]
            self.told(model)
        return model

    def ended(self, model: Model) -> Model:
        """A model with its fit at its minimum, for later ones are held against it."""
        if model.fit.thorough:
            return model
        closely([model.fit], self.replays, self.noise)
        return self.model(model.hypotheses, model.fit)

    def model(self, hypotheses: Sequence[Hypothesis], fit: Fit) -> Model:
        """A fitted model with its predictions of the folds."""
        return self.models([(tuple(hypotheses), fit)])[0]

    def lesser(self, model: Model, number: int) -> Model:
        """The model without one of its effects."""
        others = [h for i, h in enumerate(model.hypotheses) if i != number]
        return self.model(others, self.without(model)[number]) if others else self.nominal

    def without(self, model: Model) -> list[Fit]:
        """The model refitted without each of its effects in turn."""
        of, known = self._lesser
        asked_again = of is not None and of.fit is model.fit and of.hypotheses == model.hypotheses
        if not asked_again:
            known = [less(model.fit, h) for h in model.hypotheses]
            fit_together(known, self.replays, self.noise, iterations=ROUGH)
            self._lesser = model, known
        return known

    def without_class(self, model: Model) -> list[Fit]:
        """The model refitted without each of its effects and all forms of that one's class there.

        What is there may act in a form between two of the library, each of which hardly matters
        beside the other.
        """
        classes = [
            [h for h in model.hypotheses if h.sibling_of(hypothesis)]
            for hypothesis in model.hypotheses
        ]
        if len(classes[0]) == len(model.hypotheses):
            return [self.nominal.fit] * len(classes)
        fewer = {own[0]: reduce(less, own, model.fit) for own in classes if len(own) > 1}
        fit_together(list(fewer.values()), self.replays, self.noise, iterations=ROUGH)
        alone = self.without(model)
        return [fewer.get(own[0], fit) for fit, own in zip(alone, classes, strict=True)]

    def _round(self, model: Model) -> Round | None:
        fit = model.fit
        of_contact = any(map(in_contact, model.hypotheses))
        if of_contact and spare(model) < self.blur(model):
            return None  # all that is left may be the form of contact that was found
        ranking = scores(self.traces.around(model), unimitated(fit))
        shown = bool(ranking) and ranking[0].surprise >= self.enough
        if not shown and (model.hypotheses or not glaring(fit.chi2, model.samples)):
            return None
        tried = self._promising(model, ranking) if shown else []
        if not model.hypotheses and puzzling(fit, tried, DRIVEN):
            more, elsewhere = self._elsewhere(fit)
            ranked = {score.trace.hypothesis for score in ranking}
            ranking += [score for score in more if score.trace.hypothesis not in ranked]
            tried = distinct([*tried, *elsewhere])
        if not (shown or tried):
            return None
        better = [(h, f) for h, f in tried if fit.chi2 - f.chi2 > self.enough]
        told = _remembered(model, ranking, better)
        if not better:
            return Round(model, told, (), 0)
        holds, others = self.parted(model, self.models(better))
        if holds:
            holds[0] = self.ended(holds[0])
        return Round(model, told, (*holds, *others), len(holds))

    def _promising(self, model: Model, ranking: Sequence[Score]) -> list[Tried]:
        """Fits of the effects that a ranking speaks for; further down it for the first effect."""
        contact = suspected(model.fit, self.replays.measured)
        tried = self._begun(model, shortlist(ranking, self.enough, contact))
        self._refit(tried, model.fit.chi2)
        return tried if model.hypotheses else tried + self._further(model, ranking, tried)

    def _further(
        self, model: Model, ranking: Sequence[Score], tried: Sequence[Tried]
    ) -> list[Tried]:
        """Fits further down the ranking, where all that was tried leaves many times the noise.

        Not of whole robots, which have hundreds of hypotheses.
        """
        measured = self.replays.measured
        left = min((fit.chi2 for _, fit in tried), default=model.fit.chi2)
        if len(measured.robot.joints) > LIMB or not glaring(left, len(measured.values)):
            return []
        known = {effects[-1] for effects, _ in tried}
        chosen = shortlist(ranking, self.enough, most=FURTHER, worth=FAINT)
        more = self._begun(model, [s for s in chosen if s.trace.hypothesis not in known])
        self._refit(more, model.fit.chi2)
        return more

    def _begun(self, model: Model, chosen: Sequence[Score]) -> list[Tried]:
        """Fits of a model with one effect more, each begun where it is best."""
        tried = [
            ((*model.hypotheses, score.trace.hypothesis), started(model.fit, score))
            for score in chosen
        ]
        places = [options(model.fit, score, f) for score, (_, f) in zip(chosen, tried, strict=True)]
        start_best([f for _, f in tried], places, self.replays, self.noise)
        return tried

    def _elsewhere(self, nominal: Fit) -> tuple[list[Score], list[Tried]]:
        """Scores, and fits, that begin at the robot as it is described; see `described`.

        Where none of these explains much, slopes tell nothing there either: what makes a loop swing
        does so from some size on. Then all that a robot of one joint may have is fitted, to how
        recordings begin at first: swings that are out of step lead nowhere.
        """
        fit = described(self.nominal.fit, self.replays, self.noise)
        if fit is None:
            return [], []
        found = traces(hypotheses(self.replays.measured), fit, self.replays, self.noise)
        ranking = scores(found, unimitated(fit))
        if not ranking:
            return [], []
        there = replace(self.nominal, fit=fit)
        chosen = shortlist(ranking, self.enough, suspected(fit, self.replays.measured))
        tried = self._begun(there, chosen)
        self._refit(tried, nominal.chi2)
        if len(self.replays.measured.robot.joints) == 1 and puzzling(nominal, tried, DRIVEN):
            more = [(h, f.fresh()) for h, f in self._begun(there, untried(ranking, chosen))]
            begun([fit for _, fit in more], self.replays, self.noise)
            self._refit(more, nominal.chi2)
            tried += more
        return ranking, tried

    def blur(self, model: Model, least: float = FORM) -> float:
        """Chi-squared that wrong forms of a model's effects may leave."""
        return max(float(self._forms(model, least).sum()), 0.0)

    def _forms(self, model: Model, least: float) -> Array:
        """The same of each sample, shape (n_samples,)."""
        gained = _gained(self.nominal.fit, model.fit)
        share = np.full(len(gained), least)
        if any(map(in_contact, model.hypotheses)):
            share[self.replays.measured.grounded] = max(least, OF_CONTACT)
        return np.asarray(share**2 * gained)

    def _beyond_forms(self, before: Model, after: Model) -> bool:
        """Whether an effect explains more than wrong forms of those before it may leave.

        Of all motions, or of those that the nominal model follows: one that it loses track of is so
        far off that a form's share of it would hide whatever else there is.
        """
        inside, allowed = _gained(before.fit, after.fit), self._forms(before, FORM)
        if inside.sum() > max(allowed.sum(), 0.0):
            return True
        if self.followed is None:
            return False
        near, nearby = inside[self.followed].sum(), allowed[self.followed].sum()
        return bool(near > max(nearby, self.enough))

    def _completes(self, before: Model, after: Model) -> bool:
        """Whether an effect explains nearly all that those before it leave beyond noise.

        A wrong form leaves errors of its own, of which no other effect is the law.
        """
        if any(map(in_contact, before.hypotheses)):
            return False
        return before.fit.chi2 - after.fit.chi2 > WHOLE * spare(before)

    def _refit(self, tried: Sequence[Tried], start: float) -> None:
        """Refit finalists: all for a first look, the promising roughly, the best to the end.

        So are those of the best one's class, for what tells them apart is small, and the first,
        which the score test has put there.
        """
        if not tried:
            return
        fits = [fit for _, fit in tried]
        fit_together(fits, self.replays, self.noise, iterations=FIRST)
        seen = min(fit.chi2 for fit in fits)
        hope = HOPE * (start - seen) + MARGIN
        promising = [
            fit
            for known, fit in tried
            if fit is fits[0] or fit.chi2 - seen < hope or in_contact(known[-1])
        ]
        nearer(promising, self.replays, self.noise)
        fit_together(promising, self.replays, self.noise, iterations=ROUGH - FIRST)
        ranked = sorted(tried, key=lambda one: one[1].chi2)
        family, least = ranked[0][0][-1].family, ranked[0][1].chi2
        own = [fit for known, fit in ranked if known[-1].family == family]
        others = [fit for known, fit in ranked if known[-1].family != family]
        close = [
            fit
            for rank, fit in enumerate(others)
            if fit is fits[0] or (rank < CLOSE and fit.chi2 < 1.02 * least + MARGIN)
        ]
        closely([*own, *close], self.replays, self.noise)
        begun_anew(own, self.replays, self.noise)

    def parted(self, before: Model, finalists: Sequence[Model]) -> tuple[list[Model], list[Model]]:
        """Finalists that hold against a model, and those that do not, the best first of each."""
        ordered = sorted(finalists, key=lambda m: m.worth)
        holds = [m for m in ordered if self.holds(before, m)]
        return holds, [m for m in ordered if m not in holds]

    def holds(self, before: Model, after: Model) -> bool:
        """Whether an effect keeps its gain where it was not fitted, and matters."""
        inside = before.fit.chi2 - after.fit.chi2
        outside = float((before.held_out - after.held_out).sum())
        if outside <= max(KEPT * inside, 0.5 * self.enough):
            return False
        if not (self._beyond_forms(before, after) or self._completes(before, after)):
            return False
        newest, known = after.hypotheses[-1], _effects(before.hypotheses)
        values = after.fit.values
        if any(abs(values[name]) < least for name, least in newest.least.items()):
            return False
        if after.fit.at_an_end(newest.telling):
            return False
        both, measured = (before.fit, after.fit), self.replays.measured
        return explains(newest, *both, measured, newest.effect in known) and material(
            newest, *both, measured
        )

    def pruned(self, model: Model) -> Model:
        """The model less whatever it can do without."""
        while model.hypotheses:
            alone = len(model.hypotheses) == 1
            fits = [self.nominal.fit] if alone else self.without(model)
            costs = [fit.chi2 - model.fit.chi2 for fit in fits]
            spare = int(np.argmin(costs))
            if costs[spare] > self.enough:
                return model
            model = self.ended(self.lesser(model, spare))
        return model

    def models(self, fitted: Sequence[Tried]) -> list[Model]:
        """Fitted models with what each fold costs them by fits without it."""
        complete([fit for _, fit in fitted], self.replays, self.noise)
        insides = [self.replays.measured.only(fold) for fold in self.folds]
        return [
            Model(
                hypotheses,
                self.traces.freedom(hypotheses),
                fit,
                np.array([left_out(fit, inside) for inside in insides]),
                self.replays.measured,
            )
            for hypotheses, fit in fitted
        ]

    def predicting(self, model: Model) -> Model:
        """The model with what fits without each fold predict of it."""
        if len(model.predicted):
            return model
        measured = self.replays.measured
        insides = [measured.only(fold) for fold in self.folds]
        fits = [without_samples(model.fit, inside) for inside in insides]
        fit_together(fits, self.replays, self.noise, iterations=ROUGH)
        rows = [[fit.row()] for fit in fits]
        told = self.replays.together(list(zip(rows, self.folds, strict=True)))
        predicted = measured.values.copy()
        for inside, simulated in zip(insides, told, strict=True):
            off = measured.values[inside] + LOST
            predicted[inside] = np.where(np.isnan(simulated[0]), off, simulated[0])
        return replace(model, predicted=predicted, refits=np.array([fit.at for fit in fits]))


def full(model: Model, most: int) -> bool:
    """Whether a model has as many effects as are looked for, or at as many places as can be."""
    return len(model.hypotheses) >= PLACES or len(_effects(model.hypotheses)) >= most


def _gained(before: Fit, after: Fit) -> Array:
    """By how much each sample costs less, shape (n_samples,)."""
    assert before.residual is not None and after.residual is not None
    return np.asarray(before.residual**2 - after.residual**2)


def _effects(hypotheses: Sequence[Hypothesis]) -> set[str]:
    return {hypothesis.effect for hypothesis in hypotheses}


def _remembered(
    model: Model, ranking: Sequence[Score], tried: Sequence[Tried]
) -> tuple[Score, ...]:
    """Scores that a round is remembered by; of later ones not all, for traces fill the memory."""
    if not model.hypotheses:
        return tuple(ranking)
    return tuple(foremost(ranking, REMEMBERED, {known[-1] for known, _ in tried}))
