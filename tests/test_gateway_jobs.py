"""The REST interface of jobs, on a real gateway whose Ray cluster is away."""

import asyncio
import json
import signal
import socket
import sqlite3
import subprocess
import sys
from contextlib import closing

import gateways
import httpx
import pytest
import stored_jobs
from commandline import files, pup
from test_gateway import is_problem

from services.gateway.dispatcher import _named
from services.gateway.jobs import JobState
from services.gateway.store import Store

pytest.importorskip("fastapi")
pytest.importorskip("botorch")

FIT = {"verb": "presysid", "arguments": ["recordings", "--robot", "servo_bench"]}
FIT_COMMAND = (FIT["verb"], *FIT["arguments"])
READS = ("/v1/jobs", "/v1/jobs/x", "/v1/jobs/x/logs", "/v1/jobs/x/artifacts", "/v1/jobs/-/events")
READS += ("/v1/jobs/x/artifacts/a", "/v1/jobs/x/events")
WRITES = ("/v1/jobs", "/v1/jobs/x:cancel", "/v1/jobs/x:retry")


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    folder = tmp_path_factory.mktemp("jobs")
    stored_jobs.keep(folder / "data", folder / "shared")
    (folder / "shared" / "recordings").mkdir()
    away = f"http://127.0.0.1:{gateways.free_port()}"
    with gateways.running(folder / "data", RAY=away, SHARED=str(folder / "shared")) as made:
        yield made


def shared(service):
    return service.data.parent / "shared"


def test_without_a_token_nothing_is_read_or_done(service):
    for path in READS:
        for headers in ({}, {"Authorization": "Bearer wrong"}):
            is_problem(httpx.get(service.url + path, headers=headers), 401)
    for path in WRITES:
        is_problem(httpx.post(service.url + path, json=FIT), 401)


def test_who_may_do_what(service):
    with service.client("viewer") as viewer, service.client("operator") as operator:
        assert viewer.get("/v1/jobs/job-done").status_code == 200
        for path in WRITES:
            is_problem(viewer.post(path, json=FIT | {"attempt": 2}), 403)
        told = is_problem(operator.post("/v1/jobs/job-other:cancel"), 403)
        assert "somebody-else's" in told
        is_problem(operator.post("/v1/jobs/absent:cancel"), 404)


@pytest.mark.parametrize(
    "change",
    [
        {"verb": "serve"},
        {"verb": "presysid; true"},
        {"arguments": ["recordings"]},
        {"arguments": ["../recordings", "--robot", "servo_bench"]},
        {"arguments": ["recordings", "--robot", "servo_bench", "--address", "x:1"]},
        {"arguments": "recordings"},
        {"arguments": ["x" * 2000]},
        {"arguments": ["x"] * 300},
        {"cpus": 0},
        {"cpus": "many"},
        {"gpus": -1},
        {"retries": 1000},
        {"entrypoint": "rm -rf /"},
    ],
)
def test_what_cannot_run_is_refused_at_once(service, change):
    with service.client() as http:
        before = len(http.get("/v1/jobs").json()["jobs"])
        is_problem(http.post("/v1/jobs", json=FIT | change), 422)
        assert len(http.get("/v1/jobs").json()["jobs"]) == before


def test_bodies_are_limited(service):
    with service.client() as http:
        big = b'{"verb": "' + b"x" * (5 * 2**20)
        headers = {"Content-Type": "application/json"}
        is_problem(http.post("/v1/jobs", content=big, headers=headers), 413)
        is_problem(http.post("/v1/jobs", content=b"not json", headers=headers), 422)


def test_a_job_waits_for_the_cluster_and_survives_a_restart(service):
    with service.client() as http:
        answer = http.post("/v1/jobs", json=FIT | {"cpus": 2, "retries": 1})
        assert answer.status_code == 201
        job = answer.json()
        assert answer.headers["location"] == f"/v1/jobs/{job['id']}"
        assert (job["state"], job["who"], job["cpus"]) == ("queued", "operator", 2.0)
        order = json.loads((shared(service) / "jobs" / job["id"] / "order.json").read_text())
        assert order["command"][:2] == ["presysid", "recordings"] and order["attempt"] == 0
    service.kill()
    service.start()
    with service.client() as http:
        again = http.get(f"/v1/jobs/{job['id']}").json()
        assert {k: again[k] for k in job if k != "waits_for"} == {
            k: v for k, v in job.items() if k != "waits_for"
        }
        cancelled = http.post(f"/v1/jobs/{job['id']}:cancel").json()
        assert cancelled["state"] == "cancelled" and "by operator" in cancelled["reason"]
        is_problem(http.post(f"/v1/jobs/{job['id']}:cancel"), 409)


