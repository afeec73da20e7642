"""Jobs on a real Ray of three nodes with token authentication, through a real gateway."""

import functools
import json
import os
import shutil
import time

import pytest

pytest.importorskip("fastapi")
pytest.importorskip("botorch")

import gateways
import ray_clusters
from commandline import files, pup_process

pytestmark = [pytest.mark.ray, pytest.mark.timeout(2400)]
FIT = ("--robot", "servo_bench", "--actuator", "pd", "--no-comparison", "--population", "4")
FIT += ("--subsets", "2", "--subset-generations", "1", "--seed", "5")
SHORT, LONG, ENDLESS = ((*FIT, "--generations", n) for n in ("3", "60", "100000"))


@pytest.fixture(scope="module")
def shared(tmp_path_factory, bench_recordings):
    folder = tmp_path_factory.mktemp("shared")
    shutil.copytree(bench_recordings, folder / "recordings")
    return folder


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    with ray_clusters.two_workers(tmp_path_factory.mktemp("ray")) as made:
        yield made


@pytest.fixture(scope="module")
def service(tmp_path_factory, cluster, shared):
    folder = tmp_path_factory.mktemp("gateway")
    token = folder / "ray_token"
    token.write_text(cluster.token)
    told = {"RAY": cluster.url, "RAY_TOKEN": str(token), "SHARED": str(shared)}
    told["JOBS_AT_ONCE"] = "3"
    with gateways.running(folder / "data", **told) as made:
        os.environ["PUP_TOKEN"] = made.tokens["operator"]
        yield made
        del os.environ["PUP_TOKEN"]


def submitted(service, verb, *arguments, **more):
    asked = {"verb": verb, "arguments": list(arguments)} | more
    with service.client() as http:
        answer = http.post("/v1/jobs", json=asked)
    assert answer.status_code == 201, answer.text
    return answer.json()["id"]


def told(service, job):
    with service.client("viewer") as http:
        return http.get(f"/v1/jobs/{job}").json()


def wait_for(service, job, *states, seconds=600):
    end = time.monotonic() + seconds
    while (now := told(service, job))["state"] not in states:
        assert time.monotonic() < end, f"{now}\n{log_of(service, job)}"
        time.sleep(0.2)
    return now


def log_of(service, job):
    with service.client("viewer") as http:
        return http.get(f"/v1/jobs/{job}/logs").text


def wait_for_checkpoint(service, shared, job, seconds=600):
    """Until the job's verb has written down how far it is."""
    end = time.monotonic() + seconds
    while not list((shared / "jobs" / job / "out").glob("checkpoints/**/*.npz")):
        assert time.monotonic() < end, (told(service, job), log_of(service, job))
        time.sleep(0.2)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory, shared):
    """Gives what a fit finds in one process without Ray."""

    @functools.cache
    def alone(fit):
        out = tmp_path_factory.mktemp("alone")
        where = ("--local", "--cores", 1, "--out", out)
        done = pup_process("presysid", shared / "recordings", *fit, *where)
        assert done.code == 0, done.err
        return parameters(out)

    return alone


def parameters(out):
    return json.loads((out / "bounds.json").read_text())["parameters"]


def test_submit_watch_and_fetch_by_command(service, shared, undisturbed, tmp_path):
    where = ("--url", service.url)
    done = pup_process("submit", *where, "--wait", "--json", "presysid", "recordings", *SHORT)
    assert done.code == 0, done.err
    job = done.json()["job"]
    assert job["state"] == "succeeded" and len(job["attempts"]) == 1
    assert "attempt 1 on" in done.err and job["id"] in done.err
    listed = pup_process("jobs", "list", *where, "--json").json()["jobs"]
    assert job["id"] in [j["id"] for j in listed]
    assert "succeeded" in pup_process("jobs", "status", job["id"], *where).out
    assert pup_process("jobs", "logs", job["id"], "--follow", *where).out == log_of(
        service, job["id"]
    )
    out = tmp_path / "fetched"
    fetched = pup_process("jobs", "fetch", job["id"], "--out", out, *where)
    assert fetched.code == 0, fetched.err
    assert files(out) == {
        k: v for k, v in files(shared / "jobs" / job["id"] / "out").items() if "/." not in f"/{k}"
    }
    assert parameters(out) == undisturbed(SHORT)
    with service.client() as http:
        metrics = http.get("/metrics").text
    assert 'pup_jobs{state="succeeded"}' in metrics and "pup_ray_up 1.0" in metrics


