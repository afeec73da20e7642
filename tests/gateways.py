"""Gateways for tests: a real `pup serve` in a process of its own, on free ports."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx

from services.gateway.keys import KeyRing, Role, Tokens

STUDY = {"robot": "darwin_op2", "policy": "a" * 64, "gate": "auto"}


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@dataclass
class Service:
    """A gateway's folder, ports and tokens; the process is started and killed by the tests."""

    data: Path
    port: int
    link_port: int
    tokens: dict[str, str]
    database: str = ""
    more: dict[str, str] = field(default_factory=dict)
    process: subprocess.Popen[bytes] | None = None

    @classmethod
    def make(cls, data: Path, database: str = "", **more: str) -> "Service":
        known = Tokens(data / "tokens.json")
        tokens = {role.name.lower(): known.create(role.name.lower(), role) for role in Role}
        return cls(data, free_port(), free_port(), tokens, database, more)

    @property
    def url(self) -> str:
        scheme = "https" if "CERTIFICATE" in self.more else "http"
        return f"{scheme}://127.0.0.1:{self.port}"

    @property
    def link(self) -> str:
        return f"tcp://127.0.0.1:{self.link_port}"

    def agent_keys(self, name: str) -> tuple[Path, Path]:
        out = self.data.parent / f"robot-{name}"
        return KeyRing(self.data / "curve").create_agent(name, out)

    def start(self) -> None:
        told = {"DATA": self.data, "PORT": self.port, "LINK": self.link, "DATABASE": self.database}
        told |= self.more
        environment = os.environ | {f"PUP_{k}": str(v) for k, v in told.items() if v}
        with open(self.data / "log.jsonl", "ab") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "services.cli", "serve"], env=environment, stderr=log
            )
        for _ in range(600):
            try:
                if httpx.get(f"{self.url}/readyz").status_code == 200:
                    return
            except httpx.HTTPError:
                pass
            if self.process.poll() is not None:
                raise AssertionError(f"the gateway ended: {(self.data / 'log.jsonl').read_text()}")
            time.sleep(0.05)
        raise AssertionError("the gateway does not start")

    def kill(self, number: int = signal.SIGKILL) -> int:
        assert self.process is not None
        self.process.send_signal(number)
        return self.process.wait(20)

    def client(self, role: str = "operator") -> httpx.Client:
        headers = {"Authorization": f"Bearer {self.tokens[role]}"}
        return httpx.Client(base_url=self.url, headers=headers, timeout=30)

    def trials(self, study: str) -> list[dict[str, Any]]:
        with self.client() as http:
            return http.get(f"/v1/studies/{study}/trials").json()["trials"]

    def wait_for(self, study: str, state: str = "done", seconds: float = 120) -> dict[str, Any]:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            try:
                with self.client() as http:
                    told = http.get(f"/v1/studies/{study}").json()
                if told["state"] == state:
                    return told
            except httpx.HTTPError:
                pass
            time.sleep(0.1)
        raise AssertionError(f"{study} is not {state}: {told}")


@contextmanager
def running(data: Path, **options: Any) -> Iterator[Service]:
    service = Service.make(data, **options)
    service.start()
    try:
        yield service
    finally:
        if service.process and service.process.poll() is None:
            service.kill()
