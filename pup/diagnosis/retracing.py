"""Traces of all hypotheses around the model that a search has come to."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.evidence import Projector, Trace, scores, traced, unimitated
from pup.diagnosis.fit import Fit
from pup.diagnosis.hypotheses import Hypothesis, hypotheses
from pup.diagnosis.models import Model
from pup.diagnosis.replays import Replays
from pup.diagnosis.residuals import Noise
from pup.diagnosis.tracing import by_rank, traces
from pup.physics.terms import Place

Array = NDArray[np.float64]

LEADING, MOST = 80, 400
"""Hypotheses that are simulated again around a model that has an effect more: those that looked
most like its errors before, and so many more where that was no guide."""
ALIKE = 0.8
"""Least cosine of what a hypothesis leaves before and after, for the ranking to be a guide."""


class Retracer:
    """Simulates hypotheses anew as a model grows: a large effect changes what all others do.

    Args:
      replays: simulates.
      noise: weighs the samples.
      found: traces of all hypotheses around `base`.
      base: a fit with its Jacobian.
    """

    def __init__(self, replays: Replays, noise: Noise, found: Sequence[Trace], base: Fit) -> None:
        self.replays, self.noise = replays, noise
        self.found, self.base = tuple(found), base
        self._seen = _widths(self.found)

    def around(self, model: Model) -> list[Trace]:
        """Traces, around a model, of what it does not have."""
        known = {h.key for h in model.hypotheses}
        if model.fit is not self.base:
            rest = [h for h in hypotheses(self.replays.measured) if h.key not in known]
            self.found = self.anew(model.fit, rest)
            self.base = model.fit
            self._seen |= _widths(self.found)
        return [t for t in self.found if t.hypothesis.key not in known]

    def freedom(self, effects: Sequence[Hypothesis]) -> int:
        """How many parameters of some effects the motions show."""
        seen = self._seen
        return sum(seen.get(h.key, len(h.magnitudes)) + len(h.continuous) for h in effects)

    def anew(self, fit: Fit, rest: Sequence[Hypothesis]) -> tuple[Trace, ...]:
        """Traces around a fit; where there are many, those of the hopeless as they were.

        So are those of what the fit has: an effect that is given up may be asked for again.

        Args:
          fit: with its Jacobian.
          rest: hypotheses that it does not have.
        """
        project = Projector(fit.slopes)
        kept = {h.key for h in rest}
        before = [t for t in self.found if t.hypothesis.key in kept]
        known = [t for t in self.found if t.hypothesis.key not in kept]
        around = (traced(t.hypothesis, t.whole, project) for t in before)
        old = {t.hypothesis: t for t in around if t is not None}
        place: dict[tuple[str, Place], int] = {}
        for rank, score in enumerate(scores(list(old.values()), unimitated(fit))):
            place.setdefault(score.trace.hypothesis.key, rank)  # by the best of its forms
        ordered = by_rank(rest, place, self.replays.measured.robot)
        leading = _whole(ordered, LEADING)
        new = traces(leading, fit, self.replays, self.noise)
        more = _whole(ordered, MOST)[len(leading) :]
        if more and _changed(old, new) > 0.5:
            leading, new = [*leading, *more], new + traces(more, fit, self.replays, self.noise)
        again = {h.key for h in leading}
        return (*new, *(t for t in old.values() if t.hypothesis.key not in again), *known)


def _widths(found: Sequence[Trace]) -> dict[tuple[str, Place], int]:
    """How many parameters of each effect at a place the motions show."""
    return {t.hypothesis.key: t.seen for t in found}


def _whole(ordered: Sequence[Hypothesis], number: int) -> list[Hypothesis]:
    """The first ones, each with all its forms."""
    first = {h.key for h in ordered[:number]}
    return [h for h in ordered if h.key in first]  # forms of one effect stand together


def _changed(old: Mapping[Hypothesis, Trace], new: Sequence[Trace]) -> float:
    """Share of traces that are not what they were."""
    both = [(old[t.hypothesis].left, t.left) for t in new if t.hypothesis in old]
    cosines = [np.vdot(a, b) / (np.linalg.norm(a) * np.linalg.norm(b)) for a, b in both]
    return float(np.mean(np.array(cosines) < ALIKE)) if cosines else 1.0
