"""What a study needs next: another eta, the choice, another walk, or nothing."""

from dataclasses import dataclass

from pup.transfer.study import Study, StudyState
from pup.transfer.trial import Eta, Purpose


@dataclass(frozen=True)
class Wait:
    """Nothing is to be done: a trial is under way, or the study does not make any."""


@dataclass(frozen=True)
class Suggest:
    """The search needs another eta, if one is worth a walk."""


@dataclass(frozen=True)
class Choose:
    """The search is over: choose eta."""


@dataclass(frozen=True)
class Walk:
    """An eta that is known needs another walk."""

    eta: Eta
    purpose: Purpose


@dataclass(frozen=True)
class Finish:
    """All is done."""


Step = Wait | Suggest | Choose | Walk | Finish


def next_step(study: Study) -> Step:
    """What a study needs next.

    First the search, then the choice, then walks of the chosen eta and of those to compare, in
    turn, so that a robot that wears or warms treats all alike.
    """
    if study.state is not StudyState.ACTIVE or study.open:
        return Wait()
    settings = study.settings
    if study.chosen is None:
        return Suggest() if len(study.searched) < settings.trials else Choose()
    rivals = [(study.chosen, Purpose.REPEAT)]
    rivals += [(eta, Purpose.COMPARE) for eta in settings.compare]
    walked = [sum(1 for t in study.told if (t.eta, t.purpose) == rival) for rival in rivals]
    fewest = min(range(len(rivals)), key=lambda i: walked[i])
    if walked[fewest] < settings.repeats:
        return Walk(*rivals[fewest])
    return Finish()
