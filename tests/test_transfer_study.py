"""Trials and studies: what may follow what, under any order of reports, repeats and losses."""

import itertools
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pup.errors import InputError
from pup.transfer import orders
from pup.transfer.steps import Choose, Finish, Suggest, Wait, Walk, next_step
from pup.transfer.study import Study, StudySettings, StudyState
from pup.transfer.trial import (
    HANDED_OUT,
    OPEN,
    TOLD,
    Purpose,
    Result,
    Ticket,
    Trial,
    TrialError,
    TrialState,
    Verdict,
)

S = TrialState
SETTINGS = StudySettings(robot="darwin_op2", policy="0" * 64)
AFTER = {
    S.REQUESTED: {S.ASSIGNED, S.ABORTED},
    S.ASSIGNED: {S.ARMED, S.RUNNING, S.SUCCEEDED, S.ABORTED, S.INFEASIBLE, S.LOST},
    S.ARMED: {S.RUNNING, S.SUCCEEDED, S.ABORTED, S.INFEASIBLE, S.LOST},
    S.RUNNING: {S.SUCCEEDED, S.ABORTED, S.INFEASIBLE, S.LOST},
    S.ABORTED: {S.REQUESTED},
    S.LOST: {S.REQUESTED, S.SUCCEEDED, S.ABORTED, S.INFEASIBLE},  # a result that comes late
    S.SUCCEEDED: {S.ABORTED},  # made void
    S.INFEASIBLE: {S.ABORTED},
}
"""What may follow a state; reports may have been lost in between."""


def fresh(number=1):
    return Trial("s", number, (0.0, 0.0, 0.0), Purpose.SEARCH)


tickets = st.builds(
    Ticket, st.integers(1, 3), st.integers(0, 4), st.sampled_from(["darwin-1", "darwin-2"])
)
results = st.builds(
    Result,
    st.sampled_from([S.SUCCEEDED, S.ABORTED, S.INFEASIBLE]),
    st.none() | st.floats(-1, 2),
    st.none() | st.floats(0, 15),
)
events = st.one_of(
    st.tuples(st.just("release")),
    st.tuples(st.just("assign"), st.sampled_from(["darwin-1", "darwin-2"]), st.integers(0, 6)),
    st.tuples(st.just("report"), tickets, st.sampled_from([S.ARMED, S.RUNNING])),
    st.tuples(st.just("finish"), tickets, results, st.just(15.0)),
    st.tuples(st.just("void"), st.sampled_from(["mistyped", "held"])),
    st.tuples(st.just("expire")),
    st.tuples(st.just("withdraw"), st.just("")),
    st.tuples(st.just("retry"), st.integers(1, 4)),
)


@given(st.lists(events, max_size=60))
def test_no_history_breaks_a_rule(history):
    trial, counted, fences = fresh(), [], [0]
    for name, *given_ in history:
        before = trial
        try:
            changed = getattr(trial, name)(*given_)
        except TrialError:
            continue
        trial, verdict = changed if isinstance(changed, tuple) else (changed, None)
        if verdict not in (None, Verdict.COUNTED):
            assert trial == before, "only what counts changes a trial"
        if trial.state is not before.state:
            assert trial.state in AFTER[before.state]
            assert before.state not in TOLD or name == "void", "only an operator makes void"
        if name == "assign":
            assert trial.fence > max(fences), "a fence only grows"
            fences.append(trial.fence)
        if name == "finish" and verdict is Verdict.COUNTED:
            ticket = given_[0]
            assert before.state in (*HANDED_OUT, S.LOST)
            assert ticket == Ticket(before.attempt, before.fence, before.agent)
            counted.append((trial.attempt, trial.fence))
        assert trial.attempt == before.attempt or name == "retry", "only an operator retries"
        assert trial.result is None or trial.state not in OPEN
        if trial.state in TOLD and trial.state is S.SUCCEEDED:
            assert trial.result.distance is not None
    assert len(counted) == len(set(counted)), "no handing-out counts twice"


def handed_out(fence=3):
    return fresh().release().assign("darwin-1", fence), Ticket(1, fence, "darwin-1")


@given(st.permutations([S.ARMED, S.RUNNING, S.ARMED, S.RUNNING]))
def test_reports_in_any_order_lead_to_running(order):
    trial, ticket = handed_out()
    for state in order:
        trial, _ = trial.report(ticket, state)
    assert trial.state is S.RUNNING


