"""`pup transfer` beside a real `pup serve`: made, joined, interrupted, written."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import agents
import fake_agent
import gateways
import numpy as np
import psutil
import pytest
from commandline import pup

from pup.errors import InputError
from pup.policy.bundle import read_bundle
from pup.wire import Finished, Outcome, without_mark

pytest.importorskip("fastapi")
pytest.importorskip("botorch")

from services import transfer
from services.trials import attend


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    with gateways.running(tmp_path_factory.mktemp("transfer") / "data") as made:
        yield made


@pytest.fixture
def robot(service, tmp_path, monkeypatch):
    """An agent that has the policy, and what `pup transfer` is told of it."""
    import hashlib

    policy = agents.bundle(tmp_path / "policy")
    digest = hashlib.sha256((policy / "policy.json").read_bytes()).hexdigest()
    monkeypatch.setattr(fake_agent, "POLICY", digest)
    monkeypatch.setenv("PUP_TOKEN", service.tokens["operator"])
    name = tmp_path.name[:30]
    walk = fake_agent.walks(lambda eta: 0.8 - 0.2 * float(np.sum(np.square(eta))))
    with fake_agent.FakeAgent(*service.agent_keys(name), service.link, walk, pause=0.05) as agent:
        study = ("transfer", "--policy", policy, "--study", name, "--url", service.url, "--auto")
        yield agent, (*study, "--agent", name, "--out", tmp_path)


SMALL = ("--trials", 4, "--initial", 3, "--repeats", 2)


def test_a_study_is_followed_to_its_end(robot, tmp_path):
    agent, command = robot
    n_eta = read_bundle(tmp_path / "policy")[0].shape.eta
    compare = ",".join(["-0.5"] * n_eta)  # not taken for an option
    done = pup(*command, *SMALL, "--compare", compare, "--json")
    assert done.code == 0, done.err
    told = done.json()
    assert told == json.loads((tmp_path / "study.json").read_text())
    assert told["schema"] == 1 and told["state"] == "done" and len(told["eta"]) == n_eta
    assert [len(part["distance"]) for part in told["evaluation"]] == [2, 2]
    assert told["evaluation"][1]["eta"] == [-0.5] * n_eta
    assert len(told["trials"]) == 8 and len(agent.journal.walked) == 8
    assert {e["kind"] for e in told["history"]} >= {"created", "requested", "assigned", "chosen"}
    assert "4/4 walks" in done.err
    again = pup(*command, *SMALL, "--compare", compare)  # joined, not made anew
    assert again.code == 0 and again.out.startswith("eta: ") and len(agent.journal.walked) == 8
    other = pup(*command, *SMALL, "--seed", 3)
    assert other.code == 2 and "other settings" in other.err
    file = tmp_path / "study.json"
    for known, why in (
        (told["study"], "another study of this name"),
        ("gone", "cannot be gone on"),
    ):
        elsewhere = told | {"study": known}
        elsewhere["history"][0]["time"] -= 1.0
        file.write_text(json.dumps(elsewhere))
        refused = pup(*command, *SMALL, "--study", known)
        assert refused.code == 2 and why in refused.err and "use another --out" in refused.err
        assert json.loads(file.read_text()) == elsewhere


def test_a_search_ends_once_no_walk_is_worth_it(robot, tmp_path):
    _, command = robot
    told = ("--trials", 20, "--initial", 4, "--repeats", 1, "--least-gain", 0.5, "--json")
    study = pup(*command, *told).json()
    assert study["settings"]["least_gain"] == 0.5 and len(study["trials"]) < 20
    (chosen,) = (e["detail"] for e in study["history"] if e["kind"] == "chosen")
    assert "expected to gain" in chosen["why"] and chosen["eta"] == study["eta"]
    assert [t["purpose"] for t in study["trials"]][-1] == "repeat"


def test_it_outlives_the_gateway_and_is_resumed(robot, service, tmp_path):
    """The gateway is killed meanwhile, and the verb itself interrupted."""
    agent, command = robot
    agent.pause = 0.5
    run = [sys.executable, "-m", "services.cli", *map(str, (*command, *SMALL))]
    first = subprocess.Popen(run, stderr=subprocess.PIPE, text=True, env=dict(os.environ))
    while not agent.journal.walked:
        time.sleep(0.05)
    fits = psutil.Process(service.process.pid).children(recursive=True)
    service.kill(signal.SIGKILL)
    _, left = psutil.wait_procs(fits, timeout=20)
    assert fits and not left, "its processes follow a gateway that was killed"
    service.start()
    time.sleep(1.0)
    first.send_signal(signal.SIGINT)
    _, err = first.communicate(timeout=30)
    assert first.returncode == 130 and "the same command resumes" in err.splitlines()[-1]
    assert "Traceback" not in err
    done = pup(*command, *SMALL, "--json")
    assert done.code == 0, done.err
    assert len(done.json()["trials"]) == 6
    assert len(set(agent.journal.walked)) == len(agent.journal.walked) == 6


def test_simulated_rollouts_go_with_the_study(robot, tmp_path):
    _, command = robot
    n_eta = read_bundle(tmp_path / "policy")[0].shape.eta
    rng = np.random.default_rng(0)
    eta = rng.uniform(-1, 1, (30, n_eta))
    distance = 0.8 - 0.2 * (eta**2).sum(axis=1) + rng.normal(0, 0.02, (6, 30))
    file = tmp_path / "simulated.json"
    file.write_text(json.dumps({"schema": 1, "eta": eta.tolist(), "distance": distance.tolist()}))
    done = pup(
        *command, "--trials", 2, "--initial", 1, "--repeats", 0, "--simulated", file, "--json"
    )
    assert done.code == 0, done.err
    why = [e["detail"].get("why") for e in done.json()["history"] if e["kind"] == "requested"]
    assert why[0] == "best in simulation"
    assert np.abs(done.json()["trials"][0]["eta"]).max() < 0.5


def test_attended_a_study_goes_on_without_results_but_not_for_ever(
    robot, service, tmp_path, monkeypatch
):
    """A trial without one is attempted again, then another takes its place."""
    agent, _ = robot
    monkeypatch.setattr(transfer, "PERIOD", 0.05)
    good, cut_off = agent.walk, {(2, 1), (3, 1), (3, 2), (3, 3)}

    def walk(body):
        number = int(without_mark(body.trial).rpartition("/")[2])
        if cut_off and (number, body.attempt) not in cut_off:
            return good(body)
        return Finished(body.trial, body.attempt, body.fence, Outcome.ABORTED, reason="cut off")

    def study(name):
        settings = {"trials": 3, "initial": 3, "repeats": 0, "failures": 1, "gate": "auto"}
        settings["agent"] = agent.name
        token = service.tokens["operator"]
        wanted = transfer.Wanted(tmp_path / "policy", name, service.url, token, settings)
        return transfer.transfer(wanted, tmp_path / name, lambda line: None, attend)

    agent.walk = walk
    told = [(t["state"], t["attempt"]) for t in study(f"{agent.name}-a")["trials"]]
    assert told == [("succeeded", 1), ("succeeded", 2), ("aborted", 3), ("succeeded", 1)]
    cut_off.clear()
    with pytest.raises(InputError, match="no results: cut off"):
        study(f"{agent.name}-b")


def test_tokens_and_keys_by_command(tmp_path, monkeypatch):
    """What an admin does first."""
    monkeypatch.setenv("PUP_DATA", str(tmp_path / "data"))
    token = pup("serve", "token", "ann", "--role", "operator", "--json").json()
    assert token["token"].startswith("pup_") and len(token["token"]) > 40
    made = pup("serve", "agent", "darwin", "--out", tmp_path / "robot", "--json").json()
    secret = tmp_path / "robot" / "darwin.key_secret"
    assert made["key"] == str(secret) and secret.stat().st_mode & 0o077 == 0
    assert not (tmp_path / "data/curve/agents/darwin.key_secret").exists()
    again = pup("serve", "agent", "darwin", "--out", tmp_path / "other")
    assert again.code == 2 and "revoke" in again.err
    assert pup("serve", "revoke-agent", "darwin").code == 0
    assert pup("serve", "revoke-token", "ann").code == 0
    assert "ann" not in (tmp_path / "data/tokens.json").read_text()


class Slow(BaseHTTPRequestHandler):
    """Answers the first request only after whoever asked has given up."""

    asked = 0

    def do_GET(self):
        Slow.asked += 1
        if Slow.asked == 1:
            time.sleep(0.6)
        self.send_response(200)
        self.end_headers()
        self.wfile.write(b'{"here": true}')

    def log_message(self, *args):
        pass


def test_a_gateway_that_is_slow_at_first_is_waited_for(monkeypatch):
    monkeypatch.setattr(transfer, "TIMEOUT", 0.2)
    server = ThreadingHTTPServer(("127.0.0.1", 0), Slow)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    heard = []
    gateway = transfer.Gateway(f"http://127.0.0.1:{server.server_port}", "token", heard.append)
    assert gateway.get("/v1/studies") == {"here": True}
    assert any("waiting" in told for told in heard)
    server.shutdown()
    server.server_close()
