"""A gateway that dies between any two steps: no trial is lost, none is walked or told twice."""

import asyncio
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter

import pytest

pytest.importorskip("fastapi")
pytest.importorskip("botorch")

import fake_agent
import gateways

from pup.transfer.study import Gate, Study, StudySettings
from pup.wire import (
    Accepted,
    AgentState,
    Armed,
    Assign,
    Finished,
    Heartbeat,
    Hello,
    Outcome,
    Policy,
    Running,
)
from services.gateway.agents import AgentView
from services.gateway.conductor import Conductor
from services.gateway.metrics import Metrics
from services.gateway.posteriors import NOTHING, Posteriors, StoppingError
from services.gateway.store import Change, ReplacedError, Store

POLICY = "a" * 64
SETTINGS = StudySettings("darwin_op2", POLICY, trials=2, initial=2, repeats=1, gate=Gate.AUTO)


class KilledError(BaseException):
    """The process ends here."""


class InProcess:
    """Runs fits at once; they are the same functions as in the process of the fits."""

    async def run(self, act, *args):
        return act(*args)


class Robot:
    """What outlives the gateway: the robot's journal. Walks each handing-out once."""

    def __init__(self):
        self.walked, self.results = [], {}

    def take(self, assign):
        ticket = (assign.trial, assign.attempt, assign.fence)
        if ticket not in self.results:
            self.walked.append(ticket)
            self.results[ticket] = Finished(*ticket, Outcome.SUCCEEDED, 0.5, 1.0)
        return self.results[ticket]


class Deadly:
    """A store and a link that end the process before or after their n-th deed."""

    def __init__(self, conductor, robot, deadline):
        self.deeds, self.deadline, self.robot = 0, deadline, robot
        self.inbox = []
        write = conductor.store.write

        async def dying(change):
            self._deed()
            await write(change)
            self._deed()

        conductor.store.write = dying
        conductor.courier.send = self.send

    def send(self, agent, body):
        self._deed()
        if isinstance(body, Assign):
            self.inbox.append(body)
        self._deed()

    def _deed(self):
        self.deeds += 1
        if self.deeds == self.deadline:
            raise KilledError


def life(database, robot, deadline):
    """A gateway's life until it dies or the study is done; the number of its deeds."""

    async def live():
        store = Store(database)
        conductor = Conductor(store, InProcess(), Metrics())
        deadly = None
        try:
            await conductor.load()
            view = conductor.agents["darwin-1"] = AgentView("darwin-1")
            view.greet(Hello("darwin-1", "darwin_op2", "1", (Policy("walk", POLICY),)))
            deadly = Deadly(conductor, robot, deadline)
            await conductor.create("s", SETTINGS, None, "test")
            for _ in range(200):
                view.beat(Heartbeat("darwin-1", AgentState.ENABLED))
                view.heard = asyncio.get_running_loop().time()
                conductor.courier._sent.clear()  # as if RESEND had gone by
                await conductor._look("s")
                for ticket, result in list(robot.results.items()):
                    if ticket not in acknowledged:  # the agent resends
                        await conductor.finished("darwin-1", result)
                        deadly._deed()  # between the store and the acknowledgement
                        acknowledged.add(ticket)
                while deadly.inbox:
                    assign = deadly.inbox.pop(0)
                    ticket = (assign.trial, assign.attempt, assign.fence)
                    robot.take(assign)
                    for kind in (Accepted, Armed, Running):
                        await conductor.reported("darwin-1", kind(*ticket))
                if conductor.studies["s"].state == "done":
                    return deadly.deeds, conductor.studies["s"]
            raise AssertionError("the study does not end")
        except KilledError:
            return deadly.deeds, None
        finally:
            for task in conductor._tasks.values():
                task.cancel()
            await asyncio.gather(*conductor._tasks.values(), return_exceptions=True)
            store.close()

    acknowledged = robot.__dict__.setdefault("acknowledged", set())
    return asyncio.run(live())


@pytest.fixture
def quiet(monkeypatch):
    """Looks are made by the test alone, so that deeds can be counted."""
    monkeypatch.setattr(Conductor, "_go_on", lambda self, name: None)