def test_a_key_is_one_job(service):
    headers = {"Idempotency-Key": "fit-of-today"}
    with service.client() as http:
        first = http.post("/v1/jobs", json=FIT, headers=headers)
        second = http.post("/v1/jobs", json=FIT, headers=headers)
        assert first.json()["id"] == second.json()["id"]
        other = FIT | {"arguments": [*FIT["arguments"], "--seed", "2"]}
        is_problem(http.post("/v1/jobs", json=other, headers=headers), 409)
    service.kill()
    service.start()
    with service.client() as http, service.client("admin") as admin:
        assert http.post("/v1/jobs", json=FIT, headers=headers).json()["id"] == first.json()["id"]
        assert admin.post("/v1/jobs", json=FIT, headers=headers).json()["id"] != first.json()["id"]


def test_a_repeated_submission_is_answered_as_the_description_says(service):
    """Alike for a week, and then with what has become of the job."""
    headers = {"Idempotency-Key": "fit-of-last-week"}
    with service.client() as http:
        told = http.get("/openapi.json").json()["paths"]["/v1/jobs"]["post"]
        (key,) = (p for p in told["parameters"] if p["name"] == "Idempotency-Key")
        assert "for a week" in key["description"] and "same status" in key["description"]
        assert "answered so again" in told["responses"]["201"]["description"]
        assert "kept no longer" in told["responses"]["200"]["description"]
        first, again = (http.post("/v1/jobs", json=FIT, headers=headers) for _ in range(2))
        assert (first.status_code, again.status_code) == (201, 201)
        assert again.content == first.content
        assert "idempotent-replayed" not in first.headers
        assert again.headers["idempotent-replayed"] == "true"
        with closing(sqlite3.connect(service.data / "gateway.db")) as database, database:
            database.execute("DELETE FROM answers WHERE key = 'fit-of-last-week'")
        later = http.post("/v1/jobs", json=FIT, headers=headers)
        assert (later.status_code, later.json()["id"]) == (200, first.json()["id"])
        assert later.headers["location"] == first.headers["location"]


def test_a_job_that_runs_is_cancelled_without_the_cluster(service):
    """Its process reads the order; what it leaves in shared storage tells that it ended."""
    with service.client() as http:
        assert http.post("/v1/jobs/job-running:cancel").json()["state"] == "cancelling"
        order = shared(service) / "jobs" / "job-running" / "order.json"
        assert json.loads(order.read_text())["stop"]
        outcome = order.with_name("outcome-1.json")
        outcome.write_text('{"schema": 1, "attempt": 1, "exit": 130}')
        for _ in range(100):
            if (job := http.get("/v1/jobs/job-running").json())["state"] != "cancelling":
                break
            httpx.get(f"{service.url}/healthz")
        assert job["state"] == "cancelled"


def test_what_ended_without_a_result_can_be_tried_again_once(service):
    with service.client() as http:
        is_problem(http.post("/v1/jobs/job-done:retry", json={"attempt": 2}), 409)
        is_problem(http.post("/v1/jobs/job-lost:retry", json={"attempt": 3}), 409)
        job = http.post("/v1/jobs/job-lost:retry", json={"attempt": 2}).json()
        assert job["state"] == "queued" and "operator" in job["reason"]
        is_problem(http.post("/v1/jobs/job-lost:retry", json={"attempt": 2}), 409)


def test_logs_from_a_byte_on(service):
    with service.client("viewer") as http:
        whole = http.get("/v1/jobs/job-done/logs")
        assert whole.text.startswith("attempt 1 on node\n")
        assert whole.headers["content-type"].startswith("text/plain")
        assert http.get("/v1/jobs/job-done/logs", params={"offset": 8}).text == whole.text[8:]
        assert http.get("/v1/jobs/job-done/logs", params={"offset": 10**9}).text == ""
        followed = http.get("/v1/jobs/job-done/logs", params={"follow": "true"})
        assert followed.text == whole.text
        is_problem(http.get("/v1/jobs/job-done/logs", params={"offset": -1}), 422)