def test_bad_input_is_told_and_not_tried_again(service, shared):
    (shared / "empty").mkdir(exist_ok=True)
    job = submitted(service, "presysid", "empty", *SHORT)
    now = wait_for(service, job, "failed", "succeeded")
    assert now["state"] == "failed" and len(now["attempts"]) == 1
    assert "empty" in now["reason"]


def test_cancel_leaves_nothing_behind(service, shared):
    job = submitted(service, "presysid", "recordings", *ENDLESS)
    wait_for_checkpoint(service, shared, job)
    assert ray_clusters.commands(f"jobs/{job}")
    done = pup_process("jobs", "cancel", job, "--url", service.url, "--json")
    assert done.code == 0 and done.json()["job"]["state"] == "cancelled", done
    end = time.monotonic() + 20
    while left := ray_clusters.commands(f"jobs/{job}"):
        assert time.monotonic() < end, left
        time.sleep(0.2)
    with service.client() as http:
        assert http.post(f"/v1/jobs/{job}:cancel").status_code == 409
    assert told(service, job)["attempts"][0]["outcome"]


def test_a_job_goes_on_while_the_gateway_is_away(service, shared):
    job = submitted(service, "presysid", "recordings", *SHORT, "--local", "--cores", "1")
    wait_for(service, job, "running", "waiting")
    service.kill()
    service.start()
    now = wait_for(service, job, "succeeded", "failed", "lost")
    assert now["state"] == "succeeded" and len(now["attempts"]) == 1, now


@pytest.mark.slow
def test_a_worker_that_dies_with_the_job_costs_one_attempt(service, cluster, shared, undisturbed):
    job = submitted(service, "presysid", "recordings", *LONG)
    wait_for_checkpoint(service, shared, job)
    (pid, *_) = ray_clusters.commands(f"services.job_runner {shared}/jobs/{job}")
    number = next(n for n in (1, 2) if pid in cluster.processes(f"worker{n}"))
    cluster.kill(f"worker{number}")
    try:
        now = wait_for(service, job, "succeeded", "failed", "lost", seconds=900)
        assert now["state"] == "succeeded" and len(now["attempts"]) == 2, now
        assert "lost" in now["attempts"][0]["outcome"]
        assert parameters(shared / "jobs" / job / "out") == undisturbed(LONG)
    finally:
        cluster.start_worker(number, cpus=2)


@pytest.mark.slow
def test_a_restarted_head_loses_no_job(service, cluster, shared, undisturbed):
    """Jobs that ended are told as they ended, one that ran resumes, one that waited is run."""
    done = submitted(service, "presysid", "recordings", *SHORT)
    wait_for(service, done, "succeeded")
    runs = submitted(service, "presysid", "recordings", *LONG)
    wait_for_checkpoint(service, shared, runs)
    waits = submitted(service, "presysid", "recordings", *SHORT, cpus=4)
    wait_for(service, waits, "waiting")
    cluster.kill("head")
    time.sleep(3)
    assert told(service, done)["state"] == "succeeded"
    assert "does not answer" in told(service, waits)["waits_for"]
    queued = submitted(service, "presysid", "recordings", *SHORT)
    assert told(service, queued)["state"] == "queued"
    for node in ("worker1", "worker2"):
        cluster.kill(node)
    cluster.start_head()
    cluster.start_worker(1, cpus=4)
    cluster.start_worker(2, cpus=2)
    for job in (runs, waits, queued):
        now = wait_for(service, job, "succeeded", "failed", "lost", seconds=900)
        assert now["state"] == "succeeded", now
    attempts = told(service, runs)["attempts"]
    assert len(attempts) == 2 and "does not know it any more" in attempts[0]["outcome"]
    for job, fit in ((runs, LONG), (done, SHORT), (waits, SHORT), (queued, SHORT)):
        assert parameters(shared / "jobs" / job / "out") == undisturbed(fit)
    assert told(service, done)["attempts"][0]["outcome"] == "done"
