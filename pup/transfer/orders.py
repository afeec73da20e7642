"""What an operator may want of a study; each order given twice is one."""

from dataclasses import replace

from pup.transfer.study import Study, StudyState
from pup.transfer.trial import HANDED_OUT, TOLD, Purpose, Trial, TrialError, TrialState

HOPELESS = 3
"""Trials in a row of which none walked, after which an infeasible one pauses a study."""


def release(study: Study, number: int) -> Study:
    """Let a trial pass the gate."""
    return study.with_trial(study.trial(number).release())


def retry(study: Study, number: int, attempt: int) -> Study:
    """Run an aborted or lost trial again; a study that paused for it goes on."""
    _not_done(study)
    trial = study.trial(number)
    if study.open and study.open != trial:
        raise TrialError(f"trial {study.open.id} is under way; wait for it or cancel it first")
    retried = trial.retry(attempt)
    if retried == trial:
        return study
    return replace(study, state=StudyState.ACTIVE, reason="").with_trial(retried)


def void(study: Study, number: int, reason: str) -> Study:
    """Let a walk not count after all; it may be retried, also in a study that was done.

    An eta that was chosen by it is not chosen any more: the choice follows the last walk at once,
    and a slip is seen later than that.

    Raises:
      TrialError: it has no result.
    """
    trial = study.trial(number)
    voided = trial.void(reason)
    if voided == trial:
        return study
    if study.chosen is not None and trial in study.searched:
        study = _search_again(study)
    opened = replace(study, state=StudyState.ACTIVE)
    return pause(opened.with_trial(voided), f"trial {number}: {reason}")


def pause(study: Study, reason: str) -> Study:
    """Make no more trials and hand none out; the one that an agent has ends as it may."""
    _not_done(study)
    return replace(study, state=StudyState.PAUSED, reason=reason)


def resume(study: Study) -> Study:
    """Make trials again."""
    _not_done(study)
    return replace(study, state=StudyState.ACTIVE, reason="")


def cancel(study: Study, number: int, reason: str) -> Study:
    """Take a trial back that nobody has, or have its agent end it; make no more after it."""
    trial = study.trial(number)
    requested = trial.state is TrialState.REQUESTED
    trial = trial.withdraw(reason) if requested else trial.recall()
    return pause(study.with_trial(trial), f"trial {number}: {reason}")


def halt(study: Study, agent: str, reason: str) -> Study:
    """A robot was stopped: have it end its trial, and make none for it."""
    if study.state is StudyState.DONE:
        return study
    if study.open and study.open.agent == agent and study.open.state in HANDED_OUT:
        return cancel(study, study.open.number, reason)
    waits = study.agent == agent and study.state is StudyState.ACTIVE
    return pause(study, reason) if waits else study


def after_end(study: Study, last: Trial) -> Study:
    """Pause a study whose trials keep giving no result, or whose retried trial gave none.

    So is one whose etas all make the policy ask for what no robot can do.

    Args:
      study: with the trial.
      last: that has just ended.
    """
    hopeless = last.state is TrialState.INFEASIBLE and study.infeasible() >= HOPELESS
    if hopeless and study.state is StudyState.ACTIVE:
        told = f"no robot could do what the last {study.infeasible()} trials asked for"
        return pause(study, f"{told}; is the policy whole? Resume to go on")
    active = study.state is StudyState.ACTIVE and last.state not in TOLD
    again = last.attempt > 1 and last.number < len(study.trials)
    if not active or (study.failures() < study.settings.failures and not again):
        return study
    why = last.result.reason if last.result else "nothing was heard of it"
    told = f"trial {last.number} was {last.state} ({why}); retry it, or resume without it"
    return replace(study, state=StudyState.PAUSED, reason=told)


def _search_again(study: Study) -> Study:
    """Forget the choice; a walk that it asked for and that no agent has is taken back."""
    study, asked = replace(study, chosen=None), study.open
    if asked is None or asked.purpose not in (Purpose.REPEAT, Purpose.COMPARE):
        return study
    if asked.state is not TrialState.REQUESTED:
        return study
    return study.with_trial(asked.withdraw("eta is chosen anew"))


def _not_done(study: Study) -> None:
    if study.state is StudyState.DONE:
        raise TrialError(f"study {study.name} is done")
