"""Effects exchanged for their rivals, once others are known that hid when they were chosen."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.fit import Fit
from pup.diagnosis.fitting import fit_together, start_best
from pup.diagnosis.hypotheses import Hypothesis
from pup.diagnosis.models import Model, Round, chosen_in, last_rounds
from pup.diagnosis.selection import MARGIN, ROUGH, Selector
from pup.diagnosis.starts import Tried, closely, joined, less
from pup.diagnosis.verdict import probabilities
from pup.physics.terms import Place

Array = NDArray[np.float64]

SWAPS, RIVALS = 2, 2
"""Effects that may be exchanged, and rivals that each may be exchanged for."""
ASKED, LIKELY = 4, 0.01
"""Rivals of an effect that are looked at again beside all others, if they are so likely."""
NEAR = 0.1
"""Share of what the effect explains by which a rival may be behind to be fitted to its end."""


class Exchanger(Selector):
    """Adds effects to a nominal fit and exchanges them for others that turn out to be better."""

    def run(self, start: Model, known: Sequence[Round] = ()) -> tuple[Model, list[Round]]:
        """The model that is left when nothing more is worth adding, and how it came about.

        Args:
          start: the nominal model, or one with effects that are known already.
          known: rounds that led to it, with models of the same samples and noise.
        """
        model = start
        rounds = list(known)
        for left in reversed(range(SWAPS + 1)):
            model = self.added(model, rounds)
            swap = self._swap(model, rounds) if left else None
            if swap is None:
                break
            rounds.append(swap)
            model = swap.finalists[0]
        return self.pruned(model), rounds

    def _swap(self, model: Model, rounds: Sequence[Round]) -> Round | None:
        """An effect exchanged for a rival of its own round, where what came later prefers that.

        The first effects are chosen while others still hide. The last knows all of them; it was
        chosen by worth alone, and is given up for what noise told anew makes worth more.
        """
        ways = self._exchanges(model, rounds)
        if not ways:
            return None
        fit_together([fit for _, (_, fit) in ways], self.replays, self.noise, iterations=ROUGH)
        last = len(model.hypotheses) - 1
        closely([fit for n, (_, fit) in ways if n == last], self.replays, self.noise)
        ways.sort(key=lambda way: (way[0] == last, way[1][1].chi2))
        for number in dict.fromkeys(n for n, _ in ways):
            rivals = [one for n, one in ways if n == number]
            margin = self.enough if number < last else 0.0
            if swap := self._exchanged(model, number, rivals, margin, rounds):
                return swap
        return None

    def _exchanged(
        self,
        model: Model,
        number: int,
        rivals: Sequence[Tried],
        margin: float,
        rounds: Sequence[Round],
    ) -> Round | None:
        """One effect exchanged for the best rival that holds, where that gains a margin."""
        if min(fit.chi2 for _, fit in rivals) > model.fit.chi2 - margin:
            return None
        before = self.lesser(model, number)
        holds, others = self.parted(before, self.models(rivals))
        if not holds:
            return None
        better = self.ended(holds[0])
        if better.worth > model.worth - margin / 2:
            return None
        given_up = model.hypotheses[number]
        known_as = replace(model, hypotheses=(*before.hypotheses, given_up))
        holds, others = self.parted(before, [*holds[1:], *others, known_as])
        ranking = chosen_in(rounds, given_up.key).ranking
        return Round(before, ranking, (better, *holds, *others), 1 + len(holds), again=True)

    def _exchanges(self, model: Model, rounds: Sequence[Round]) -> list[tuple[int, Tried]]:
        """Models with a rival in place of an effect, and which of them that is."""
        known = {h.key for h in model.hypotheses}
        last = last_rounds(rounds)
        ways: list[tuple[int, Tried]] = []
        for number, hypothesis in enumerate(model.hypotheses):
            others = tuple(h for h in model.hypotheses if h is not hypothesis)
            if hypothesis.key not in last:  # it was known from the start
                continue
            chosen = last[hypothesis.key]
            if hypothesis is model.hypotheses[-1] and chosen.settled:
                continue
            rivals = [m for m in chosen.finalists[1:] if m.hypotheses[-1].key not in known]
            for rival in rivals[:RIVALS]:
                new = rival.hypotheses[-1]
                fit = joined(less(model.fit, hypothesis), rival.fit, new)
                ways.append((number, ((*others, new), fit)))
        return ways

    def settled(self, model: Model, rounds: Sequence[Round]) -> tuple[Model, list[Round]]:
        """Each effect compared again with its rivals, beside all others that were found.

        A round compares while others still hide, and what those leave blurs it.

        Args:
          model: what a search has found.
          rounds: how it came about.

        Returns:
          The model, with an effect exchanged where a rival turns out to be worth more, and the
          rounds with those of the comparisons after them.
        """
        told = list(rounds)
        for hypothesis in model.hypotheses:
            compared = self._compared(model, hypothesis, told)
            if compared is None:
                continue
            told.append(compared)
            if compared.chosen is not hypothesis:
                model = compared.finalists[0]
        return model, told

    def _compared(
        self, model: Model, hypothesis: Hypothesis, rounds: Sequence[Round]
    ) -> Round | None:
        """The round of one effect beside all others; None where it was one, or has no rival."""
        others = tuple(h for h in model.hypotheses if h is not hypothesis)
        chosen = last_rounds(rounds).get(hypothesis.key)
        if chosen is None or set(others) == set(chosen.before.hypotheses):
            return None
        fit = less(model.fit, hypothesis)
        rivals = self._likely(chosen, {h.key for h in model.hypotheses})
        tried = [((*others, h), joined(fit, found, h)) for h, found in rivals]
        if not tried:
            return None
        fits = [f for _, f in tried]
        places = [_places(f, found) for f, (_, found) in zip(fits, rivals, strict=True)]
        start_best(fits, places, self.replays, self.noise)
        fit_together([fit, *fits], self.replays, self.noise, iterations=ROUGH)
        near = model.fit.chi2 + MARGIN + NEAR * (fit.chi2 - model.fit.chi2)
        closely([f for f in fits if f.chi2 < near], self.replays, self.noise)
        before = self.model(others, fit) if others else self.nominal
        holds, rest = self.parted(before, self.models(tried))
        known_as = replace(model, hypotheses=(*others, hypothesis))
        holds = sorted([known_as, *holds], key=lambda m: m.worth)
        return Round(before, chosen.ranking, (*holds, *rest), len(holds), again=True)

    def _likely(
        self, chosen: Round, known: Collection[tuple[str, Place]]
    ) -> list[tuple[Hypothesis, Fit]]:
        """What else a round may have found, the likeliest, each as it was fitted there.

        Forms of the class that was found are told apart by little, which others easily hide.
        """
        models = chosen.finalists[: chosen.holding]
        chances = probabilities(models, chosen.before, self.noise)
        ranked = sorted(zip(chances, models, strict=True), key=lambda pair: -pair[0])
        tried = [(chance, m.hypotheses[-1], m.fit) for chance, m in ranked]
        rivals = [(h, f) for p, h, f in tried if p > LIKELY or h.sibling_of(chosen.chosen)]
        return [(h, fit) for h, fit in rivals if h.key not in known][:ASKED]


def _places(fit: Fit, found: Fit) -> list[Array]:
    """Where a rival may start: at nominal parameters of the model, or as they were with it."""
    own = dict(zip(found.names, found.at, strict=True))
    nominal = [
        own.get(n, at) if "@" not in n else at for n, at in zip(fit.names, fit.at, strict=True)
    ]
    return [fit.at, np.array(nominal)]
