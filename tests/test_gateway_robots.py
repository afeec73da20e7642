"""Which robot a study walks on, and whom a name stands for."""

import os
import time

import pytest
import zmq
import zmq.auth

pytest.importorskip("fastapi")
pytest.importorskip("botorch")

import fake_agent
import gateways
from test_gateway import until
from test_gateway_link import dealer

from pup.wire import AgentState, Assign, Heartbeat, Hello, Message, Policy, Stop, decode, encode
from services.gateway.agents import AgentView
from services.gateway.keys import KeyRing
from services.gateway.metrics import Metrics

STUDY = gateways.STUDY | {"trials": 2, "initial": 2, "repeats": 0}


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    with gateways.running(tmp_path_factory.mktemp("robots") / "data") as made:
        yield made


def test_a_study_stays_with_the_robot_that_began_it(service):
    """Else, when that one trips, one process would hear of two robots."""
    walk = fake_agent.walks(lambda eta: 0.5)

    def trips(body):
        first.state = AgentState.FAULT
        first._send(Heartbeat(first.name, first.state))  # before the end, so that none comes next
        return walk(body)

    pairs = [service.agent_keys(name) for name in ("alike-1", "alike-2")]
    first = fake_agent.FakeAgent(*pairs[0], service.link, trips)
    second = fake_agent.FakeAgent(*pairs[1], service.link, walk)
    with service.client() as http, first, second:
        until(lambda: sum(a["state"] == "enabled" for a in _agents(http)) == 2)
        http.post("/v1/studies", json=STUDY | {"name": "alike"})
        until(lambda: len(service.trials("alike")) == 2)
        waits = "an agent: alike-1 is fault, and no other may go on"
        until(lambda: http.get("/v1/studies/alike").json()["waits_for"] == waits)
        time.sleep(1.5)  # three looks of the gateway
        assert second.journal.walked == []
        first.walk, first.state = walk, AgentState.ENABLED
        service.wait_for("alike")
    assert {t["agent"] for t in service.trials("alike")} == {"alike-1"}


def test_a_slip_seen_after_the_choice_is_mended(service):
    keys = service.agent_keys("slip")
    walk = fake_agent.walks(lambda eta: 0.5)
    with service.client() as http, fake_agent.FakeAgent(*keys, service.link, walk) as agent:
        http.post("/v1/studies", json=STUDY | {"name": "slip", "agent": "slip"})
        assert service.wait_for("slip")["chosen"]
        voided = http.post("/v1/studies/slip/trials/2:void", json={"reason": "30 for 0.3"})
        assert voided.json()["state"] == "aborted"
        told = http.get("/v1/studies/slip").json()
        assert (told["state"], told["chosen"], told["walks"]) == ("paused", None, 1)
        http.post("/v1/studies/slip/trials/2:retry", json={"attempt": 2})
        told = service.wait_for("slip")
        assert told["chosen"] and told["walks"] == 2 and len(agent.journal.walked) == 3


def test_a_key_that_is_replaced_in_its_place_is_another_robot(service, tmp_path):
    """Nothing goes to the one with the old key, though it is connected still."""
    old = service.agent_keys("swapped")
    zmq.auth.create_certificates(tmp_path, "swapped")
    new = (tmp_path / "swapped.key_secret", old[1])
    with zmq.Context() as context, service.client() as http:
        first, second = dealer(context, service, old), dealer(context, service, new)
        first.connect(service.link)
        first.send(_hello("old"))
        assert first.poll(10_000)
        file = KeyRing(service.data / "curve").agents_folder / "swapped.key"
        os.replace(tmp_path / "swapped.key", file)
        time.sleep(1.5)  # the gateway looks every second
        _drain(first)
        http.post("/v1/agents/swapped:stop", json={"reason": "smoke"})
        assert not first.poll(1000), "its key is known no more"
        second.connect(service.link)
        second.send(_hello("new"))
        until(lambda: _version(http) == "new")
        until(lambda: any(isinstance(body, Stop) for body in _drain(second)), 10)
        assert not any(isinstance(body, Stop | Assign) for body in _drain(first))
        first.close()
        second.close()


def test_metrics_tell_how_long_a_robot_was_not_heard_whose_key_was_revoked():
    metrics, revoked = Metrics(), AgentView("gone", heard=time.monotonic() - 100)
    metrics.agent(revoked)
    metrics.agent(AgentView("never"))
    age = metrics.registry.get_sample_value
    assert age("pup_agent_heartbeat_age_seconds", {"agent": "gone"}) >= 100
    assert age("pup_agent_heartbeat_age_seconds", {"agent": "never"}) is None


def test_metrics_tell_no_health_of_a_robot_that_is_away():
    from services.gateway.conductor import Conductor

    conductor = Conductor(None, None, Metrics())
    view = conductor.agents["a"] = AgentView("a", heard=time.monotonic(), health={"volts": 12.0})
    told = conductor.metrics.registry.get_sample_value
    conductor.measure()
    assert told("pup_agent_health", {"agent": "a", "name": "volts"}) == 12.0
    view.heard -= 60
    conductor.measure()
    assert told("pup_agent_health", {"agent": "a", "name": "volts"}) is None
    assert told("pup_agent_heartbeat_age_seconds", {"agent": "a"}) >= 60


def _hello(version):
    told = Hello("swapped", "darwin_op2", version, (Policy("walk", fake_agent.POLICY),))
    return encode(Message(told))


def _drain(socket):
    bodies = []
    while socket.poll(0):
        bodies.append(decode(socket.recv()).body)
    return bodies


def _agents(http):
    return http.get("/v1/agents").json()["agents"]


def _version(http):
    return next(a["version"] for a in _agents(http) if a["name"] == "swapped")
