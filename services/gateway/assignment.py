"""Which agent may take a trial, what it is told, and which trial an agent speaks of."""

from collections.abc import Mapping

from pup.transfer.study import Study, StudyState
from pup.transfer.trial import HANDED_OUT, Trial, TrialState
from pup.wire import Assign
from services.gateway.agents import AgentView


def unfit(
    study: Study, studies: Mapping[str, Study], agents: Mapping[str, AgentView]
) -> dict[str, str | None]:
    """Why each agent that may take a study's trial cannot; None where it can.

    Where an agent has begun a trial of the study, or the study names one, it is that one alone.
    """
    trials = (s.open for s in studies.values())
    busy = {t.agent: t.id for t in trials if t and t.state in HANDED_OUT}
    settings, wanted = study.settings, study.agent
    told: dict[str, str | None] = {}
    for name in [wanted] if wanted else sorted(agents):
        view = agents.get(name)
        if view is None:
            told[name] = "is not connected"
        elif name in busy:
            told[name] = f"is at {busy[name]}"
        else:
            told[name] = view.can_run(settings.robot, settings.policy)
    return told


def waits_for(study: Study, studies: Mapping[str, Study], agents: Mapping[str, AgentView]) -> str:
    """What the open trial of a study waits for, in words; empty when for nothing."""
    trial = study.open
    if trial is None or trial.state is not TrialState.REQUESTED:
        return ""
    if not trial.released:
        return "an operator to release it"
    if study.state is StudyState.PAUSED:
        return "the study to be resumed"
    reasons = unfit(study, studies, agents)
    fit = [name for name, why in reasons.items() if why is None]
    told = "; ".join(f"{name} {why}" for name, why in reasons.items()) or "none is known"
    began = study.agent is not None and study.settings.agent is None
    return "" if fit else f"an agent: {told}{', and no other may go on' if began else ''}"


def assignment(study: Study, trial: Trial) -> Assign:
    """What an agent is told of a trial; a walk of an eta that was recorded repeats that one."""
    same = (t for t in study.told if t.eta == trial.eta and t.result and t.result.recording)
    first = next(same, None)
    repeat_of = first.result.recording if first and first.result else None
    settings = study.settings
    return Assign(
        study.name,
        trial.wire,
        trial.attempt,
        trial.fence,
        settings.policy,
        trial.eta,
        settings.horizon,
        repeat_of,
    )


def place_of(trial: str, studies: Mapping[str, Study]) -> tuple[str, int] | None:
    """The study and number that an id of a trial stands for; None where there is no such trial."""
    name, _, rest = trial.rpartition("/")
    number, _, mark = rest.partition(".")
    study = studies.get(name)
    if study is None or study.mark != mark:
        return None
    if not number.isascii() or not number.isdecimal() or len(number) > 9:
        return None
    return (name, int(number)) if 1 <= int(number) <= len(study.trials) else None
