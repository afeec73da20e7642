"""The gateway's REST interface, on a real server with a real database: who may, what is refused."""

import json
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import httpx
import psutil
import pytest

pytest.importorskip("fastapi")
pytest.importorskip("botorch")

import fake_agent
import gateways
from gateways import STUDY

from services.gateway.config import Config

READS = ("/v1/studies", "/v1/studies/x", "/v1/studies/x/trials", "/v1/studies/x/posterior")
READS += ("/v1/studies/x/history", "/v1/studies/x/events", "/v1/agents", "/metrics")
WRITES = ("/v1/studies", "/v1/studies/x:pause", "/v1/studies/x:resume", "/v1/agents/a:stop")
WRITES += tuple(f"/v1/studies/x/trials/1:{verb}" for verb in ("release", "retry", "cancel"))


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    with gateways.running(tmp_path_factory.mktemp("gateway") / "data") as made:
        yield made


def is_problem(answer, status):
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    told = answer.json()
    assert told["status"] == status and told["title"] and told["detail"]
    return told["detail"]


@pytest.mark.parametrize("path", READS)
def test_without_a_token_nothing_is_read(service, path):
    for headers in ({}, {"Authorization": "Bearer wrong"}, {"Authorization": "Basic YTpi"}):
        answer = httpx.get(service.url + path, headers=headers)
        is_problem(answer, 401)
        assert answer.headers["www-authenticate"] == "Bearer"


@pytest.mark.parametrize("path", WRITES)
def test_a_viewer_changes_nothing(service, path):
    with service.client("viewer") as http:
        is_problem(http.post(path, json={"reason": "x", "attempt": 2}), 403)
    is_problem(httpx.post(service.url + path, json={}), 401)


def test_the_body_of_a_stranger_is_not_even_read(service):
    """Else whoever reaches the port could keep the loop of robots and stops busy with it."""
    told = "{" + "x" * 100_000
    is_problem(httpx.post(service.url + "/v1/studies", content=told), 401)
    with service.client() as http:
        is_problem(http.post("/v1/studies", content=told), 422)


def test_probes_and_the_interface_need_no_token(service):
    assert httpx.get(f"{service.url}/healthz").text == "ok\n"
    assert httpx.get(f"{service.url}/readyz").text == "ready\n"
    told = httpx.get(f"{service.url}/openapi.json").json()
    wanted = {"/v1/studies", "/v1/studies/{study}", "/v1/studies/{study}/trials"}
    assert wanted | {"/v1/studies/{study}/posterior"} <= set(told["paths"])
    for path, verbs in told["paths"].items():
        if path.startswith("/v1"):
            for verb in verbs.values():
                assert verb["security"] and "401" in verb["responses"], path
            if "post" in verbs:  # the database may take nothing; a stop does not wait for it
                assert ("503" in verbs["post"]["responses"]) == (not path.endswith(":stop")), path
                if "post" in verbs:
                    assert not verbs.get("post") or any(
                        p["name"] == "Idempotency-Key" for p in verbs["post"]["parameters"]
                    )


def test_a_study_is_made_once_and_joined(service):
    asked = STUDY | {"name": "once", "gate": "operator"}
    with service.client() as http:
        first = http.post("/v1/studies", json=asked)
        assert first.status_code == 201 and first.headers["location"] == "/v1/studies/once"
        assert http.post("/v1/studies", json=asked).status_code == 200
        assert "other settings" in is_problem(
            http.post("/v1/studies", json=asked | {"seed": 9}), 409
        )
        assert http.get("/v1/studies/once").json()["settings"]["trials"] == 25


@pytest.mark.parametrize(
    ("told", "pauses_after"),
    [({}, 1), ({"gate": "auto"}, 3), ({"failures": None}, 1), ({"gate": "auto", "failures": 5}, 5)],
)
def test_the_gate_tells_how_many_failures_pause_a_study(service, told, pauses_after):
    """Whoever asks without `pup transfer` gets the same: an operator looks at each failure."""
    named = {"name": "patient-" + "-".join(map(str, told.values())).lower() + "-"}
    asked = {k: v for k, v in STUDY.items() if k != "gate"} | told | named
    with service.client() as http:
        assert http.post("/v1/studies", json=asked).status_code == 201
        settings = http.get(f"/v1/studies/{named['name']}").json()["settings"]
        assert settings["failures"] == pauses_after
        again = http.post("/v1/studies", json=asked | {"failures": pauses_after})
        assert again.status_code == 200, "the same study, told in full"


