"""What was simulated, weighed by another noise.

Where nothing was recorded twice, noise is told anew by what a first search leaves. To weigh by it
takes no simulation: whitening is linear and can be undone, so that residuals, Jacobians and traces
are turned from one noise to the other, and fits go on from where they stand.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.evidence import Projector, Score, Trace, foremost, scores, traced, unimitated
from pup.diagnosis.exchanges import RIVALS
from pup.diagnosis.fit import Fit
from pup.diagnosis.fitting import fit_together
from pup.diagnosis.models import Model, Round
from pup.diagnosis.residuals import Measured, Noise
from pup.diagnosis.selection import Selector

Array = NDArray[np.float64]

RANKED = 100
"""Scores of a round that are kept: those behind are neither told nor looked at again."""
SETTLED = 3
"""Steps in which finalists of former rounds find their minima by the other noise."""


@dataclass(frozen=True, eq=False)
class Reweighing:
    """Turns what is whitened by one noise into the same whitened by another.

    Attributes:
      measured: the samples.
      before: the noise by which everything is whitened.
      after: the noise by which it shall be.
    """

    measured: Measured
    before: Noise
    after: Noise

    def turned(self, white: Array) -> Array:
        """Whitened errors or changes, shape (..., n_samples)."""
        return self.measured.whiten(self.measured.coloured(white, self.before), self.after)

    def fit(self, fit: Fit) -> Fit:
        """A fit of all samples where it stands, which may go on from there."""
        assert fit.residual is not None and fit.jacobian is not None
        residual = self.turned(fit.residual)
        return Fit(
            fit.coordinates,
            fit.at.copy(),
            fixed=fit.fixed,
            residual=residual,
            jacobian=self.turned(fit.jacobian.T).T,
            chi2=float(residual @ residual),
            thorough=False,
            age=1,
            slack=fit.slack,
        )

    def traces(self, found: Iterable[Trace], base: Fit) -> list[Trace]:
        """Traces around a fit, less what its coordinates can imitate by the other noise."""
        project = Projector(base.slopes)
        told = (traced(t.hypothesis, self.turned(t.whole.T).T, project) for t in found)
        return [trace for trace in told if trace is not None]

    def rounds(
        self, rounds: Sequence[Round], known: Mapping[Model, Model], selector: Selector
    ) -> list[Round]:
        """Rounds that added an effect, with models weighed anew.

        What was chosen stays first, whatever its rivals are worth now: a swap may exchange it.

        Args:
          rounds: of a search that weighed by the noise before.
          known: models that are weighed anew already.
          selector: weighs by the noise after.
        """
        kept = [r for r in rounds if r.accepted and r.before.measured is self.measured]
        asked = dict.fromkeys(m for r in kept for m in (r.before, *_worth_keeping(r)))
        old = [m for m in asked if m not in known]
        fits = [self.fit(m.fit) for m in old]
        fit_together(fits, selector.replays, selector.noise, iterations=SETTLED)
        new = selector.models([(m.hypotheses, f) for m, f in zip(old, fits, strict=True)])
        models = {**known, **dict(zip(old, new, strict=True))}
        return [self._round(r, models, selector) for r in kept]

    def _round(self, chosen: Round, models: Mapping[Model, Model], selector: Selector) -> Round:
        before = models[chosen.before]
        first, *others = (models[m] for m in _worth_keeping(chosen))
        holds, rest = selector.parted(before, others)
        ranking = self._ranking(chosen, before.fit)
        return Round(before, ranking, (first, *holds, *rest), 1 + len(holds), chosen.again)

    def _ranking(self, chosen: Round, base: Fit) -> tuple[Score, ...]:
        refitted = {m.hypotheses[-1] for m in _worth_keeping(chosen)}
        old = foremost(chosen.ranking, RANKED, refitted)
        new = scores(self.traces((s.trace for s in old), base), unimitated(base))
        seen = {s.trace.hypothesis for s in new}
        # A finalist that the other noise hides is ranked as it was: its fit is told.
        unseen = [s for s in old if s.trace.hypothesis in refitted - seen]
        return (*new, *unseen)


def _worth_keeping(chosen: Round) -> tuple[Model, ...]:
    """Finalists that hold, and those that a swap might try."""
    return chosen.finalists[: chosen.holding + RIVALS]
