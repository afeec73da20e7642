"""A gateway whose database was restored gives a trial a name that the agent's journal knows."""

from dataclasses import replace
from pathlib import Path

import pytest
from agents import bundle, standing, wait
from test_agent import assign as real
from test_agent import at_work
from test_agent_trials import FELL, assign, book

from hardware_agent.trials import NAMESAKE
from pup.wire import Accepted, Assign, Body, Finished, Outcome, Running

OTHERS = {
    "another eta": {"eta": (0.5, 0.5, 0.5)},
    "another policy": {"policy": "q" * 64},
    "another horizon": {"horizon": 5.0},
}


def refusal(trial: Assign) -> list[Body]:
    return [
        Finished(trial.trial, trial.attempt, trial.fence, Outcome.ABORTED, reason=NAMESAKE),
    ]


@pytest.mark.parametrize("changes", OTHERS.values(), ids=OTHERS)
@pytest.mark.parametrize("fence", [2, 5, 9], ids=["older", "same", "newer"])
def test_it_is_never_told_what_was_walked_for_another(
    tmp_path: Path, changes: dict[str, object], fence: int
) -> None:
    trials = book(tmp_path)
    trials.assigned(assign(fence=5))
    trials.begin(assign(fence=5))
    trials.finish(assign(fence=5), replace(FELL, distance=0.4))
    other = replace(assign(fence=fence), **changes)
    for again in (trials, book(tmp_path)):
        assert again.assigned(other) == refusal(other)
        assert again.current is None
    retry = replace(other, attempt=2)
    assert book(tmp_path).assigned(retry) == [Accepted("t", 2, fence)], "a retry really walks"


def test_one_that_walks_walks_on(tmp_path: Path) -> None:
    trials = book(tmp_path)
    trials.assigned(assign(fence=3))
    trials.begin(assign(fence=3))
    other = replace(assign(fence=4), horizon=5.0)
    assert trials.assigned(other) == refusal(other)
    told = trials.finish(assign(fence=3), replace(FELL, distance=0.4))
    assert (told.fence, told.distance) == (3, 0.4)


def test_one_that_has_not_moved_is_not_walked_for_nobody(tmp_path: Path) -> None:
    trials = book(tmp_path)
    trials.assigned(assign())
    other = replace(assign(), horizon=5.0)
    assert trials.assigned(other) == refusal(other)
    assert trials.current is None
    assert trials.assigned(assign("next")) == [Accepted("next", 1, 1)]


def test_an_attempt_before_those_of_another_is_answered_too(tmp_path: Path) -> None:
    """Or the gateway would wait until its lease runs out."""
    trials = book(tmp_path)
    trials.assigned(assign(attempt=2))
    trials.begin(assign(attempt=2))
    trials.finish(assign(attempt=2), replace(FELL, distance=0.4))
    other = replace(assign(), horizon=5.0)
    assert trials.assigned(other) == refusal(other)
    assert trials.assigned(assign()) == [], "a late message of the same one gets no answer"


def test_a_real_agent_walks_the_retry_and_not_the_namesake(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    policy = bundle(tmp_path / "policies" / "still", standing())
    with at_work(tmp_path) as (made, gateway):
        first = real(policy, "s/1.ab")
        assert gateway.run(first, told=made.log).state is Outcome.SUCCEEDED
        other = replace(first, fence=2, eta=(0.1, 0.1, 0.1))
        gateway.send(other)
        wait(lambda: gateway.of(Finished)[-1].fence == 2, 20, made.log)
        ended = gateway.of(Finished)[-1]
        assert (ended.state, ended.distance, ended.reason) == (Outcome.ABORTED, None, NAMESAKE)
        gateway.send(replace(other, attempt=2, fence=3))
        wait(lambda: gateway.of(Finished)[-1].fence == 3, 30, made.log)
        assert gateway.of(Finished)[-1].state is Outcome.SUCCEEDED
        assert [(r.attempt, r.fence) for r in gateway.of(Running)] == [(1, 1), (2, 3)]