@pytest.mark.parametrize(
    "wrong",
    [
        {"name": "../etc"},
        {"name": ""},
        {"policy": "abc"},
        {"trials": 0},
        {"trials": "many"},
        {"horizon": 1e9},
        {"lower": [1, 1, 1]},
        {"lower": [0, 0]},
        {"compare": [[0, 0]]},
        {"initial": 0},
        {"initial": 26},
        {"initial": 5, "trials": 4},
        {"unknown": 1},
        {"gate": "none"},
        {"seed": -1},
        {"simulated": {"eta": [[0, 0, 0], [1, 1, 1]], "distance": [[1, 2, 3]]}},
        {"simulated": {"eta": [[0, 0], [1, 1]], "distance": [[1, 2]]}},
        {"seed": False},
        {"trials": "5"},
        {"trials": 5.5},
        {"horizon": "15"},
        {"warm_start": 1},
    ],
)
def test_studies_that_cannot_be_are_refused(service, wrong):
    with service.client() as http:
        is_problem(http.post("/v1/studies", json=STUDY | {"name": "wrong"} | wrong), 422)


def test_of_few_trials_all_are_initial(service):
    """What was not asked for is never refused: the usual number is five."""
    with service.client() as http:
        for name, trials, initial in (("few", 3, 3), ("many", 8, 5)):
            made = http.post("/v1/studies", json=STUDY | {"name": name, "trials": trials})
            assert (made.status_code, made.json()["settings"]["initial"]) == (201, initial)


def test_a_whole_number_may_be_written_with_a_point(service):
    asked = b'{"name": "point", "robot": "darwin_op2", "policy": "%s", "trials": 5.0}' % (b"a" * 64)
    with service.client() as http:
        headers = {"Content-Type": "application/json"}
        made = http.post("/v1/studies", content=asked, headers=headers)
        assert (made.status_code, made.json()["settings"]["trials"]) == (201, 5)


@pytest.mark.parametrize(
    "body", [b"", b"{", b"[]", b"null", b'{"name": NaN}', b"\xff\xfe", b"[" * 5000]
)
def test_bodies_that_are_no_json_are_refused(service, body):
    with service.client() as http:
        headers = {"Content-Type": "application/json"}
        answer = http.post("/v1/studies", content=body, headers=headers)
        is_problem(answer, 400 if body.startswith(b"[[") else 422)


def test_bodies_that_are_too_large_or_without_an_end_are_refused(service):
    with service.client() as http:
        is_problem(http.post("/v1/studies", content=b" " * (5 * 2**20)), 413)
        is_problem(http.post("/v1/studies", content=iter([b" "] * 3)), 411)


def test_what_is_not_there_is_told(service):
    with service.client() as http:
        assert "no study nowhere" in is_problem(http.get("/v1/studies/nowhere"), 404)
        is_problem(http.post("/v1/agents/nobody:stop", json={"reason": "x"}), 404)
        http.post("/v1/studies", json=STUDY | {"name": "short", "gate": "operator"})
        missing = http.post("/v1/studies/short/trials/99:release")
        assert "has no trial 99" in is_problem(missing, 404)
        is_problem(http.get("/v1/none"), 404)
        is_problem(http.put("/v1/studies"), 405)
        assert http.options("/v1/studies").headers["allow"] == "GET, POST"
        assert http.get("/v1/studies/x:pause").headers["allow"] == "POST"


def test_the_same_key_is_carried_out_once(service):
    asked, key = STUDY | {"name": "keyed"}, {"Idempotency-Key": "k-1"}
    with service.client() as http:
        first = http.post("/v1/studies", json=asked, headers=key)
        again = http.post("/v1/studies", json=asked, headers=key)
        assert (again.status_code, again.content) == (first.status_code, first.content)
        assert again.headers["idempotent-replayed"] == "true"
        assert again.headers["location"] == first.headers["location"] == "/v1/studies/keyed"
        other = http.post("/v1/studies", json=asked | {"name": "other"}, headers=key)
        assert "another request" in is_problem(other, 409)
        assert http.get("/v1/studies/other").status_code == 404
        is_problem(
            http.post("/v1/studies", json=asked, headers={"Idempotency-Key": "x" * 200}), 422
        )
    with service.client("admin") as http:  # somebody else's key is another one
        assert http.post("/v1/studies", json=asked, headers=key).status_code == 200
        replay = {"Idempotency-Key": "k-1", "Authorization": "Bearer wrong"}
    is_problem(httpx.post(f"{service.url}/v1/studies", json=asked, headers=replay), 401)


