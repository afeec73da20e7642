"""Which hypotheses the score test sends to be refitted."""

from collections.abc import Sequence

from pup.diagnosis.beginnings import SPARE, noise_like
from pup.diagnosis.evidence import Score
from pup.diagnosis.fit import Fit
from pup.diagnosis.hypotheses import EVERYWHERE, Hypothesis
from pup.diagnosis.residuals import Measured
from pup.physics.terms import Place

FINALISTS = 8
"""Hypotheses refitted in each round, beside those of the best one's class."""
FURTHER, FAINT = 24, 0.01
"""As many are, and for so much less promise, where all that was tried leaves many times the noise:
so far off slopes say little. A friction that all but held its joint was the ninth, one that acts
one way only the thirteenth (docs/results/diagnosis.md)."""
WORTH = 0.1
"""A finalist promises at least this share of what the best one does."""
IN_CONTACT = frozenset(("ground", "foot", "sensor"))
"""Kinds of places where slopes say little: impacts come early or late, and a nominal fit that lacks
a soft floor has led everything else astray."""

GROUNDED = 4.0
"""Contact is suspected where motions on the ground are so many times as far off as those in the
air: 9 times or more where it was (docs/results/diagnosis.md)."""


def in_contact(hypothesis: Hypothesis) -> bool:
    """Whether an effect is one of contact, which is looked at by a fit, whatever its score."""
    return hypothesis.place.kind in IN_CONTACT


def suspected(fit: Fit, measured: Measured) -> bool:
    """Whether contact may be what a fit lacks: motions in the air, if any, are followed better.

    What is off in the air as well is something else, which is looked for first.
    """
    assert fit.residual is not None
    ground = measured.grounded
    if noise_like(fit) or not ground.any():
        return False
    squares = fit.residual**2 - 1
    air = float(squares[~ground].mean()) if not ground.all() else 0.0
    return float(squares[ground].mean()) > GROUNDED * max(air, SPARE)


def shortlist(
    ranking: Sequence[Score],
    enough: float,
    contact: bool = False,
    most: int = FINALISTS,
    worth: float = WORTH,
) -> list[Score]:
    """The best score of each effect and place, as long as it promises enough.

    Forms that no refit leads from one to the other are all looked at, and so are effects of the
    best one's class where it acts: a nominal fit may have made up for one of them to first order,
    as damping does for a lag, so that its slope says nothing. What one group shows, all servos may
    have: it is looked at everywhere too.

    Args:
      ranking: all scores, best first.
      enough: surprise that chance does not reach.
      contact: whether all effects of contact are looked at too.
      most: hypotheses that are looked at, beside those of the best one's class.
      worth: what they promise at least, as a share of what the best one does.
    """
    least = max(enough, worth * ranking[0].surprise)
    best: dict[tuple[tuple[str, Place], tuple[float, ...]], Score] = {}
    for score in ranking:
        hypothesis = score.trace.hypothesis
        known = {key for key, _ in best}
        room = hypothesis.key in known or len(known) < most
        if score.surprise >= least and room:
            best.setdefault(hypothesis.variant, score)
    shared = {effect for (effect, place), _ in best if place.kind == "group"}
    first = ranking[0].trace.hypothesis
    for score in ranking:
        other = score.trace.hypothesis
        spread = other.place.kind in EVERYWHERE and other.effect in shared
        alike = other.sibling_of(first) or spread
        if alike or (contact and in_contact(other)):
            best.setdefault(other.variant, score)
    return list(best.values())


def untried(ranking: Sequence[Score], chosen: Sequence[Score]) -> list[Score]:
    """The best score of each effect, place and form that is not among those chosen."""
    known = {score.trace.hypothesis.variant for score in chosen}
    best: dict[object, Score] = {}
    for score in ranking:
        best.setdefault(score.trace.hypothesis.variant, score)
    return [score for variant, score in best.items() if variant not in known]
