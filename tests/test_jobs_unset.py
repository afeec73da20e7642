"""A gateway that was started again without `ray` and `shared` leaves its jobs as they were."""

import gateways
import httpx
import pytest
import stored_jobs
from commandline import pup
from test_gateway import is_problem

pytest.importorskip("fastapi")
pytest.importorskip("botorch")

OPEN = ("job-running", "job-other")
ENDED = ("job-done", "job-failed", "job-lost", "job-cancelled")
MISSING = "a cluster: set ray and shared"


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    """Runs in a folder that has all files of the jobs, below an empty path so to say."""
    folder = tmp_path_factory.mktemp("unset")
    stored_jobs.keep(folder / "data", folder / "shared")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder / "shared")
        with gateways.running(folder / "data") as made:
            yield made


def kept(service):
    """What is told of all jobs."""
    with service.client() as http:
        return http.get("/v1/jobs").json()["jobs"]


def orders(service):
    """What their processes are told."""
    found = (service.data.parent / "shared" / "jobs").glob("*/order.json")
    return {file.parent.name: file.read_text() for file in found}


def test_jobs_that_were_open_wait_for_what_is_missing(service):
    told = {job["id"]: job for job in kept(service)}
    assert set(told) == {job.id for job in stored_jobs.ALL}
    for name, job in told.items():
        assert job["waits_for"] == (MISSING if name in OPEN else "")
        assert job["progress"] == ""  # its log is out of sight
    cookies = {"pup_token": service.tokens["viewer"]}
    assert f"Jobs wait for {MISSING}." in httpx.get(f"{service.url}/jobs", cookies=cookies).text


def test_nothing_is_called_off_or_tried_again(service):
    before, ordered = kept(service), orders(service)
    with service.client("admin") as http:
        for name in (*OPEN, *ENDED):
            for action, body in (("cancel", None), ("retry", {"attempt": 2})):
                answer = http.post(f"/v1/jobs/{name}:{action}", json=body)
                assert "this service has no Ray cluster" in is_problem(answer, 503)
        is_problem(http.post("/v1/jobs/absent:cancel"), 404)
    assert kept(service) == before and orders(service) == ordered


@pytest.mark.parametrize("name", ["job-done", "job-running"])
def test_no_file_of_a_job_is_looked_for_in_the_working_directory(service, name):
    with service.client() as http:
        for place in ("artifacts", "artifacts/bounds.json", "logs"):
            told = is_problem(http.get(f"/v1/jobs/{name}/{place}"), 503)
            assert "the shared storage is not set" in told
        is_problem(http.get("/v1/jobs/absent/artifacts"), 404)
    cookies = {"pup_token": service.tokens["viewer"]}
    for page in ("/", f"/jobs/{name}", "/bounds", f"/bounds/{name}", "/training", "/diagnoses"):
        answer = httpx.get(service.url + page, cookies=cookies)
        assert answer.status_code == 200 and "bounds.json" not in answer.text, page
    is_problem(httpx.get(f"{service.url}/reports/{name}/bounds.json", cookies=cookies), 503)


def test_who_fetches_is_told_in_a_line(service, monkeypatch, tmp_path):
    monkeypatch.setenv("PUP_TOKEN", service.tokens["operator"])
    done = pup("jobs", "fetch", "job-done", "--url", service.url, "--out", tmp_path / "out")
    assert done.code == 2 and "the shared storage is not set" in done.err
    assert len(done.err.splitlines()) == 1 and not (tmp_path / "out").exists()


def test_with_its_settings_back_it_goes_on(service):
    """The last one here: it starts the gateway again."""
    service.kill()
    service.more = {
        "RAY": f"http://127.0.0.1:{gateways.free_port()}",
        "SHARED": str(service.data.parent / "shared"),
    }
    service.start()
    with service.client() as http:
        states = {j["id"]: j["state"] for j in http.get("/v1/jobs").json()["jobs"]}
        assert states == {job.id: job.state.value for job in stored_jobs.ALL}
        assert len(http.get("/v1/jobs/job-done/artifacts").json()["artifacts"]) == 2
        assert http.get("/v1/jobs/job-done/logs").text.startswith("attempt 1 on node\n")
