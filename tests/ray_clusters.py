"""Ray clusters for tests: `ray start` in processes of their own, with token authentication."""

import os
import secrets
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import httpx
from gateways import free_port

from workers import reaper
from workers.cluster import RAY_SETTINGS

MARK = "PUP_TEST_NODE"
"""Environment variable that every process of a node has, those of its jobs too."""
STARTED = "Ray runtime started"
"""What a node's log says once it has joined."""


def commands(words: str) -> list[int]:
    """Processes whose command line has these words."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            line = (process / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:
            continue
        if words in line and int(process.name) != os.getpid():
            found.append(int(process.name))
    return found


@dataclass
class RayCluster:
    """A head without work and workers, each of which can be killed as a whole."""

    folder: Path
    token: str = field(default_factory=lambda: secrets.token_hex(16))
    name: str = field(default_factory=lambda: secrets.token_hex(6))
    gcs: int = field(default_factory=free_port)
    dashboard: int = field(default_factory=free_port)
    nodes: list[str] = field(default_factory=list)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.dashboard}"

    @property
    def temp(self) -> Path:
        return Path("/tmp") / f"pup-{self.name}"  # sockets need short paths

    def start_head(self) -> None:
        more = (f"--port={self.gcs}", f"--dashboard-port={self.dashboard}", "--num-cpus=0")
        place = ("--node-ip-address=127.0.0.1", "--include-dashboard=true")
        self._start("head", "--head", *place, *more)

    def start_worker(self, number: int, cpus: int = 1, ip: str = "127.0.0.1") -> None:
        more = (f"--num-cpus={cpus}", f"--node-ip-address={ip}")
        self._start(f"worker{number}", f"--address=127.0.0.1:{self.gcs}", *more)

    def _answers(self) -> bool:
        """Whether the head's dashboard, which takes jobs, knows of a node."""
        headers = {"Authorization": f"Bearer {self.token}"}
        try:
            answer = httpx.get(f"{self.url}/nodes?view=summary", headers=headers, timeout=20)
            nodes = answer.json()["data"]["summary"]
        except (httpx.HTTPError, ValueError, KeyError):
            return False
        return any(node["raylet"].get("state") == "ALIVE" for node in nodes)

    def processes(self, node: str) -> list[int]:
        """Processes of a node, and of the jobs on it."""
        return reaper.marked(self._mark(node))

    def kill(self, node: str) -> None:
        """Kill a node with all that runs on it, as a loss of power does."""
        assert reaper.end(self._mark(node), tries=300), f"{node} cannot be killed"

    def close(self) -> None:
        for node in self.nodes:
            self.kill(node)
        shutil.rmtree(self.temp, ignore_errors=True)

    def _mark(self, node: str) -> str:
        return f"{MARK}={self.name}-{node}"

    def _start(self, node: str, *arguments: str) -> None:
        """Start a node; on a busy machine Ray gives up after a minute, so more than once."""
        log = self._log(node)
        for _ in range(4):
            before = len(log.read_text()) if log.exists() else 0
            process = self._process(node, arguments)
            while process.poll() is None:
                # Not by how many there are: one that was killed counts for a while.
                if STARTED in log.read_text()[before:] and self._answers():
                    return
                time.sleep(0.3)
            self.kill(node)
        raise AssertionError(f"{node} does not start: {self._log(node).read_text()}")

    def _process(self, node: str, arguments: tuple[str, ...]) -> "subprocess.Popen[bytes]":
        environment = {
            **os.environ,
            **RAY_SETTINGS,
            "RAY_AUTH_MODE": "token",
            "RAY_AUTH_TOKEN": self.token,
            "RAY_USAGE_STATS_ENABLED": "0",
            "RAY_health_check_period_ms": "1000",
            "RAY_health_check_failure_threshold": "6",
            "RAY_health_check_timeout_ms": "3000",
            "RAY_raylet_start_wait_time_s": "120",
            "RAY_DASHBOARD_STARTUP_TIMEOUT_S": "240",
            "RAY_gcs_rpc_server_reconnect_timeout_s": "10",
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            "OMP_NUM_THREADS": "1",
            MARK: f"{self.name}-{node}",
        }
        for name in ("RAY_AUTH_TOKEN_PATH", "RAY_ADDRESS", "PUP_SESSION"):
            environment.pop(name, None)
        command = [
            *(sys.executable, "-m", "ray.scripts.scripts", "start", "--block"),
            *("--object-store-memory=80000000", "--disable-usage-stats"),
            f"--dashboard-agent-listen-port={free_port()}",
            *((f"--temp-dir={self.temp}",) if "--head" in arguments else ()),
            *arguments,
        ]
        if node not in self.nodes:
            self.nodes.append(node)
        with open(self._log(node), "ab") as log:
            return subprocess.Popen(
                command,
                cwd=self.folder,
                env=environment,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    def _log(self, node: str) -> Path:
        return self.folder / f"{node}.log"


@contextmanager
def two_workers(folder: Path) -> Iterator[RayCluster]:
    """A head and two workers of two cores each, the second one at an address of its own."""
    made = RayCluster(folder)
    try:
        made.start_head()
        for number in (1, 2):
            made.start_worker(number, cpus=2, ip=f"127.0.0.{number}")
        yield made
    finally:
        made.close()