def test_a_log_is_followed_while_it_grows(service):
    log = shared(service) / "jobs" / "job-other" / "log.txt"
    path = "/v1/jobs/job-other/logs?follow=true"
    with service.client() as http, http.stream("GET", path) as answer:
        lines = answer.iter_lines()
        assert next(lines) == "attempt 1 on node"
        next(lines)
        with log.open("a") as file:
            file.write("generation 4\n")
        assert next(lines) == "generation 4"


def test_artefacts_by_name(service):
    with service.client("viewer") as http:
        listed = http.get("/v1/jobs/job-done/artifacts").json()["artifacts"]
        assert [a["name"] for a in listed] == ["bounds.json", "checkpoints/fit 1%.npz"]
        assert all(len(a["sha256"]) == 64 for a in listed)
        answer = http.get("/v1/jobs/job-done/artifacts/bounds.json")
        assert answer.json() == {"schema": 1}
        assert answer.headers["content-disposition"].startswith("attachment")
        part = http.get(
            "/v1/jobs/job-done/artifacts/checkpoints/fit 1%25.npz", headers={"Range": "bytes=1-3"}
        )
        assert (part.status_code, part.content) == (206, b"\x01\x02\x03")
        none = http.get("/v1/jobs/job-running/artifacts").json()
        assert none == {"artifacts": [], "next": None}


@pytest.mark.parametrize(
    ("asked", "status"),
    [("bytes=256000-", 416), ("bytes=300000-300001", 416), ("bytes=x", 400), ("x", 400)],
)
def test_a_range_that_cannot_be_had_is_a_problem(service, asked, status):
    """As all errors are, and beyond the end with the file's size, by which a client asks anew."""
    place = "/v1/jobs/job-done/artifacts/checkpoints/fit 1%25.npz"
    with service.client("viewer") as http:
        answer = http.get(place, headers={"Range": asked})
        assert repr(asked) in is_problem(answer, status)
        size = "bytes */256000" if status == 416 else None
        assert answer.headers.get("content-range") == size
        assert len(http.get(place, headers={"Range": "bytes=255999-"}).content) == 1
        told = http.get("/openapi.json").json()["paths"]["/v1/jobs/{job}/artifacts/{name}"]["get"]
        assert list(told["responses"]["416"]["content"]) == ["application/problem+json"]


@pytest.fixture(scope="module")
def many(service):
    """More files than a page of their list holds; those that pages look for come last."""
    out = shared(service) / "jobs" / "job-cancelled" / "out"
    for folder, names in (("a", range(10_000)), ("presysid", ["bounds.json"]), (".", ["z"])):
        (out / folder).mkdir(parents=True, exist_ok=True)
        for name in names:
            (out / folder / str(name)).touch()
    return "job-cancelled"


def test_artefacts_are_listed_in_pages(service, many):
    place = f"/v1/jobs/{many}/artifacts"
    with service.client("viewer") as http:
        first = http.get(place).json()
        assert len(first["artifacts"]) == 10_000 and first["next"] == "a/9998"
        second = http.get(place, params={"after": "a/9998"}).json()
        assert [a["name"] for a in second["artifacts"]] == ["a/9999", "presysid/bounds.json"]
        assert second["next"] is None
        few = http.get(place, params={"limit": 2}).json()
        assert ([a["name"] for a in few["artifacts"]], few["next"]) == (["z", "a/0"], "a/0")
        after = http.get(place, params={"limit": 1, "after": "a/00"}).json()  # as if it was removed
        assert [a["name"] for a in after["artifacts"]] == ["a/1"]
        is_problem(http.get(place, params={"limit": 0}), 422)


def test_no_artefact_is_left_out_of_what_is_fetched(service, many, where, tmp_path):
    done = pup("jobs", "fetch", many, "presysid/bounds.json", "--out", tmp_path, *where)
    assert done.code == 0, done.err
    assert set(files(tmp_path)) == {"presysid/bounds.json"}


