"""Trials whose agent is silent, and results that come after their lease."""

import asyncio
import sqlite3
from contextlib import closing
from dataclasses import asdict, replace
from functools import partial

import pytest

pytest.importorskip("fastapi")
pytest.importorskip("botorch")

from sqlalchemy.exc import OperationalError
from test_gateway_recovery import POLICY, SETTINGS, InProcess

from pup.transfer import orders
from pup.transfer.study import Gate, StudySettings
from pup.wire import Accepted, AgentState, Assign, Finished, Heartbeat, Hello, Outcome, Policy
from services.gateway.agents import AgentView
from services.gateway.conductor import Conductor
from services.gateway.metrics import Metrics
from services.gateway.store import Store


@pytest.fixture(autouse=True)
def quiet(monkeypatch):
    """Looks are made by the tests alone."""
    monkeypatch.setattr(Conductor, "_go_on", lambda self, name: None)


async def handed_out(database):
    """A conductor whose first trial an agent has, what it was sent, and the assignment."""
    store = Store(database)
    conductor = Conductor(store, InProcess(), Metrics())
    sent = []
    conductor.courier.send = lambda agent, body: sent.append(body)
    view = conductor.agents["darwin-1"] = AgentView("darwin-1")
    view.greet(Hello("darwin-1", "darwin_op2", "1", (Policy("walk", POLICY),)))
    view.beat(Heartbeat("darwin-1", AgentState.ENABLED))
    view.heard = asyncio.get_running_loop().time()
    settings = StudySettings(**asdict(SETTINGS) | {"lease": 1.0, "failures": 1, "gate": Gate.AUTO})
    await conductor.create("s", settings, None, "test")
    await conductor._look("s")
    await conductor._look("s")
    (assign,) = [b for b in sent if isinstance(b, Assign)]
    return conductor, sent, assign


def succeeded(assign):
    return Finished(assign.trial, assign.attempt, assign.fence, Outcome.SUCCEEDED, 0.9, 1.0)


async def lost(conductor):
    conductor._heard["s"] -= 2.0
    await conductor._look("s")
    study = conductor.studies["s"]
    assert study.trial(1).state == "lost" and study.state == "paused"


@pytest.mark.parametrize("resumed", [False, True])
def test_the_result_of_a_silent_agent_counts_when_it_comes(tmp_path, resumed):
    """Whether the study has gone on without it or waits."""

    async def live():
        conductor, sent, assign = await handed_out(f"sqlite:///{tmp_path / 'silent.db'}")
        await lost(conductor)
        await conductor.reported("darwin-1", Accepted(assign.trial, 1, assign.fence))
        assert sent[-1].trial == assign.trial and type(sent[-1]).__name__ == "Cancel"
        if resumed:
            await conductor.go_on("s", "test", orders.resume, "resumed")
            await conductor._look("s")
        state = conductor.studies["s"].state
        assert await conductor.finished("darwin-1", succeeded(assign)) == "counted"
        assert await conductor.finished("darwin-1", succeeded(assign)) == "repeated"
        study = conductor.studies["s"]
        assert [t.number for t in study.told] == [1] and study.state == state
        ((read, _),) = await conductor.store.studies()
        assert read == study
        conductor.store.close()

    asyncio.run(live())


def test_that_it_failed_pauses_a_study_but_once(tmp_path):
    async def live():
        conductor, _, assign = await handed_out(f"sqlite:///{tmp_path / 'failed.db'}")
        await lost(conductor)
        await conductor.go_on("s", "test", orders.resume, "resumed")
        ended = replace(succeeded(assign), state=Outcome.ABORTED, distance=None)
        assert await conductor.finished("darwin-1", ended) == "counted"
        study = conductor.studies["s"]
        assert study.trial(1).state == "aborted" and study.state == "active"
        conductor.store.close()

    asyncio.run(live())


def test_a_late_result_of_a_trial_that_is_retried_never_counts(tmp_path):
    async def live():
        conductor, _, assign = await handed_out(f"sqlite:///{tmp_path / 'late.db'}")
        await lost(conductor)
        await conductor.go_on("s", "test", partial(orders.retry, number=1, attempt=2), "retried")
        for _ in range(2):
            assert await conductor.finished("darwin-1", succeeded(assign)) == "late"
        assert not conductor.studies["s"].told
        events = await conductor.store.events("s", 0, 100)
        assert [e["detail"]["distance"] for e in events if e["kind"] == "late"] == [0.9] * 2
        stranger = Finished("nobody/7", 1, 1, Outcome.SUCCEEDED, 0.9, 1.0)
        assert await conductor.finished("darwin-1", stranger) == "unknown"
        conductor.store.close()

    asyncio.run(live())


def test_a_walk_whose_end_is_being_told_is_not_lost(tmp_path):
    """The database takes nothing for longer than the lease: the agent tells it again and again."""

    async def live():
        file = tmp_path / "locked.db"
        conductor, _, assign = await handed_out(f"sqlite:///{file}")
        await conductor.store.run(lambda c: c.exec_driver_sql("PRAGMA busy_timeout=50"))
        conductor._heard["s"] -= 2.0
        with closing(sqlite3.connect(file, isolation_level=None)) as other:
            other.execute("BEGIN IMMEDIATE")
            with pytest.raises(OperationalError):
                await conductor.finished("darwin-1", succeeded(assign))
            other.execute("ROLLBACK")
        await conductor._look("s")
        assert conductor.studies["s"].trial(1).state == "assigned"
        assert await conductor.finished("darwin-1", succeeded(assign)) == "counted"
        conductor.store.close()

    asyncio.run(live())