def test_a_death_between_any_two_steps_changes_nothing(tmp_path, quiet):
    fresh = tmp_path / "fresh.db"
    Store(f"sqlite:///{fresh}").close()
    robot = Robot()
    deeds, whole = life(f"sqlite:///{tmp_path / 'whole.db'}", robot, deadline=0)
    told = [(t.number, t.eta, t.purpose, t.state) for t in whole.trials]
    assert len(told) == 3 and deeds > 30
    for deadline in range(1, deeds + 1):
        file, robot = tmp_path / f"{deadline}.db", Robot()
        shutil.copy(fresh, file)
        database = f"sqlite:///{file}"
        _, ended = life(database, robot, deadline)
        if ended is None:
            _, ended = life(database, robot, deadline=0)
        assert [(t.number, t.eta, t.purpose, t.state) for t in ended.trials] == told
        assert len(robot.walked) == len(set(robot.walked)) == 3, "each trial was walked once"
        kinds = Counter(histories(database))
        assert max(kinds.values()) == 1, "each was told once"


def histories(database):
    async def read():
        store = Store(database)
        try:
            return await store.events("s", 0, 10_000)
        finally:
            store.close()

    events = asyncio.run(read())
    return [(e["kind"], e["trial"]) for e in events]


def test_deaths_at_every_step_of_every_life_end_all_the_same(tmp_path, quiet):
    """Lives of 7 deeds each: far fewer than a study needs."""
    database, robot = f"sqlite:///{tmp_path / 'short.db'}", Robot()
    for _ in range(100):
        _, ended = life(database, robot, deadline=7)
        if ended:
            break
    assert ended and len(robot.walked) == len(set(robot.walked)) == 3


def test_a_gateway_that_was_replaced_writes_no_more(tmp_path):
    async def both():
        database = f"sqlite:///{tmp_path / 'two.db'}"
        old, new = Store(database), Store(database)
        conductor = Conductor(old, InProcess(), Metrics())
        with pytest.raises(ReplacedError):
            await conductor.create("s", SETTINGS, None, "test")
        assert conductor.stopped and not await old.writable() and await new.writable()
        await asyncio.wait_for(conductor.run(), 5)
        assert await new.studies() == []
        old.close()
        new.close()

    asyncio.run(both())


KILLED = """
import os, sys
from alembic import op
from services.gateway.store import Store
left, original = [int(sys.argv[2])], getattr(op, sys.argv[3])
def dying(*args, **options):
    original(*args, **options)
    left[0] -= 1
    if not left[0]:
        os._exit(9)
setattr(op, sys.argv[3], dying)
Store(sys.argv[1])
"""


@pytest.mark.parametrize(
    ("step", "kind"), [(3, "create_table"), (6, "create_table"), (1, "add_column")]
)
def test_a_death_in_a_migration_leaves_a_database_that_can_be_opened(tmp_path, step, kind):
    url = f"sqlite:///{tmp_path / 'half.db'}"
    ended = subprocess.run([sys.executable, "-c", KILLED, url, str(step), kind], timeout=60)
    assert ended.returncode == 9, "it was killed there"
    store = Store(url)
    assert asyncio.run(store.studies()) == []
    store.close()


def test_a_study_that_cannot_go_on_says_so_and_goes_on_when_it_can(tmp_path):
    class Broken:
        async def run(self, act, *args):
            raise MemoryError

    async def live():
        store = Store(f"sqlite:///{tmp_path / 'broken.db'}")
        conductor = Conductor(store, Broken(), Metrics())
        study, _ = await conductor.create("s", SETTINGS, None, "test")
        while "MemoryError" not in conductor.waits_for(study):
            await asyncio.sleep(0.01)
        assert not conductor.studies["s"].trials
        conductor.fits = InProcess()
        conductor.tick()
        while not conductor.studies["s"].trials:
            await asyncio.sleep(0.01)
        while "failed" in conductor.waits_for(conductor.studies["s"]):  # until that look has ended
            await asyncio.sleep(0.01)
        store.close()

    asyncio.run(asyncio.wait_for(live(), 120))


