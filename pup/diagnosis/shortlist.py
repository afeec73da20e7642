"""Which hypotheses the score test sends to be refitted."""

from collections.abc import Sequence

from pup.diagnosis.evidence import Score
from pup.diagnosis.hypotheses import EVERYWHERE
from pup.physics.terms import Place

FINALISTS = 8
"""Hypotheses refitted in each round, beside those of the best one's class."""
WORTH = 0.1
"""A finalist promises at least this share of what the best one does."""


def shortlist(ranking: Sequence[Score], enough: float) -> list[Score]:
    """The best score of each effect and place, as long as it promises enough.

    Forms that no refit leads from one to the other are all looked at, and so are effects of the
    best one's class where it acts: a nominal fit may have made up for one of them to first order,
    as damping does for a lag, so that its slope says nothing. What one group shows, all servos may
    have: it is looked at everywhere too.
    """
    least = max(enough, WORTH * ranking[0].surprise)
    best: dict[tuple[tuple[str, Place], tuple[float, ...]], Score] = {}
    for score in ranking:
        hypothesis = score.trace.hypothesis
        known = {key for key, _ in best}
        room = hypothesis.key in known or len(known) < FINALISTS
        if score.surprise >= least and room:
            best.setdefault((hypothesis.key, hypothesis.choices), score)
    shared = {effect for (effect, place), _ in best if place.kind == "group"}
    first = ranking[0].trace.hypothesis
    for score in ranking:
        other = score.trace.hypothesis
        everywhere = other.place.kind in EVERYWHERE
        same = other.place == first.place or (everywhere and first.place.kind in EVERYWHERE)
        if (other.family == first.family and same) or (everywhere and other.effect in shared):
            best.setdefault((other.key, other.choices), score)
    return list(best.values())