def test_studies_come_in_pages(service):
    with service.client() as http:
        for name in ("page-a", "page-b", "page-c"):
            http.post("/v1/studies", json=STUDY | {"name": name, "gate": "operator"})
        seen, after = [], ""
        while after is not None:
            page = http.get("/v1/studies", params={"limit": 2, "after": after}).json()
            seen += [s["name"] for s in page["studies"]]
            after = page["next"]
    assert seen == sorted(set(seen)) and {"page-a", "page-b", "page-c"} <= set(seen)


def test_answers_forbid_browsers_what_pages_do_not_need(service):
    headers = httpx.get(f"{service.url}/login").headers
    assert "default-src 'self'" in headers["content-security-policy"]
    assert headers["x-content-type-options"] == "nosniff" and headers["cache-control"] == "no-store"


def test_a_cookie_alone_changes_nothing(service):
    """What a foreign page could make a browser send."""
    cookies = {"pup_token": service.tokens["operator"]}
    assert httpx.get(f"{service.url}/v1/studies", cookies=cookies).status_code == 200
    answer = httpx.post(f"{service.url}/v1/studies", json=STUDY | {"name": "csrf"}, cookies=cookies)
    is_problem(answer, 401)


def test_a_token_that_is_revoked_ends_at_once(service):
    from services.gateway.keys import Role, Tokens

    tokens = Tokens(service.data / "tokens.json")
    headers = {"Authorization": f"Bearer {tokens.create('guest', Role.VIEWER)}"}
    assert httpx.get(f"{service.url}/v1/studies", headers=headers).status_code == 200
    tokens.revoke("guest")
    is_problem(httpx.get(f"{service.url}/v1/studies", headers=headers), 401)
    stored = (service.data / "tokens.json").read_text()
    assert headers["Authorization"][7:] not in stored
    assert (service.data / "tokens.json").stat().st_mode & 0o077 == 0