def test_a_result_counts_once_and_the_first_one():
    trial, ticket = handed_out()
    trial, verdict = trial.finish(ticket, Result(S.SUCCEEDED, 0.7), 15.0)
    assert verdict is Verdict.COUNTED
    again, verdict = trial.finish(ticket, Result(S.SUCCEEDED, 0.1), 15.0)
    assert verdict is Verdict.REPEATED and again == trial and trial.result.distance == 0.7


def test_a_walk_that_was_cancelled_does_not_count():
    """It had ended before its robot heard of it; whoever cancelled it had a reason."""
    trial, ticket = handed_out()
    ended, verdict = trial.recall().finish(ticket, Result(S.SUCCEEDED, 0.7, 15.0), 15.0)
    assert verdict is Verdict.COUNTED
    assert ended.state is S.ABORTED and ended.result.reason == "cancelled"
    fallen, _ = trial.recall().finish(ticket, Result(S.INFEASIBLE, reason="bad target"), 15.0)
    assert fallen.state is S.INFEASIBLE


def test_a_result_after_the_lease_counts_once_while_nobody_has_it_retried():
    """The walk was as good as any; a retry has another attempt, so nothing can count twice."""
    trial, ticket = handed_out()
    trial = trial.expire()
    assert trial.report(ticket, S.RUNNING) == (trial, Verdict.LATE)
    after, verdict = trial.finish(ticket, Result(S.SUCCEEDED, 0.7), 15.0)
    assert verdict is Verdict.COUNTED and after.state is S.SUCCEEDED
    assert after.finish(ticket, Result(S.SUCCEEDED, 0.7), 15.0) == (after, Verdict.REPEATED)
    with pytest.raises(TrialError, match="only aborted or lost"):
        after.retry(2)


def test_a_result_of_an_earlier_attempt_is_late_whatever_the_newer_one_does():
    trial, ticket = handed_out()
    trial = trial.expire().retry(2)
    for now in (trial, trial.assign("darwin-2", 4)):
        after, verdict = now.finish(ticket, Result(S.SUCCEEDED, 0.7), 15.0)
        assert verdict is Verdict.LATE and after == now


@pytest.mark.parametrize(
    "ticket", [Ticket(1, 3, "darwin-2"), Ticket(2, 3, "darwin-1"), Ticket(1, 9, "darwin-1")]
)
def test_results_of_what_was_never_handed_out_are_unknown(ticket):
    trial, _ = handed_out()
    assert trial.finish(ticket, Result(S.SUCCEEDED, 0.7), 15.0) == (trial, Verdict.UNKNOWN)


@pytest.mark.parametrize("distance", [None, 312.0, -1e300, float("nan")])  # 3.12 m in cm
def test_a_success_without_a_distance_that_can_be_is_no_data_point(distance):
    trial, ticket = handed_out()
    trial, _ = trial.finish(ticket, Result(S.SUCCEEDED, distance), 15.0)
    assert trial.state is S.ABORTED and "distance" in trial.result.reason


def test_a_distance_is_believed_for_the_time_that_was_walked():
    """30 cm typed as 30, for a fall after 1.2 s, must not win the study."""
    trial, ticket = handed_out()
    typed, _ = trial.finish(ticket, Result(S.SUCCEEDED, 30.0, 1.2), 15.0)
    assert typed.state is S.ABORTED and "30.0 m in 1.2 s" in typed.result.reason
    for distance, seconds in ((30.0, 15.0), (10.9, 1.2), (30.0, None)):
        walked, _ = trial.finish(ticket, Result(S.SUCCEEDED, distance, seconds), 15.0)
        assert walked.state is S.SUCCEEDED
    over, _ = trial.finish(ticket, Result(S.SUCCEEDED, 76.0, 1000.0), 15.0)
    assert over.state is S.ABORTED, "no walk is longer than the horizon"


def test_an_operator_retries_once_however_often_asked():
    trial = handed_out()[0].expire()
    assert trial.retry(2) == trial.retry(2).retry(2)
    with pytest.raises(TrialError, match="next is 2"):
        trial.retry(3)
    with pytest.raises(TrialError, match="only aborted or lost"):
        handed_out()[0].retry(2)


def test_the_gate_holds():
    with pytest.raises(TrialError):
        fresh().assign("darwin-1", 1)
    with pytest.raises(TrialError, match="must exceed"):
        handed_out()[0].expire().retry(2).assign("darwin-1", 3)


