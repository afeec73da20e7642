"""A stop waits for nothing: what is beside it is held up, fails, or comes later."""

import asyncio
import sqlite3
import time
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import partial

import pytest

pytest.importorskip("fastapi")
pytest.importorskip("botorch")

from pup.transfer import orders
from pup.transfer.study import Gate, StudySettings
from pup.transfer.trial import TrialError
from pup.wire import AgentState, Assign, Heartbeat, Hello, Policy, Stop
from services.gateway.agents import AgentView
from services.gateway.conductor import Conductor
from services.gateway.metrics import Metrics
from services.gateway.stops import stop
from services.gateway.store import Store

POLICY = "a" * 64
SETTINGS = StudySettings("darwin_op2", POLICY, initial=2, gate=Gate.AUTO, agent="a")
ENABLED = Heartbeat("a", AgentState.ENABLED)
LIMP = Heartbeat("a", AgentState.STOPPED, {"limp": True})


class Slow:
    """Fits that take until somebody lets them end."""

    def __init__(self):
        self.begun, self.ready = asyncio.Event(), asyncio.Event()

    async def run(self, act, *args):
        self.begun.set()
        await self.ready.wait()
        return act(*args)


class Bench:
    """A conductor with a real store and one robot, which obeys or does not."""

    def __init__(self, folder):
        self.fits, self.sent, self.obeys = Slow(), [], True
        self.file = folder / "stops.db"
        self.conductor = Conductor(Store(f"sqlite:///{self.file}"), self.fits, Metrics())
        self.conductor.courier.send = self.send
        self.view = self.conductor.agents["a"] = AgentView("a")
        self.view.greet(Hello("a", "darwin_op2", "1", (Policy("walk", POLICY),)))
        self.beat(ENABLED)

    def send(self, agent, body):
        self.sent.append(body)
        if isinstance(body, Stop) and self.obeys:
            asyncio.get_running_loop().call_later(0.1, self.beat, LIMP)

    def beat(self, heartbeat):
        self.view.heard = time.monotonic()
        self.view.beat(heartbeat)

    @property
    def assigned(self):
        return any(isinstance(body, Assign) for body in self.sent)

    async def until(self, true):
        while not true():
            await asyncio.sleep(0.02)

    async def still(self):
        """Nothing is looked at any more."""
        await self.until(lambda: not self.conductor._tasks)

    async def asked(self, name, agent="a"):
        """Make a study that waits for its operator."""
        self.fits.ready.set()
        settings = replace(SETTINGS, gate=Gate.OPERATOR, agent=agent)
        await self.conductor.create(name, settings, None, "test")
        await self.still()
        assert self.conductor.studies[name].open

    @contextmanager
    def locked(self):
        """Another program holds the database."""
        with closing(sqlite3.connect(self.file, isolation_level=None)) as other:
            other.execute("PRAGMA busy_timeout=5000")
            other.execute("BEGIN IMMEDIATE")
            yield
            other.execute("ROLLBACK")


def live(folder, act):
    async def bounded():
        bench = Bench(folder)
        store = bench.conductor.store
        await store.run(lambda c: c.exec_driver_sql("PRAGMA busy_timeout=50"))
        try:
            await asyncio.wait_for(act(bench), 60)
        finally:
            bench.fits.ready.set()
            while bench.conductor._tasks:
                await asyncio.gather(*bench.conductor._tasks.values(), return_exceptions=True)
            store.close()

    asyncio.run(bounded())


def test_a_stop_waits_for_no_fit_nor_another_study_for_its(tmp_path):
    """A study that is held up is paused as soon as it can be, before anything is handed out."""

    async def act(bench):
        conductor = bench.conductor
        await bench.asked("waiting")
        bench.fits.ready.clear()
        bench.fits.begun.clear()
        await conductor.create("fitting", SETTINGS, None, "test")
        await bench.fits.begun.wait()
        began = time.monotonic()
        unwritten = await stop(conductor, "a", "ann", "smoke")
        assert time.monotonic() - began < 2.5
        assert unwritten == ["study fitting is not paused yet"]
        assert conductor.studies["waiting"].state == "paused"
        bench.beat(ENABLED)
        bench.fits.ready.set()
        await bench.until(lambda: conductor.studies["fitting"].state == "paused")
        assert "stopped by ann" in conductor.studies["fitting"].reason
        assert not bench.assigned

    live(tmp_path, act)


def test_a_robot_that_was_stopped_walks_for_nobody_until_a_study_goes_on(tmp_path):
    """Though no pause could be written, and somebody has enabled it."""

    async def act(bench):
        conductor = bench.conductor
        await bench.asked("s")
        with bench.locked():
            unwritten = await stop(conductor, "a", "ann", "smoke")
        told = ["study s is not paused yet", "the history does not have the stop yet"]
        assert unwritten == told and bench.view.stop is None, "limp it is"
        assert conductor.studies["s"].state == "active"
        bench.beat(ENABLED)
        await conductor.change("s", "bob", partial(orders.release, number=1), "released")
        conductor.tick()
        await bench.still()
        assert not bench.assigned
        waits = "an agent: a was stopped (ann: smoke): resume the study to let it walk"
        assert conductor.waits_for(conductor.studies["s"]) == waits
        assert bench.view.document()["held"] == "ann: smoke"
        await conductor.go_on("s", "bob", orders.resume, "resumed")
        await bench.still()
        assert bench.assigned

    live(tmp_path, act)


def test_another_study_that_goes_on_lets_no_robot_walk_that_it_has_not(tmp_path):
    async def act(bench):
        await bench.asked("s")
        await bench.asked("elsewhere", agent="b")
        await stop(bench.conductor, "a", "ann", "smoke")
        await bench.conductor.go_on("elsewhere", "bob", orders.resume, "resumed")
        assert bench.view.held
        await bench.conductor.go_on("s", "bob", orders.resume, "resumed")
        assert not bench.view.held

    live(tmp_path, act)


def test_a_robot_that_does_not_obey_is_told_of_with_what_could_not_be_written(tmp_path):
    async def act(bench):
        await bench.asked("s")
        bench.obeys = False
        with bench.locked(), pytest.raises(TrialError, match="use the switch") as told:
            await stop(bench.conductor, "a", "ann", "smoke")
        assert "study s is not paused yet" in str(told.value)
        await bench.conductor.go_on("s", "bob", orders.resume, "resumed")
        await bench.conductor.change("s", "bob", partial(orders.release, number=1), "released")
        await bench.still()
        assert not bench.assigned, "it is being stopped still"

    live(tmp_path, act)