def test_a_page_does_not_wait_for_a_slow_process_and_many_pages_ask_for_one():
    async def live():
        asked, told, ready = [], [], asyncio.Event()

        class Slow:
            async def run(self, act, *args):
                asked.append(act)
                await ready.wait()
                return {"walks": 9, "best": None, "slices": []}

        made, study = Posteriors(Slow(), told.append), Study("s", SETTINGS)
        assert await made.soon(study, None, 0.05) == NOTHING
        waiting = [asyncio.create_task(made.of(study, None)) for _ in range(3)]
        await asyncio.sleep(0)
        ready.set()
        assert [row["walks"] for row in await asyncio.gather(*waiting)] == [9, 9, 9]
        assert len(asked) == 1 and told == ["s"]
        assert (await made.soon(study, None, 0.05))["walks"] == 9
        ready.clear()
        waiting = [asyncio.create_task(made.of(Study("t", SETTINGS), None)) for _ in range(2)]
        await asyncio.sleep(0.05)
        made.stop()
        ends = await asyncio.gather(*waiting, return_exceptions=True)
        assert [type(end) for end in ends] == [StoppingError] * 2

    asyncio.run(asyncio.wait_for(live(), 120))


def test_the_store_writes_a_change_whole_or_not_at_all(tmp_path):
    async def live():
        store = Store(f"sqlite:///{tmp_path / 'whole.db'}")
        conductor = Conductor(store, InProcess(), Metrics())
        conductor._go_on = lambda name: None
        study, _ = await conductor.create("s", SETTINGS, None, "test")
        from pup.transfer.trial import Purpose, Trial
        from services.gateway.store import Event

        trial = Trial("s", 1, (0.0, 0.0, 0.0), Purpose.INITIAL)
        bad = Event("requested", detail={"cannot": object()})
        with pytest.raises(Exception, match="serializable"):
            await store.write(Change(study.with_trial(trial), [trial], [bad]))
        ((read, _),) = await store.studies()
        assert read.trials == ()
        store.close()

    asyncio.run(live())


def churn(service, study, trials, lives, seed, settings):
    """A study while the gateway is killed; returns what was walked, and the trials as stored."""
    rng = random.Random(seed)
    keys = service.agent_keys(f"{study}-1")
    journal = fake_agent.Journal()
    walk = fake_agent.walks(lambda eta: 0.5 + 0.1 * eta[0])
    agent = fake_agent.FakeAgent(*keys, service.link, walk, journal, pause=0.02)
    with agent:
        with service.client() as http:
            asked = gateways.STUDY | {"name": study, "trials": trials} | settings
            assert http.post("/v1/studies", json=asked).status_code == 201
        for _ in range(lives):
            time.sleep(rng.uniform(0.05, 1.5))
            service.kill(signal.SIGKILL)
            service.start()
        service.wait_for(study, seconds=400)
        told = service.trials(study)
    return journal, told


@pytest.mark.slow
def test_a_real_gateway_killed_again_and_again(tmp_path):
    with gateways.running(tmp_path / "data") as service:
        settings = {"initial": 8, "repeats": 0, "failures": 50}
        journal, told = churn(service, "churn", 8, 2, 1, settings)
    check_histories(journal, told, 8)


def check_histories(journal, told, wanted):
    """Both sides' histories agree."""
    assert len(journal.walked) == len(set(journal.walked)), "none was walked twice"
    assert Counter(t for t, *_ in journal.walked).most_common(1)[0][1] == 1
    counted = [t for t in told if t["state"] == "succeeded"]
    assert len(counted) == wanted
    walked = {trial for trial, *_ in journal.walked}
    assert {t["id"] for t in counted} <= walked, "none was told that was not walked"
    assert walked <= {t["id"] for t in told}, "none is lost"


@pytest.mark.slow
def test_a_thousand_trials_under_kills(tmp_path):
    """The acceptance line: 1,000 trials, the gateway killed every few seconds."""
    with gateways.running(tmp_path / "data") as service:
        settings = {"initial": 1000, "repeats": 0, "failures": 1000}
        journal, told = churn(service, "thousand", 1000, 60, 2, settings)
    check_histories(journal, told, 1000)