def test_a_file_of_tokens_that_is_torn_keeps_nobody_from_stopping_a_robot(service):
    file = service.data / "tokens.json"
    whole = file.read_text()
    with service.client() as http:
        assert http.get("/v1/studies").status_code == 200
        file.write_text(whole[: len(whole) // 2])
        try:
            told = is_problem(http.post("/v1/agents/nobody:stop", json={"reason": "smoke"}), 404)
            assert "nobody" in told
        finally:
            file.write_text(whole)
        assert http.get("/v1/studies").status_code == 200
    log = (service.data / "log.jsonl").read_text().splitlines()
    assert sum("tokens cannot be read" in line for line in log) == 1


def test_an_operator_holds_the_gate(service):
    """Nothing goes to the robot before it is released; stop pauses the study."""
    keys = service.agent_keys("gate-1")
    walk = fake_agent.walks(lambda eta: 0.5)
    asked = STUDY | {"name": "gated", "gate": "operator", "agent": "gate-1", "trials": 2}
    with service.client() as http, fake_agent.FakeAgent(*keys, service.link, walk) as agent:
        http.post("/v1/studies", json=asked | {"initial": 2, "repeats": 0})
        until(lambda: http.get("/v1/studies/gated").json()["open"] == 1)
        time.sleep(1.5)
        assert not [t for t in agent.journal.walked if t[0].startswith("gated/")]
        assert "operator" in http.get("/v1/studies/gated").json()["waits_for"]
        assert http.post("/v1/studies/gated/trials/1:release").status_code == 200
        assert http.post("/v1/studies/gated/trials/1:release").status_code in (200, 409)
        until(lambda: http.get("/v1/studies/gated").json()["walks"] == 1)
        stop = partial(http.post, "/v1/agents/gate-1:stop", json={"reason": "smoke"})
        until(lambda: stop().status_code == 202)  # 409 while the robot has not said that it did
        assert agent.state == "stopped"
        until(lambda: "stopped" in [a["state"] for a in http.get("/v1/agents").json()["agents"]])
        until(lambda: http.get("/v1/studies/gated").json()["state"] == "paused")
        assert http.post("/v1/studies/gated:resume").status_code == 200
        until(lambda: http.get("/v1/studies/gated").json()["open"] == 2)
        assert http.post("/v1/studies/gated/trials/2:release").status_code == 200
        until(lambda: "is stopped" in http.get("/v1/studies/gated").json()["waits_for"])
        answer = http.post("/v1/studies/gated/trials/2:cancel")
        assert answer.json()["state"] == "aborted" and "cancelled by operator" in answer.text
        told = http.get("/v1/studies/gated").json()
        assert told["state"] == "paused" and "cancelled" in told["reason"]
        is_problem(http.post("/v1/studies/gated/trials/1:retry", json={"attempt": 2}), 409)
        is_problem(http.post("/v1/studies/gated/trials/2:retry", json={"attempt": 5}), 409)
        for _ in range(2):
            again = http.post("/v1/studies/gated/trials/2:retry", json={"attempt": 2})
            assert again.json()["attempt"] == 2
        agent.state = fake_agent.AgentState.ENABLED
        service.wait_for("gated")
        told = [(t[0].partition(".")[0], t[1]) for t in agent.journal.walked]
        walked = [t for t in told if t[0].startswith("gated/")]
        assert walked == [("gated/1", 1), ("gated/2", 2)]


def until(true, seconds=90):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "it does not come true"
        time.sleep(0.05)


def test_a_whole_study_tells_why_it_decided(service):
    keys = service.agent_keys("whole-1")
    walk = fake_agent.walks(lambda eta: 0.8 - 0.2 * sum((x - 0.3) ** 2 for x in eta))
    asked = STUDY | {"name": "whole", "agent": "whole-1", "trials": 7, "repeats": 2}
    with service.client() as http, fake_agent.FakeAgent(*keys, service.link, walk):
        made = http.post("/v1/studies", json=asked | {"compare": [[0, 0, 0]]})
        assert made.status_code == 201, made.text
        done = service.wait_for("whole")
        trials = service.trials("whole")
        purposes = [t["purpose"] for t in trials]
        assert purposes == ["initial"] * 5 + ["search"] * 2 + ["repeat", "compare"] * 2
        assert all(t["state"] == "succeeded" for t in trials)
        assert [t["eta"] for t in trials[7:]] == [done["chosen"], [0, 0, 0]] * 2
        history = http.get("/v1/studies/whole/history").json()["events"]
        decisions = [e["detail"] for e in history if e["kind"] in ("requested", "chosen")]
        assert [d["walks"] for d in decisions[:8]] == list(range(8))
        assert "posterior mean" in decisions[7]["why"] and decisions[6]["hyperparameters"]
        posterior = http.get("/v1/studies/whole/posterior").json()
        assert len(posterior["slices"]) == 3 and posterior["best"]["walks"] == 11
        metrics = http.get("/metrics").text
        assert 'pup_agent_health{agent="whole-1",name="temperature"} 41.5' in metrics
        assert "pup_suggest_seconds_count" in metrics


def test_untold_it_listens_on_loopback_alone(service):
    own = psutil.Process(service.process.pid)
    heard = {c.laddr.ip for c in own.net_connections() if c.status == psutil.CONN_LISTEN}
    assert heard == {"127.0.0.1"}
    assert Config().loopback and Config().link.startswith("tcp://127.0.0.1:")


def test_the_log_is_json_and_holds_no_token(service):
    lines = (service.data / "log.jsonl").read_text().splitlines()
    assert all({"time", "level", "message"} <= set(json.loads(line)) for line in lines)
    assert not any(token in line for line in lines for token in service.tokens.values())


def test_reads_do_not_wait_for_a_fit(service):
    """Many reads beside a study that is under way; the bar of p99 is measured in the benchmark."""
    keys = service.agent_keys("busy-1")
    walk = fake_agent.walks(lambda eta: 0.5 + 0.1 * eta[0])
    asked = STUDY | {"name": "busy", "agent": "busy-1", "trials": 9, "repeats": 0}
    with service.client() as http, fake_agent.FakeAgent(*keys, service.link, walk):
        http.post("/v1/studies", json=asked)

        def read(_):
            began = time.perf_counter()
            assert http.get("/v1/studies/busy").status_code == 200
            return time.perf_counter() - began

        with ThreadPoolExecutor(4) as pool:
            spent = sorted(pool.map(read, range(300)))
        assert spent[len(spent) // 2] < 0.25
        service.wait_for("busy")