def play(settings, outcomes):
    """A study from start to end, with given outcomes of its walks in a row."""
    study, fence, made = Study("s", settings), 0, []
    outcomes = iter(outcomes)
    for _ in range(1000):
        match next_step(study):
            case Suggest():
                initial = len(study.searched) < settings.initial
                purpose = Purpose.INITIAL if initial else Purpose.SEARCH
                eta = (float(len(study.trials)),) * 3
            case Choose():
                study = Study(
                    "s", settings, fence=fence, chosen=study.searched[0].eta, trials=study.trials
                )
                continue
            case Walk(eta, purpose):
                pass
            case Finish():
                return study, made
            case Wait():
                raise AssertionError("a study waits for nothing")
        fence += 1
        trial = Trial("s", len(study.trials) + 1, eta, purpose).release().assign("a", fence)
        study = study.with_trial(trial)
        assert isinstance(next_step(study), Wait), "one trial at a time"
        trial, _ = trial.finish(Ticket(1, fence, "a"), next(outcomes), 15.0)
        study = study.with_trial(trial)
        made.append(trial)
    raise AssertionError("a study does not end")


@given(
    st.integers(1, 8),
    st.integers(0, 3),
    st.lists(st.sampled_from([S.SUCCEEDED, S.ABORTED, S.INFEASIBLE]), max_size=12),
)
def test_a_study_ends_with_as_many_walks_as_were_asked_for(trials, repeats, bad):
    settings = StudySettings(
        "r", "p", trials=trials, initial=1, repeats=repeats, compare=((0.5, 0.5, 0.5),)
    )
    outcomes = itertools.chain(
        (Result(s, 0.1) for s in bad), itertools.repeat(Result(S.SUCCEEDED, 1.0))
    )
    study, made = play(settings, outcomes)
    assert len(study.searched) == trials
    count = {p: sum(t.purpose is p and t.state in TOLD for t in made) for p in Purpose}
    assert count[Purpose.REPEAT] == count[Purpose.COMPARE] == repeats


def test_an_eta_that_was_chosen_early_ends_the_search():
    settings = StudySettings("r", "p", trials=25, least_gain=0.01, repeats=2)
    study = Study("s", settings, chosen=(0.0,) * 3)
    assert next_step(study) == Walk((0.0,) * 3, Purpose.REPEAT)
    for least in (-0.1, 1.0, float("nan")):
        with pytest.raises(InputError, match="least_gain"):
            StudySettings("r", "p", least_gain=least)


def test_the_chosen_eta_and_its_rivals_take_turns():
    settings = StudySettings("r", "p", trials=1, initial=1, repeats=3, compare=((9.0,) * 3,))
    _, made = play(settings, itertools.repeat(Result(S.SUCCEEDED, 1.0)))
    assert [t.purpose for t in made[1:]] == [Purpose.REPEAT, Purpose.COMPARE] * 3


def test_a_pause_makes_no_trials():
    assert isinstance(next_step(Study("s", SETTINGS, state=StudyState.PAUSED)), Wait)


def walked(*states: S) -> Study:
    study = Study("s", SETTINGS)
    for number, state in enumerate(states, 1):
        trial = fresh(number).release().assign("a", number)
        trial, _ = trial.finish(Ticket(1, number, "a"), Result(state, 1.0), 15.0)
        study = orders.after_end(study.with_trial(trial), trial)
    return study


def test_failures_in_a_row_are_counted():
    assert walked(S.SUCCEEDED, S.ABORTED, S.ABORTED).failures() == 2


def test_a_retried_trial_that_fails_again_pauses_its_study():
    """Though others have succeeded since."""
    study = walked(S.ABORTED, S.SUCCEEDED, S.SUCCEEDED)
    assert study.failures() == 0
    study = orders.retry(study, 1, 2)
    trial = study.trial(1).assign("a", 9)
    trial, _ = trial.finish(Ticket(2, 9, "a"), Result(S.ABORTED, reason="fell asleep"), 15.0)
    study = orders.after_end(study.with_trial(trial), trial)
    assert study.state is StudyState.PAUSED and "trial 1 was aborted" in study.reason


def test_a_walk_that_shall_not_count_is_void_until_an_eta_was_chosen_by_it():
    study = walked(S.SUCCEEDED, S.SUCCEEDED)
    void = orders.void(study, 1, "the tape was read wrongly")
    assert void.state is StudyState.PAUSED and [t.number for t in void.told] == [2]
    assert orders.void(orders.resume(void), 1, "the tape was read wrongly") == orders.resume(void)
    again = orders.retry(void, 1, 2)
    assert again.trial(1).attempt == 2 and again.state is StudyState.ACTIVE
    with pytest.raises(TrialError, match="nothing to make void"):
        orders.void(again, 1, "once more")


