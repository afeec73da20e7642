"""The gateway on PostgreSQL: a real server of its own, where one is installed."""

import asyncio
import os
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path

import pytest

pytest.importorskip("fastapi")
pytest.importorskip("botorch")
pytest.importorskip("psycopg", reason="PostgreSQL: pip install -c constraints.txt '.[postgresql]'")

import fake_agent
import gateways

from services.gateway.store import ReplacedError, Store

BINARIES = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
SERVER = BINARIES[-1].parent if BINARIES else None
STUDY = gateways.STUDY | {"name": "walk", "trials": 3, "initial": 2, "repeats": 1}


def as_server(*command):
    """A command of the server, which refuses to be root."""
    program = [str(SERVER / command[0]), *map(str, command[1:])]
    return ["runuser", "-u", "postgres", "--", *program] if os.geteuid() == 0 else program


@pytest.fixture(scope="module")
def url():
    if SERVER is None:  # a program of the system, which pip cannot bring; SQLite is tested always
        pytest.skip("no PostgreSQL server is installed: apt-get install postgresql")
    folder = Path(tempfile.mkdtemp(prefix="pg"))  # a socket's path must be short
    if os.geteuid() == 0:
        shutil.chown(folder, "postgres")
    data = folder / "data"
    subprocess.run(as_server("initdb", "-D", data, "-U", "pup", "-A", "trust"), check=True)
    running = subprocess.Popen(as_server("postgres", "-D", data, "-k", folder, "-h", ""))
    try:
        ready = as_server("pg_isready", "-h", folder, "-U", "pup")
        end = time.monotonic() + 30
        while subprocess.run(ready, stdout=subprocess.DEVNULL).returncode:
            assert time.monotonic() < end, "it does not start"
            time.sleep(0.1)
        yield f"postgresql+psycopg:///postgres?host={folder}&user=pup"
    finally:
        subprocess.run(as_server("pg_ctl", "-D", data, "-m", "immediate", "stop"))
        running.wait(20)
        shutil.rmtree(folder, ignore_errors=True)


def test_a_study_outlives_a_gateway_that_is_killed(url, tmp_path):
    with gateways.running(tmp_path / "data", database=url) as service:
        walk = fake_agent.walks(lambda eta: 0.8 - 0.1 * sum(x * x for x in eta))
        journal, keys = fake_agent.Journal(), service.agent_keys("one")
        with (
            service.client() as http,
            fake_agent.FakeAgent(*keys, service.link, walk, journal, pause=0.3),
        ):
            assert http.post("/v1/studies", json=STUDY).status_code == 201
            while not any(t["state"] == "succeeded" for t in service.trials("walk")):
                time.sleep(0.05)
            service.kill(signal.SIGKILL)
            time.sleep(3)  # the stand-in for an agent greets again after two seconds of silence
            service.start()
            service.wait_for("walk")
            trials = service.trials("walk")
        assert [t["state"] for t in trials] == ["succeeded"] * 4
        assert len(journal.walked) == 4, "none twice"


def test_the_gateway_that_came_last_writes(url):
    async def both():
        old, new = Store(url), Store(url)
        assert [study.name for study, _ in await new.studies()] == ["walk"]
        assert not await old.writable() and await new.writable()
        with pytest.raises(ReplacedError):
            await old.run(old._check)
        old.close()
        new.close()

    asyncio.run(both())
