"""Other ways to say what a model says, tried when all of it is known."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from pup.diagnosis.fitting import Fit
from pup.diagnosis.gains import joints_at
from pup.diagnosis.hypotheses import Hypothesis
from pup.diagnosis.models import Model, Round
from pup.diagnosis.starts import joined, less, spread
from pup.robot import RobotDescription

RIVALS = 2
"""Rivals that each effect may be exchanged for."""


@dataclass(frozen=True, eq=False)
class Exchange:
    """A model with an effect in place of others.

    Attributes:
      hypotheses: its effects, the new one last.
      given_up: those that it replaces.
      round: in which the first of those was chosen.
      fit: where its fit starts.
    """

    hypotheses: tuple[Hypothesis, ...]
    given_up: tuple[Hypothesis, ...]
    round: Round
    fit: Fit


def rivalled(model: Model, rounds: Sequence[Round]) -> Iterator[Exchange]:
    """Each effect but the newest in exchange for rivals of its own round."""
    known = {h.key for h in model.hypotheses}
    for hypothesis in model.hypotheses[:-1]:
        chosen = _round_of(hypothesis, rounds)
        if chosen is None:
            continue
        others = tuple(h for h in model.hypotheses if h is not hypothesis)
        rivals = [m for m in chosen.finalists[1:] if m.hypotheses[-1].key not in known]
        for rival in rivals[:RIVALS]:
            new = rival.hypotheses[-1]
            fit = joined(less(model.fit, [hypothesis]), rival.fit, new)
            yield Exchange((*others, new), (hypothesis,), chosen, fit)


def widened(
    model: Model,
    rounds: Sequence[Round],
    known: Sequence[Hypothesis],
    robot: RobotDescription,
) -> Iterator[Exchange]:
    """Effects that were found at several places, one after the other, as one at all of them.

    What all servos have is found at the joints that show it best, and there alone, where a place
    more says little more.

    Args:
      model: with effects.
      rounds: in which they were chosen.
      known: all hypotheses, for the places that there are.
      robot: the robot.
    """
    for effect in dict.fromkeys(h.effect for h in model.hypotheses):
        same = tuple(h for h in model.hypotheses if h.effect == effect)
        chosen = _round_of(same[0], rounds)
        if len(same) < 2 or chosen is None:
            continue
        joints = sum(joints_at(h.place, robot) for h in same) > 0
        others = tuple(h for h in model.hypotheses if h not in same)
        wider = {
            h.place: h
            for h in known
            if h.effect == effect
            and h.choices == same[0].choices
            and joints_at(h.place, robot)[joints].all()
        }
        for whole in wider.values():
            yield Exchange((*others, whole), same, chosen, spread(model.fit, same, whole))


def _round_of(hypothesis: Hypothesis, rounds: Sequence[Round]) -> Round | None:
    """The last round that chose an effect."""
    chosen = [r for r in rounds if r.accepted and r.chosen.key == hypothesis.key]
    return chosen[-1] if chosen else None
