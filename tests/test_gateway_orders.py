"""What an operator orders holds: while an agent is away, and for two robots that are alike."""

import shutil
import sqlite3
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import pytest

pytest.importorskip("fastapi")
pytest.importorskip("botorch")

import fake_agent
import gateways
import httpx
import zmq
from test_gateway import until
from test_gateway_link import dealer

from pup.wire import AgentState, Cancel, Heartbeat, Hello, Message, Policy, encode
from services.gateway.keys import KeyRing
from services.transfer import Gateway

STUDY = gateways.STUDY | {"trials": 1, "initial": 1, "repeats": 0}


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    with gateways.running(tmp_path_factory.mktemp("orders") / "data") as made:
        yield made


def test_a_paused_study_moves_no_robot(service):
    """The trial was let go before; the robot is enabled after the pause."""
    keys = service.agent_keys("later")
    walk = fake_agent.walks(lambda eta: 0.5)
    with service.client() as http, fake_agent.FakeAgent(*keys, service.link, walk) as agent:
        agent.state = AgentState.DISABLED
        http.post("/v1/studies", json=STUDY | {"name": "paused", "agent": "later"})
        until(lambda: http.get("/v1/studies/paused").json()["open"] == 1)
        http.post("/v1/studies/paused:pause", json={"reason": "lunch"})
        agent.state = AgentState.ENABLED
        until(lambda: _agent(http, "later")["state"] == "enabled")
        time.sleep(1.5)  # three looks of the gateway
        assert agent.journal.walked == []
        assert http.get("/v1/studies/paused").json()["waits_for"] == "the study to be resumed"
        http.post("/v1/studies/paused:resume")
        service.wait_for("paused")
        assert len(agent.journal.walked) == 1


def test_a_cancellation_waits_for_an_agent_that_is_away(service):
    keys = service.agent_keys("away")
    journal = fake_agent.Journal()
    asked = STUDY | {"name": "cancelled", "agent": "away"}
    with service.client() as http:
        with fake_agent.FakeAgent(*keys, service.link, lambda _: None, journal):
            http.post("/v1/studies", json=asked)
            until(lambda: service.trials("cancelled")[-1:] and _state(service) == "running")
        http.post("/v1/studies/cancelled/trials/1:cancel")
        with fake_agent.FakeAgent(*keys, service.link, lambda _: None, journal) as back:
            until(lambda: _state(service) == "aborted", 20)
            assert any(isinstance(body, Cancel) for body in back.received)
        retried = http.post("/v1/studies/cancelled/trials/1:retry", json={"attempt": 2})
        assert retried.json()["state"] in ("requested", "assigned"), "not cancelled any more"


def test_a_stop_that_nobody_hears_is_told_so(service):
    keys = service.agent_keys("gone")
    with service.client() as http:
        asked = STUDY | {"name": "stopped", "agent": "gone"}
        http.post("/v1/studies", json=asked)
        until(lambda: any(a["name"] == "gone" for a in _agents(http)))
        for body in ({"json": {"reason": "smoke"}}, {}, {"content": b"{not json"}, {"json": [1]}):
            answer = http.post("/v1/agents/gone:stop", **body)  # whatever it says, a stop is one
            assert answer.status_code == 409 and "use the switch" in answer.json()["detail"]
        assert http.get("/v1/studies/stopped").json()["state"] == "paused"
        walk = fake_agent.walks(lambda eta: 0.5)
        with fake_agent.FakeAgent(*keys, service.link, walk) as agent:
            until(lambda: _agent(http, "gone")["present"])
            time.sleep(1.0)
            assert agent.journal.walked == []


def test_a_key_that_was_copied_to_a_second_robot_moves_one(service):
    """The second is not heard while the first is there, and at once when it has gone."""
    keys = service.agent_keys("copied")
    with zmq.Context() as context, service.client() as http:
        first, second = (_connected(context, service, keys) for _ in range(2))
        first.send(encode(Message(Hello("copied", "darwin_op2", "first", (_policy(),)))))
        assert first.poll(10_000)
        second.send(encode(Message(Hello("copied", "darwin_op2", "second", (_policy(),)))))
        assert not second.poll(1500)
        first.send(encode(Message(Heartbeat("copied", AgentState.ENABLED))))
        until(lambda: _agent(http, "copied")["state"] == "enabled")
        http.post("/v1/studies", json=STUDY | {"name": "copied", "agent": "copied"})
        until(lambda: service.trials("copied")[-1:] and _state(service, "copied") == "assigned")
        time.sleep(0.5)
        assert not second.poll(0), "a trial for the other robot"
        first.close(0)
        until(lambda: _heard(second), 10)
        assert _agent(http, "copied")["version"] == "second"
        second.close(0)


