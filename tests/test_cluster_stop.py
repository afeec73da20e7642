"""A stop while Ray starts, in a process that is connected to no other."""

import os
import signal
import socket
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import grpc
import pytest
import ray
from commandline import TINY, pup_process

from pup.errors import InputError
from workers import cluster
from workers.cluster import connected, staying


@pytest.mark.ray
@pytest.mark.parametrize("seconds", [0.1, 0.6, 1.2])
def test_a_stop_while_ray_starts_is_kept(seconds: float) -> None:
    """Ray's own answer to SIGTERM can be lost where its start raises it."""
    usual = signal.signal(signal.SIGTERM, signal.default_int_handler)
    timer = threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGTERM))
    timer.start()
    try:
        with pytest.raises(KeyboardInterrupt), connected(cores=1):
            time.sleep(60)
        assert signal.getsignal(signal.SIGTERM) is signal.default_int_handler
    finally:
        timer.cancel()
        signal.signal(signal.SIGTERM, usual)
    assert not ray.is_initialized()


@pytest.mark.ray
def test_ray_stays_for_the_jobs_that_follow_and_not_longer() -> None:
    seen = []
    with staying():
        assert not ray.is_initialized()
        for _ in range(2):
            with connected(cores=1):
                seen.append(ray.get_runtime_context().get_node_id())
    assert seen[0] == seen[1]
    assert not ray.is_initialized()


def test_a_machine_too_busy_for_ray_is_told_in_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ray gives up after half a minute with an exception that has no kind of its own."""

    def start(**_: object) -> None:
        raise Exception("The current node timed out during startup. This could happen because")

    monkeypatch.setattr(ray, "init", start)
    with pytest.raises(InputError, match="busy"), connected(cores=1):
        pass


def test_a_cluster_without_a_token_for_it_is_told_in_a_line(
    bench_recordings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    monkeypatch.setenv("HOME", str(tmp_path))  # where Ray would look for one
    for name in ("RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"):
        monkeypatch.delenv(name, raising=False)
    greeting = grpc.server(ThreadPoolExecutor(1))  # as any of Ray's does
    address = f"127.0.0.1:{greeting.add_insecure_port('127.0.0.1:0')}"
    greeting.start()
    given = ("presysid", bench_recordings, "--robot", "servo_bench", "--out", tmp_path / "out")
    done = pup_process(*given, *TINY[1:], "--address", address)
    greeting.stop(None)
    assert done.code == 2
    assert f"{address}: no token" in done.err and len(done.err.splitlines()) == 1


@pytest.mark.parametrize("scheme", ["", "ray://"])
def test_what_listens_and_is_no_cluster_is_told_in_a_line(
    monkeypatch: pytest.MonkeyPatch, scheme: str
) -> None:
    """Ray would wait for it for over ten minutes, and hear no Ctrl-C meanwhile."""
    monkeypatch.setattr(cluster, "GREETING_SECONDS", 1.0)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        address = f"{scheme}127.0.0.1:{listening.getsockname()[1]}"
        with pytest.raises(InputError, match="no Ray cluster answers there"), connected(address):
            pass
