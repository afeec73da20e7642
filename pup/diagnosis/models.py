"""Models with effects, as a search for what is missing fits and compares them."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.evidence import Score
from pup.diagnosis.fit import Fit
from pup.diagnosis.hypotheses import Hypothesis
from pup.diagnosis.residuals import Measured
from pup.physics.terms import TERMS, Place

Array = NDArray[np.float64]

TEMPERATURE = 4.0
"""Differences of worth are divided by this: models of real data are never quite right."""
USUAL = 3.0
"""Effects of more than so many times their typical size are rare."""


@dataclass(frozen=True, eq=False)
class Model:
    """The nominal model with some effects, fitted.

    Attributes:
      hypotheses: the effects, in the order in which they were found.
      freedom: of their magnitudes and shapes, how many the data see.
      fit: of nominal parameters and effects together.
      held_out: what each fold costs by a fit without it, shape (n_folds,); see `folds.left_out`.
      measured: the samples that it was fitted to.
      predicted: what those fits predict, shape (n_samples,), rad; empty where nobody has asked.
      refits: their coordinates, shape (n_folds, n_free); empty likewise.
    """

    hypotheses: tuple[Hypothesis, ...]
    freedom: int
    fit: Fit
    held_out: Array
    measured: Measured
    predicted: Array = field(default_factory=lambda: np.empty(0))
    refits: Array = field(default_factory=lambda: np.empty((0, 0)))

    @property
    def samples(self) -> int:
        """Samples that it was fitted to."""
        return 0 if self.fit.residual is None else len(self.fit.residual)

    def size(self, hypothesis: Hypothesis) -> float:
        """Size of the largest magnitude of one of its effects, in what is typical of its kind."""
        at = dict(zip(self.fit.names, self.fit.at, strict=True))
        return max(abs(float(at[name])) for name in hypothesis.magnitudes)

    @property
    def worth(self) -> float:
        """What it costs: half its chi-squared in sample, half out of it, and its complexity.

        And how unusual its laws and sizes are: an encoder that is off by a tenth of a radian is
        rarer than a load whose centre is off by a centimetre, which moves a servo in the same way.
        """
        inside = self.fit.chi2 + self.freedom * float(np.log(self.samples))
        return (inside + float(self.held_out.sum())) / 2 + 2 * TEMPERATURE * self._strange()

    def _strange(self) -> float:
        """How unusual its effects are: minus the logarithm of how often they are seen."""
        own = {name for hypothesis in self.hypotheses for name in hypothesis.magnitudes}
        free = np.array([name in own for name in self.fit.names], dtype=bool)
        sizes = float(np.log1p((self.fit.at[free] / USUAL) ** 4).sum())
        return sizes + sum(TERMS[hypothesis.effect].rarity for hypothesis in self.hypotheses)


@dataclass(frozen=True, eq=False)
class Round:
    """One effect's choice.

    Attributes:
      before: the model it was added to.
      ranking: what the score test said, best first.
      finalists: the models refitted, best first: those that hold, then the others.
      holding: how many of them hold; with any, the first was added.
      again: whether an effect was compared with its rivals once more, beside what was found later;
        its ranking is that of before.
    """

    before: Model
    ranking: tuple[Score, ...]
    finalists: tuple[Model, ...]
    holding: int
    again: bool = False

    @property
    def accepted(self) -> bool:
        """Whether an effect was added."""
        return self.holding > 0

    @property
    def chosen(self) -> Hypothesis:
        """The effect that was found best."""
        return self.finalists[0].hypotheses[-1]

    @property
    def settled(self) -> bool:
        """Whether what was added is still the best of what holds, whatever noise weighs by."""
        return self.finalists[0].worth <= min(m.worth for m in self.finalists[: self.holding])


def chosen_in(rounds: Sequence[Round], key: tuple[str, Place]) -> Round:
    """The last of the rounds that chose an effect: by then more of the others was known."""
    return last_rounds(rounds)[key]


def last_rounds(rounds: Sequence[Round]) -> dict[tuple[str, Place], Round]:
    """Of each effect that was chosen, the last of its rounds."""
    return {r.chosen.key: r for r in rounds if r.accepted}
