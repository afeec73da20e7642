"""Distances that somebody types: in metres, of a walk that may have been over for a day."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from agents import bundle, standing, wait
from test_agent import assign, at_work
from test_agent_cancel import measuring as measuring
from test_agent_prompt import BY_HAND

from hardware_agent.conductor import Conductor, Stage
from hardware_agent.distance import check_typed
from pup.errors import InputError
from pup.recording import Recording
from pup.wire import Body, Cancel, Finished, Hello, Outcome, Running


@pytest.mark.parametrize("distance", [0.3, -0.2, 0.0, 15.0])
def test_what_a_robot_walks_is_believed(distance: float) -> None:
    check_typed(distance, walked=15.0, horizon=15.0, sure=False)


@pytest.mark.parametrize(
    ("distance", "walked"), [(30.0, 15.0), (-30.0, 15.0), (4.0, 2.0), (9.0, 1.0)]
)
def test_centimetres_are_asked_for_again_and_count_where_they_are_right(
    distance: float, walked: float
) -> None:
    with pytest.raises(InputError, match="is far: tell it in metres"):
        check_typed(distance, walked, horizon=15.0, sure=False)
    check_typed(distance, walked, horizon=15.0, sure=True)


@pytest.mark.parametrize(
    ("distance", "walked"), [(76.0, 15.0), (16.0, 2.0), (math.nan, 15.0), (-math.inf, 15.0)]
)
def test_what_cannot_be_never_counts(distance: float, walked: float) -> None:
    """The time that was walked counts, not the horizon."""
    with pytest.raises(InputError, match="cannot be"):
        check_typed(distance, walked, horizon=15.0, sure=True)


def test_who_tells_the_same_again_insists(measuring: tuple[Conductor, list[Body]]) -> None:
    conductor, told = measuring
    for doubted in (30.0, 40.0, 30.0):
        with pytest.raises(InputError, match="is far"):
            conductor.measured(doubted)
    conductor.measured(30.0)
    (ended,) = (body for body in told if isinstance(body, Finished))
    assert (ended.state, ended.distance) == (Outcome.SUCCEEDED, 30.0)


def test_who_was_asked_again_may_tell_another(measuring: tuple[Conductor, list[Body]]) -> None:
    conductor, told = measuring
    with pytest.raises(InputError, match="is far"):
        conductor.measured(30.0)
    conductor.measured(0.3)
    (ended,) = (body for body in told if isinstance(body, Finished))
    assert ended.distance == 0.3


@contextmanager
def killed_before_its_distance(folder: Path) -> Iterator[tuple[Any, Any, str]]:
    """An agent that was killed as it waited for the distance of `a`, its gateway and the policy."""
    pytest.importorskip("mujoco")
    policy = bundle(folder / "policies" / "still", standing())
    more = BY_HAND.replace('gate = "operator"', 'gate = "auto"')
    with at_work(folder, more=more) as (made, gateway):
        gateway.send(assign(policy, "a"))
        wait(lambda: made.health()["waiting"] == "distance", 30, made.log)
        made.kill()
        yield made, gateway, policy


def test_a_distance_is_asked_for_again_after_the_agent_was_killed(tmp_path: Path) -> None:
    """Twice; what comes of it is the walk as it was, with its recording, walked once."""
    with killed_before_its_distance(tmp_path) as (made, gateway, policy):
        made.start()
        told = made.health()
        assert (told["trial"], told["stage"], told["waiting"]) == ("a", "measuring", "distance")
        gateway.send(assign(policy, "a"))
        made.kill()
        known = len(gateway.of(Hello))
        made.start()
        wait(lambda: len(gateway.of(Hello)) > known, 20, made.log)
        open_ = gateway.of(Hello)[known].journal
        assert [(e.trial, e.state) for e in open_] == [("a", "running")]
        with pytest.raises(InputError, match="is far"):
            made.say("distance", distance=1.5)
        made.say("distance", distance=0.15)
        wait(lambda: bool(gateway.of(Finished)), 20, made.log)
        (ended,) = set(gateway.of(Finished))
        assert (ended.state, ended.reason) == (Outcome.SUCCEEDED, "reached the horizon")
        assert ended.distance == 0.15
        file = tmp_path / "state" / "recordings" / f"{ended.recording}.parquet"
        assert Recording.read(file).time[-1] == pytest.approx(0.4, abs=1 / 33)
        assert ended.time == pytest.approx(0.4, abs=1 / 33)
        assert {r.trial for r in gateway.of(Running)} == {"a"}
        moved = (tmp_path / "state" / "journal").read_text().count('"running"')
        assert moved == 1, "it walked once"


def test_a_walk_that_waits_for_its_distance_can_be_taken_back_after_a_restart(
    tmp_path: Path,
) -> None:
    with killed_before_its_distance(tmp_path) as (made, gateway, _):
        known = len(gateway.of(Hello))
        made.start()
        wait(lambda: len(gateway.of(Hello)) > known, 20, made.log)
        gateway.send(Cancel("a", 1, 1))
        wait(lambda: bool(gateway.of(Finished)), 20, made.log)
        ended = gateway.of(Finished)[0]
        assert (ended.state, ended.reason) == (Outcome.ABORTED, "cancelled")
        assert ended.recording is not None
        assert made.health()["stage"] == Stage.NONE
