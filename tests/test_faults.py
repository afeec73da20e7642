"""Whatever a job is stopped by, the same command finishes it with the same result.

Each test runs `pup presysid` as a user does, ends it somehow, and looks at what is left: on the
disk, among the processes, on the screen.
"""

import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import psutil
import pytest
from jobs import Job, until
from ray.cluster_utils import Cluster

pytestmark = [pytest.mark.ray, pytest.mark.slow]  # each kills and resumes whole command lines
BUDGET = (
    *("--actuator", "pd", "--no-comparison", "--population", 8, "--generations", 30),
    *("--subsets", 3, "--subset-generations", 10, "--cores", 2),
)
STOPPED = "pup presysid: stopped; the same command resumes\n"


def presysid(leg_recordings: Path, out: Path, *more: object) -> Job:
    command = ("presysid", leg_recordings, "--robot", "darwin_leg", *BUDGET, *more)
    return Job(*command, out=out)


def document(out: Path) -> Any:
    """What the job found, but for the time it took."""
    found = json.loads((out / "bounds.json").read_text())
    del found["provenance"]["seconds"]
    return found


def assert_progress_alone(err: str) -> None:
    for line in err.splitlines():
        assert line.startswith(("nominal fits: ", "subset fits: ")), line


@pytest.fixture(scope="module")
def wanted(leg_recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """What an undisturbed run finds, in one process."""
    out = tmp_path_factory.mktemp("undisturbed")
    code, _, err = presysid(leg_recordings, out, "--local").end()
    assert code == 0, err
    assert_progress_alone(err)
    return document(out)


def test_an_undisturbed_run_shows_its_progress_and_cleans_up(
    leg_recordings: Path, tmp_path: Path, wanted: Any
) -> None:
    job = presysid(leg_recordings, tmp_path)
    job.come_to("checkpoints/*.npz")
    code, out, err = job.end()
    job.assert_nothing_left()
    assert code == 0, err
    assert_progress_alone(err)
    assert len(out.splitlines()) == 1
    assert json.loads(out)["presysid"]["robot"] == "darwin_leg"
    assert document(tmp_path) == wanted


@pytest.mark.parametrize("where", ["ray", "local"])
def test_killed_again_and_again(
    leg_recordings: Path, tmp_path: Path, wanted: Any, where: str
) -> None:
    """SIGKILL leaves no time to clean up: the job's watcher does, and the next run goes on."""
    rng = random.Random(where)
    moments = ["checkpoints/*.npz", "checkpoints/subsets-*/*.npz"]
    if where == "ray":
        moments.insert(0, "ray")
    for moment in moments:
        job = presysid(leg_recordings, tmp_path, *(["--local"] if where == "local" else []))
        job.come_to(moment)
        time.sleep(rng.uniform(0, 0.5))
        job.process.kill()
        assert job.end()[0] in (-signal.SIGKILL, 0)
        job.assert_nothing_left()
        assert_checkpoints_whole(tmp_path)
    last = presysid(leg_recordings, tmp_path, *(["--local"] if where == "local" else []))
    code, _, err = last.end()
    assert code == 0, err
    last.assert_nothing_left()
    assert document(tmp_path) == wanted


def assert_checkpoints_whole(out: Path) -> None:
    for path in out.rglob("*.npz"):
        if not path.name.startswith("."):
            with np.load(path) as saved:
                assert len(saved["losses"]) > 0


@pytest.mark.parametrize("where", ["ray", "local"])
def test_stopped_and_resumed(leg_recordings: Path, tmp_path: Path, wanted: Any, where: str) -> None:
    """Ctrl-C reaches every process of the group, SIGTERM only the first."""
    local = ["--local"] if where == "local" else []
    stops: list[tuple[str, Callable[[Job], None]]] = [
        ("checkpoints/*.npz", lambda job: os.killpg(job.pid, signal.SIGINT)),
        ("checkpoints/subsets-*/*.npz", lambda job: job.process.terminate()),
    ]
    if where == "ray":
        stops.insert(0, ("ray", lambda job: job.process.terminate()))
        stops.insert(1, ("ray", lambda job: os.killpg(job.pid, signal.SIGINT)))
    for moment, stop in stops:
        job = presysid(leg_recordings, tmp_path, *local)
        job.come_to(moment)
        stop(job)
        code, out, err = job.end()
        assert code == 130, err
        assert out == ""
        assert err.endswith(STOPPED)
        assert_progress_alone(err.removesuffix(STOPPED))
        job.assert_nothing_left()
    last = presysid(leg_recordings, tmp_path, *local)
    code, _, err = last.end()
    assert code == 0, err
    assert document(tmp_path) == wanted


def test_sigterm_is_heard_in_the_background(leg_recordings: Path, tmp_path: Path) -> None:
    """A shell's background jobs ignore SIGINT; SIGTERM must still end them."""
    script = (
        f"{sys.executable} -m services.cli presysid {leg_recordings} --robot darwin_leg --local "
        f"--out {tmp_path} --generations 100000 & echo $!; wait $!; echo $?"
    )
    shell = subprocess.Popen(["sh", "-c", script], stdout=subprocess.PIPE, text=True)
    assert shell.stdout is not None
    pid = int(shell.stdout.readline())
    until(lambda: list(tmp_path.glob("checkpoints/*.npz")))
    os.kill(pid, signal.SIGTERM)
    assert shell.stdout.readline() == "130\n"
    shell.wait()


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A head without cores and two nodes with one each, all on this machine."""
    folder = Path(mkdtemp(prefix="pup-test-"))  # a short path: sockets lie below it
    (folder / "ray").mkdir()
    monkeypatch.setenv("RAY_TMPDIR", str(folder))
    store = {"object_store_memory": 80 * 2**20, "include_dashboard": False}
    quick = {"health_check_initial_delay_ms": 0, "health_check_period_ms": 1000}
    system = {**quick, "health_check_failure_threshold": 3, "worker_cap_enabled": False}
    made = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 0, "_system_config": system, **store}
    )
    try:
        made.workers = [made.add_node(num_cpus=1, **store) for _ in range(2)]
        yield made
    finally:
        made.shutdown()
        shutil.rmtree(folder, ignore_errors=True)


def test_a_lost_node_changes_nothing(
    leg_recordings: Path, tmp_path: Path, wanted: Any, cluster: Any
) -> None:
    job = presysid(leg_recordings, tmp_path, "--address", cluster.address)
    job.come_to("checkpoints/*.npz")
    cluster.remove_node(cluster.workers[0], allow_graceful=False)
    code, out, err = job.end()
    assert code == 0, err
    assert job.ray is None
    assert len(out.splitlines()) == 1
    assert document(tmp_path) == wanted
    # And a job that is stopped takes all of its own with it.
    again = presysid(leg_recordings, tmp_path / "again", "--address", cluster.address)
    again.come_to("checkpoints/*.npz")
    os.killpg(again.pid, signal.SIGINT)
    code, _, err = again.end()
    assert code == 130
    assert err.endswith(STOPPED)
    until(lambda: not {"ray::FitActor", "ray::evaluate"} & set(_children()), 30)


def _children() -> list[str]:
    """Titles of all processes below this one; the cluster's are."""
    names = []
    for process in psutil.Process().children(recursive=True):
        with suppress(psutil.Error):
            names.append(process.name())
    return names


@pytest.mark.parametrize("scheme", ["", "ray://"])
def test_no_cluster_at_the_address(leg_recordings: Path, tmp_path: Path, scheme: str) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"{scheme}127.0.0.1:{free.getsockname()[1]}"
        begin = time.monotonic()
        code, out, err = presysid(leg_recordings, tmp_path, "--address", address).end()
    assert code == 2
    assert out == ""
    (line,) = err.splitlines()
    assert address in line and "no Ray cluster answers" in line
    assert time.monotonic() - begin < 60