def test_artefacts_are_fetched_whatever_their_names(service, where, tmp_path):
    names = {"a#1.json", "b?x=2.json", "c%41.json", "d e/f#&;=+@:~.json", "ü.json", "z.json"}
    for name in names:
        file = shared(service) / "jobs" / "job-failed" / "out" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(name)
    done = pup("jobs", "fetch", "job-failed", "--out", tmp_path, *where)
    assert done.code == 0, done.err
    assert set(files(tmp_path)) == names
    assert all((tmp_path / name).read_text() == name for name in names)


def test_the_page_of_a_job_shows_some_of_many_files(service, many):
    cookies = {"pup_token": service.tokens["viewer"]}
    shown = httpx.get(f"{service.url}/jobs/{many}", cookies=cookies).text
    assert shown.count(" download>") == 100 and "The first 100; all of them" in shown
    assert f"/bounds/{many}" in shown
    few = httpx.get(f"{service.url}/jobs/job-done", cookies=cookies).text
    assert few.count(" download>") == 2 and "all of them" not in few


ELSEWHERE = ("../order.json", "..%2forder.json", "%2e%2e/order.json", "/etc/hostname", "absent")
ELSEWHERE += ("%2fetc%2fhostname", "link", "checkpoints", "checkpoints/../bounds.json", "%00")


@pytest.mark.parametrize("name", (*ELSEWHERE, ".bounds.json.tmp"))
def test_names_lead_nowhere_else(service, name):
    """Sent as they are: clients would tidy them up."""
    request = f"GET /v1/jobs/job-done/artifacts/{name} HTTP/1.1\r\nHost: x\r\n"
    request += f"Authorization: Bearer {service.tokens['viewer']}\r\nConnection: close\r\n\r\n"
    with socket.create_connection(("127.0.0.1", service.port)) as made:
        made.sendall(request.encode())
        answer = b"".join(iter(lambda: made.recv(65536), b""))
    assert b" 404 " in answer.splitlines()[0], answer


def test_jobs_are_listed_in_pages_newest_first(service):
    with service.client() as http:
        whole = [j["id"] for j in http.get("/v1/jobs").json()["jobs"]]
        paged, after = [], ""
        while after is not None:
            page = http.get("/v1/jobs", params={"limit": 2, "after": after}).json()
            paged += [j["id"] for j in page["jobs"]]
            after = page["next"]
        assert paged == whole and len(whole) >= len(stored_jobs.ALL)
        done = http.get("/v1/jobs", params={"state": "succeeded"}).json()["jobs"]
        assert [j["id"] for j in done] == ["job-done"]
        is_problem(http.get("/v1/jobs", params={"state": "odd"}), 422)
        is_problem(http.get("/v1/jobs", params={"after": "absent"}), 404)


def test_metrics_tell_jobs_by_state(service):
    with service.client("viewer") as http:
        text = http.get("/metrics").text
    assert 'pup_jobs{state="succeeded"} 1.0' in text and "pup_ray_up 0.0" in text
    assert 'pup_job_attempts_total{state="cancelled"}' in text


def test_a_gateway_without_a_cluster_says_so(tmp_path):
    with gateways.running(tmp_path / "data") as made, made.client() as http:
        assert http.get("/v1/jobs").json() == {"jobs": [], "next": None}
        assert "no Ray cluster" in is_problem(http.post("/v1/jobs", json=FIT), 503)


@pytest.fixture
def where(service, monkeypatch):
    monkeypatch.setenv("PUP_TOKEN", service.tokens["operator"])
    return ("--url", service.url)


def test_the_command_line_submits_and_asks(service, where, tmp_path):
    given = ("--key", "of-mine", "--retries", 0, "presysid", "recordings", "--robot", "servo_bench")
    done = pup("submit", *where, "--json", *given)
    assert done.code == 0, done.err
    job = done.json()["job"]["id"]
    assert pup("submit", *where, "--json", *given).json()["job"]["id"] == job
    assert f"{service.url}/jobs/{job}" in pup("submit", *where, *given).out
    assert job in pup("jobs", "list", *where).out
    assert "queued" in pup("jobs", "status", job, *where).out
    assert pup("jobs", "cancel", job, *where, "--json").json()["job"]["state"] == "cancelled"
    assert pup("jobs", "retry", job, *where, "--json").json()["job"]["state"] == "queued"
    assert "generation 3" in pup("jobs", "logs", "job-done", *where).out
    out = tmp_path / "out"
    fetched = pup("jobs", "fetch", "job-done", "--out", out, *where)
    assert fetched.code == 0 and len(fetched.out.splitlines()) == 2
    assert set(files(out)) == {"bounds.json", "checkpoints/fit 1%.npz"}
    one = pup("jobs", "fetch", "job-done", "bounds.json", "--out", tmp_path / "one", *where)
    assert one.code == 0 and set(files(tmp_path / "one")) == {"bounds.json"}


