"""Where a gateway listens: it takes nothing from one that runs, and waits for nobody for long."""

import asyncio
import os
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("fastapi")
pytest.importorskip("botorch")

import gateways
import httpx
import uvicorn
import zmq.auth
from fastapi import FastAPI
from fastapi.testclient import TestClient

from services.gateway import problems, sockets
from services.gateway.keys import KeyRing
from services.gateway.store import ReplacedError

SOON = 0.4
SLOW = 1.5
"""s; a busy machine may take a while from a connection to its request."""


def refused(data: Path, **told: object) -> str:
    """The line with which `pup serve` ends at once."""
    given = {"DATA": data, "PORT": gateways.free_port()} | told
    given.setdefault("LINK", f"tcp://127.0.0.1:{gateways.free_port()}")
    done = subprocess.run(
        [sys.executable, "-m", "services.cli", "serve"],
        env=os.environ | {f"PUP_{name}": str(value) for name, value in given.items()},
        capture_output=True,
        text=True,
        timeout=60,
    )
    lines = [line for line in done.stderr.splitlines() if not line.startswith("{")]
    assert (done.returncode, len(lines)) == (2, 1), done.stderr
    return lines[0]


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[gateways.Service]:
    with gateways.running(tmp_path_factory.mktemp("gateway") / "data") as made:
        yield made


@pytest.mark.parametrize("own", ["port", "link"])
def test_a_second_gateway_leaves_the_first_alone(service: gateways.Service, own: str) -> None:
    told = {"PORT": service.port} if own == "port" else {"LINK": service.link}
    assert "cannot be bound" in refused(service.data, **told)
    with service.client() as http:
        made = http.post("/v1/studies", json=gateways.STUDY | {"name": f"after-{own}"})
        assert made.status_code == 201, made.text
    assert httpx.get(f"{service.url}/readyz").status_code == 200


def test_a_number_longer_than_any_is_no_trial(service: gateways.Service) -> None:
    with service.client() as http:
        path = f"/v1/studies/s/trials/{'9' * 5000}:release"
        assert http.post(path).status_code == 404
        assert httpx.post(f"{service.url}{path}").status_code == 401
        assert http.get("/v1/studies").status_code == 200


def test_no_more_of_a_token_is_read_than_one_has(service: gateways.Service) -> None:
    told = httpx.post(f"{service.url}/login", content=b"token=" + 2000 * b"x")
    assert told.status_code == 413
    assert httpx.post(f"{service.url}/login", content=b"token=x").status_code == 401


@pytest.mark.parametrize(
    "damage",
    [
        "update studies set settings = '{bad'",
        "update studies set settings = '{}'",
        "update trials set state = 'frob'",
    ],
)
def test_a_damaged_database_is_told_in_a_line(
    service: gateways.Service, tmp_path: Path, damage: str
) -> None:
    with service.client() as http:
        http.post("/v1/studies", json=gateways.STUDY | {"name": "whole"})
    end = time.monotonic() + 60
    while not service.trials("whole"):
        assert time.monotonic() < end
        time.sleep(0.1)
    with sqlite3.connect(service.data / "gateway.db") as old:
        old.execute(f"vacuum into '{tmp_path / 'gateway.db'}'")
    with sqlite3.connect(tmp_path / "gateway.db") as copy:
        copy.execute(damage)
    assert "database: is damaged; restore a backup" in refused(tmp_path)


def test_a_database_in_memory_is_refused(tmp_path: Path) -> None:
    assert "keeps nothing; name a file" in refused(tmp_path, DATABASE="sqlite://")


def test_a_key_that_is_none_is_refused(tmp_path: Path) -> None:
    ring = KeyRing(tmp_path / "curve")
    ring.gateway()
    file = tmp_path / "curve" / "gateway.key_secret"
    file.write_text('curve\n    public-key = "abc"\n    secret-key = "def"\n')
    assert "no CURVE key; keys have 40 characters" in refused(tmp_path)


def test_an_odd_file_keeps_no_agent_out(tmp_path: Path) -> None:
    ring = KeyRing(tmp_path / "curve")
    ring.create_agent("op2", tmp_path / "robot")
    loop = ring.agents_folder / "loop.key"
    loop.symlink_to(loop)
    assert list(ring.stamp()) == ["op2.key"]
    public, _ = zmq.auth.load_certificate(ring.agents_folder / "op2.key")
    assert ring.agents() == {public: "op2"}


def test_one_that_was_replaced_says_so() -> None:
    app = FastAPI()
    problems.handle(app)

    @app.get("/")
    async def _() -> None:
        raise ReplacedError("another gateway was started")

    told = TestClient(app, raise_server_exceptions=False).get("/")
    assert (told.status_code, told.headers["Retry-After"]) == (503, "1")
    assert told.json()["detail"] == "another gateway was started"


@pytest.fixture
def patience() -> float:
    """How long the service waits for requests, s."""
    return SOON


@pytest.fixture
def port(monkeypatch: pytest.MonkeyPatch, patience: float) -> Iterator[int]:
    """Of a service that does not wait for requests for long, and answers some slowly."""
    monkeypatch.setattr(sockets, "SECONDS", patience)
    app = FastAPI()

    @app.get("/slow")
    async def _() -> str:
        await asyncio.sleep(2.5 * patience)
        return "done"

    bound = sockets.web_socket("127.0.0.1", 0)
    server = uvicorn.Server(uvicorn.Config(app, http=sockets.Impatient, log_level="error"))
    thread = threading.Thread(target=server.run, args=([bound],))
    thread.start()
    yield bound.getsockname()[1]
    server.should_exit = True
    thread.join(20)


@pytest.mark.parametrize(
    "part", [b"", b"GET /slow HT", b"POST /slow HTTP/1.1\r\nHost: a\r\nContent-Length: 9\r\n\r\nab"]
)
def test_a_request_that_does_not_come_is_not_waited_for(port: int, part: bytes) -> None:
    with socket.create_connection(("127.0.0.1", port), timeout=20) as silent:
        silent.sendall(part)
        began = time.monotonic()
        while silent.recv(4096):  # that of a POST where none is: answered, and closed then
            pass
        assert SOON / 2 < time.monotonic() - began < 10


@pytest.mark.parametrize("patience", [SLOW])
def test_a_slow_answer_is_waited_for(port: int) -> None:
    with httpx.Client(base_url=f"http://127.0.0.1:{port}") as http:
        for _ in range(2):
            assert http.get("/slow").json() == "done"