@pytest.mark.parametrize("state", [StudyState.ACTIVE, StudyState.DONE])
def test_a_slip_that_is_seen_after_the_choice_costs_the_choice_alone(state):
    """The choice follows the last walk within a second; with no repeats the study's end does."""
    study = replace(walked(*[S.SUCCEEDED] * 25), chosen=(0.0,) * 3, state=state)
    asked = Trial("s", 26, study.chosen, Purpose.REPEAT)
    void = orders.void(study.with_trial(asked), 25, "30 for 0.3")
    assert void.chosen is None and void.state is StudyState.PAUSED and "30 for 0.3" in void.reason
    assert [t.number for t in void.told] == list(range(1, 25)), "the others count"
    assert void.open is None and "anew" in void.trial(26).result.reason
    assert isinstance(next_step(orders.resume(void)), Suggest)
    again = orders.retry(void, 25, 2)
    trial, _ = (
        again.trial(25).assign("a", 99).finish(Ticket(2, 99, "a"), Result(S.SUCCEEDED, 0.3), 15.0)
    )
    assert isinstance(next_step(again.with_trial(trial)), Choose)


def test_a_walk_after_the_choice_is_made_void_without_another_choice():
    study = replace(walked(*[S.SUCCEEDED] * 25), chosen=(0.0,) * 3)
    for agent, purpose in (("a", Purpose.REPEAT), (None, Purpose.COMPARE)):
        trial = Trial("s", len(study.trials) + 1, study.chosen, purpose).release()
        study = study.with_trial(trial.assign("a", 90) if agent else trial)
        if agent:
            trial, _ = study.trial(26).finish(Ticket(1, 90, "a"), Result(S.SUCCEEDED, 9.0), 15.0)
            study = study.with_trial(trial)
    void = orders.void(study, 26, "mistyped")
    assert void.chosen == study.chosen and void.open == study.open
    handed = study.with_trial(study.trial(27).assign("a", 91))
    assert orders.void(handed, 25, "mistyped").open == handed.open, "an agent has it"


def test_who_began_a_study_goes_on_with_it():
    """Walks of two robots in one process would tell of neither."""
    study = Study("s", SETTINGS)
    assert study.agent is None
    trial = fresh().release().assign("a", 1)
    moved, _ = trial.finish(Ticket(1, 1, "a"), Result(S.ABORTED, None, 3.0, "tripped"), 15.0)
    stood, _ = trial.finish(Ticket(1, 1, "a"), Result(S.ABORTED, reason="too warm"), 15.0)
    for told, agent in ((trial, "a"), (moved, "a"), (trial.expire(), "a"), (stood, None)):
        assert study.with_trial(told).agent == agent
        if told is not trial:
            retried = orders.retry(study.with_trial(told), 1, 2)
            assert retried.agent == agent
            ticket = Ticket(2, 1, "a")
            assert retried.trial(1).finish(ticket, Result(S.ABORTED), 15.0)[1] is Verdict.UNKNOWN
    assert replace(study, settings=replace(SETTINGS, agent="b")).with_trial(moved).agent == "b"


def test_a_stop_pauses_the_study_that_its_robot_has_begun():
    study = walked(S.SUCCEEDED)
    assert orders.halt(study, "a", "smoke").state is StudyState.PAUSED
    assert orders.halt(study, "b", "smoke") == study


def test_a_study_that_no_robot_can_walk_pauses():
    assert walked(S.INFEASIBLE, S.INFEASIBLE).state is StudyState.ACTIVE
    study = walked(S.INFEASIBLE, S.INFEASIBLE, S.INFEASIBLE)
    assert study.state is StudyState.PAUSED and "the last 3 trials" in study.reason
    assert walked(S.INFEASIBLE, S.SUCCEEDED, S.INFEASIBLE).state is StudyState.ACTIVE


@pytest.mark.parametrize(
    "wrong",
    [
        {"lower": (0.0,), "upper": (1.0, 1.0)},
        {"lower": (1.0,) * 3},
        {"lower": (float("nan"),) * 3},
        {"upper": (float("inf"),) * 3},
        {"compare": ((0.0,),)},
        {"compare": ((0.0, 0.0, float("nan")),)},
        {"initial": 0},
        {"trials": 0},
        {"trials": 4},
        {"trials": 7, "initial": 8},
    ],
)
def test_wrong_settings_are_refused(wrong):
    with pytest.raises(InputError):
        StudySettings("r", "p", **wrong)