def test_a_stop_is_sent_each_time_and_until_it_is_obeyed(service):
    """By the same idempotency key too; the agent that went deaf for a moment hears it then."""
    keys = service.agent_keys("deaf")
    walk = fake_agent.walks(lambda eta: 0.5)
    with service.client() as http, fake_agent.FakeAgent(*keys, service.link, walk) as agent:
        until(lambda: any(a["name"] == "deaf" and a["state"] for a in _agents(http)))
        for _ in range(2):
            agent.state = AgentState.ENABLED
            until(lambda: _agent(http, "deaf")["state"] == "enabled")
            headers = {"Idempotency-Key": "the-button"}
            answer = http.post("/v1/agents/deaf:stop", json={"reason": "smoke"}, headers=headers)
            assert answer.status_code == 202 and agent.state is AgentState.STOPPED
        agent.state, agent.deaf = AgentState.ENABLED, True
        until(lambda: _agent(http, "deaf")["state"] == "enabled")
        answer = http.post("/v1/agents/deaf:stop", json={"reason": "smoke"})
        assert answer.status_code == 409 and "not said that it is limp" in answer.text
        agent.deaf = False
        until(lambda: agent.state is AgentState.STOPPED, 10)
        agent.limp = False  # its bus is cut: the servos hold, whatever it was told
        answer = http.post("/v1/agents/deaf:stop", json={"reason": "smoke"})
        assert answer.status_code == 409 and "use the switch" in answer.text


def test_a_stop_does_not_wait_for_the_database_and_a_program_does(service):
    """Another program holds it for longer than SQLite waits."""
    keys = service.agent_keys("locked")
    walk = fake_agent.walks(lambda eta: 0.5)
    with service.client() as http, fake_agent.FakeAgent(*keys, service.link, walk) as agent:
        until(lambda: any(a["name"] == "locked" and a["state"] for a in _agents(http)))
        with (
            closing(sqlite3.connect(service.data / "gateway.db", isolation_level=None)) as other,
            ThreadPoolExecutor(2) as threads,
        ):
            other.execute("BEGIN IMMEDIATE")
            program = Gateway(service.url, service.tokens["operator"], lambda _: None)
            study = STUDY | {"name": "patient", "agent": "locked", "gate": "operator"}
            made = threads.submit(program.post, "/v1/studies", study)
            body = {"reason": "smoke"}
            stopped = threads.submit(http.post, "/v1/agents/locked:stop", json=body)
            until(lambda: agent.state is AgentState.STOPPED, 2)
            answer = httpx.post(
                f"{service.url}/v1/studies",
                json=study | {"name": "impatient"},
                headers=http.headers,
                timeout=60,
            )
            assert answer.status_code == 503 and answer.headers["Retry-After"] == "1"
            other.execute("ROLLBACK")
            assert made.result(30)["name"] == "patient"
            told = stopped.result(30)
            assert told.status_code == 202 and told.elapsed.total_seconds() < 4
            assert told.json()["unwritten"] == ["the history does not have the stop yet"]


def test_a_study_made_anew_does_not_get_the_walks_of_an_old_one(service):
    """The robot's journal knows a study of this name: of a gateway whose database is gone."""
    keys = service.agent_keys("reborn")
    walk = fake_agent.walks(lambda eta: 0.5)
    with service.client() as http, fake_agent.FakeAgent(*keys, service.link, walk) as agent:
        names = set()
        for name in ("first", "second"):
            http.post("/v1/studies", json=STUDY | {"name": name, "agent": "reborn"})
            service.wait_for(name)
            names.add(agent.journal.walked[-1][0].replace(name, "same"))
    assert len(names) == 2 and all(name.startswith("same/1.") for name in names)


def test_a_key_file_that_is_being_written_ends_nobody(service, tmp_path):
    keys = service.agent_keys("half")
    file = KeyRing(service.data / "curve").agents_folder / "half.key"
    whole = tmp_path / "half.key"
    shutil.move(file, whole)
    file.write_text("# half of it")
    time.sleep(1.5)  # the gateway looks every second
    with service.client() as http:
        assert http.get("/readyz").status_code == 200
        shutil.copy(whole, file)
        walk = fake_agent.walks(lambda eta: 0.5)
        with fake_agent.FakeAgent(*keys, service.link, walk):
            until(lambda: any(a["present"] for a in _agents(http) if a["name"] == "half"), 20)


def _agents(http):
    return http.get("/v1/agents").json()["agents"]


def _agent(http, name):
    return next(a for a in _agents(http) if a["name"] == name)


def _state(service, study="cancelled"):
    return service.trials(study)[-1]["state"]


def _policy():
    return Policy("walk", fake_agent.POLICY)


def _connected(context, service, keys):
    socket = dealer(context, service, keys)
    socket.connect(service.link)
    return socket


def _heard(socket):
    """Says hello once more; whether the gateway answers."""
    socket.send(encode(Message(Hello("copied", "darwin_op2", "second", (_policy(),)))))
    return socket.poll(500)