def test_who_waits_no_longer_is_told_how_to_wait_again(service, where):
    given = ("--wait", "--key", "waited-for", *FIT_COMMAND)
    command = [sys.executable, "-m", "services.cli", "submit", *where, *given]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    job = process.stderr.readline().strip().rpartition("/")[2]
    process.send_signal(signal.SIGINT)
    _, told = process.communicate(timeout=60)
    assert process.returncode == 130
    assert told == f"pup submit: {job} goes on; pup jobs logs {job} --follow\n"
    with service.client() as http:
        assert http.post(f"/v1/jobs/{job}:cancel").json()["state"] == "cancelled"


def test_the_exit_code_tells_bad_input_from_other_ends(tmp_path, monkeypatch):
    ends = {
        "refused": (2, JobState.FAILED, {}),
        "failed": (1, JobState.FAILED, {"failures": 4}),
        "lost": (1, JobState.LOST, {"failures": 4}),
        "cancelled": (1, JobState.CANCELLED, {"cancelled_by": "operator"}),
    }
    stored_jobs.keep(tmp_path / "data", tmp_path / "shared")
    store = Store(f"sqlite:///{tmp_path / 'data' / 'gateway.db'}")
    for key, (_, state, more) in ends.items():
        job = stored_jobs.of("x", state, f"it was {key}", **more)
        asyncio.run(store.write_job(_named(job, key)))
    store.close()
    away = f"http://127.0.0.1:{gateways.free_port()}"
    with gateways.running(tmp_path / "data", RAY=away, SHARED=str(tmp_path / "shared")) as made:
        monkeypatch.setenv("PUP_TOKEN", made.tokens["operator"])
        for key, (code, state, _) in ends.items():
            given = ("--wait", "--key", key, "presysid", *stored_jobs.FIT)
            done = pup("submit", "--url", made.url, *given)
            assert done.code == code, done.err
            assert f"has {state}: it was {key}" in done.err.splitlines()[-1]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (("submit", "serve"), "cannot be a job"),
        (("submit", "presysid", "recordings"), "--robot"),
        (("submit", "presysid", "absent", "--robot", "servo_bench"), "not in the shared storage"),
        (("submit", "presysid", "x", "--robot", "servo_bench", "--out", "y"), "folder of its own"),
        (("submit", "--cpus", "0", "presysid"), "--cpus"),
        (("jobs", "status", "absent"), "there is no job absent"),
        (("jobs", "status", "../x"), "is no name"),
        (("jobs", "cancel", "job-done"), "succeeded"),
        (("jobs", "fetch", "job-done", "absent", "--out", "x"), "no artefact absent"),
        (("jobs", "odd"), "odd"),
    ],
)
def test_an_error_is_one_line(service, where, tmp_path, monkeypatch, given, words):
    monkeypatch.chdir(tmp_path)
    at = () if given[-1] == "odd" else where
    put = 2 if given[0] == "jobs" else 1
    done = pup(*given[:put], *at, *given[put:])
    last = done.err.strip().splitlines()[-1]
    assert done.code == 2 and words in last, done.err
    assert files(tmp_path) == {}


def test_a_wrong_token_and_a_gateway_that_is_away_are_one_line(service, where, monkeypatch):
    away = pup("jobs", "list", "--url", f"http://127.0.0.1:{gateways.free_port()}")
    monkeypatch.setenv("PUP_TOKEN", "wrong")
    wrong = pup("jobs", "list", *where)
    monkeypatch.delenv("PUP_TOKEN")
    none = pup("jobs", "list", *where)
    for done, words in ((away, "no gateway"), (wrong, "bearer token"), (none, "PUP_TOKEN")):
        assert done.code == 2 and len(done.err.splitlines()) == 1 and words in done.err
