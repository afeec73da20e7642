"""Nodes of a real Ray cluster are killed and cut off while a stage runs on it.

A head without work and two workers of one core each, with token authentication; every worker in a
network namespace of its own (needs root and iproute2). A stage runs once undisturbed and then again
and again; meanwhile, in turn, a worker is killed with all of its processes, or its link goes down
until Ray takes it for dead. Each time another node takes its place. Told are the times from a
disturbance until the stage is further than before it, and until it is further with as many workers
as before; and whether each run ended as the undisturbed one.

    python -m benchmarks.nodes presysid --times 20 --out nodes

`kill` and `cut` take turns; `--times` is for each of them.
"""

import argparse
import json
import os
import secrets
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.kills import alike
from pup.files import read_json, write_json
from pup.robot import RobotDescription, TermSpec
from pup.robot_writer import write_corrected
from pup.sysid.virtual import record
from workers import reaper
from workers.cluster import RAY_SETTINGS

MARK = "PUP_NODE"
BRIDGE, NET = "pupbridge", "10.177.0"
START = 120.0
"""For a node to be there, s."""
CALM = 4.0
"""Between two disturbances, after the stage went on and the lost node was replaced, s."""
RECORDED = "step_0.1_0", "step_0.3_0", "step_0.6_0"
"""Of the recordings that come with darwin_op2: enough for a fit of a minute."""
STUCK = 300.0
"""After which a stage counts as stuck, s."""


def ip(*words: str, check: bool = True) -> None:
    """iproute2's command."""
    subprocess.run(["ip", *words], check=check, capture_output=not check)


@dataclass
class Cluster(AbstractContextManager["Cluster"]):
    """A head and workers, each behind a link of its own."""

    folder: Path
    token: str = field(default_factory=lambda: secrets.token_hex(16))
    born: int = 0
    workers: list[int] = field(default_factory=list)
    temp: Path = field(default_factory=lambda: Path(f"/tmp/pupn-{secrets.token_hex(3)}"))

    @property
    def address(self) -> str:
        """Of the head."""
        return f"{NET}.1:6399"

    @property
    def environment(self) -> dict[str, str]:
        """Of nodes, and of programs that use them."""
        return {
            **os.environ,
            **RAY_SETTINGS,
            "RAY_AUTH_MODE": "token",
            "RAY_AUTH_TOKEN": self.token,
            "RAY_USAGE_STATS_ENABLED": "0",
            "RAY_health_check_period_ms": "1000",
            "RAY_health_check_failure_threshold": "5",
            "RAY_health_check_timeout_ms": "3000",
            "OMP_NUM_THREADS": "1",
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        }

    def __enter__(self) -> "Cluster":
        self._clean()
        try:
            ip("link", "add", BRIDGE, "type", "bridge")
            ip("addr", "add", f"{NET}.1/24", "dev", BRIDGE)
            ip("link", "set", BRIDGE, "up")
            head = ("--head", "--port=6399", "--num-cpus=0", "--include-dashboard=false")
            self._start("head", (), f"{NET}.1", *head, f"--temp-dir={self.temp}")
            self.add()
            self.add()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for worker in list(self.workers):
            self.kill(worker)
        reaper.end(f"{MARK}=head", tries=300)
        shutil.rmtree(self.temp, ignore_errors=True)
        self._clean()

    def add(self) -> int:
        """Start a worker behind a link of its own."""
        self.born += 1
        number, inside = self.born, f"pupn{self.born}"
        ip("netns", "add", inside)
        ip("link", "add", f"pupv{number}", "type", "veth", "peer", "name", "eth0", "netns", inside)
        ip("link", "set", f"pupv{number}", "master", BRIDGE, "up")
        own = f"{NET}.{2 + number % 250}"
        for words in (
            ("addr", "add", f"{own}/24", "dev", "eth0"),
            ("link", "set", "eth0", "up"),
            ("link", "set", "lo", "up"),
        ):
            ip("-n", inside, *words)
        enter = ("ip", "netns", "exec", inside)
        self._start(f"w{number}", enter, own, f"--address={self.address}", "--num-cpus=1")
        self.workers.append(number)
        return number

    def kill(self, worker: int) -> None:
        """Kill a worker with all of its processes, as a loss of power does."""
        self.workers.remove(worker)
        assert reaper.end(f"{MARK}=w{worker}", tries=300)
        ip("netns", "del", f"pupn{worker}", check=False)

    def cut(self, worker: int) -> None:
        """Take a worker's link down; it is never up again."""
        ip("link", "set", f"pupv{worker}", "down")

    def _start(self, name: str, enter: tuple[str, ...], own: str, *arguments: str) -> None:
        with (self.folder / f"{name}.log").open("ab") as log:
            process = subprocess.Popen(
                [
                    *(*enter, sys.executable, "-m", "ray.scripts.scripts", "start", "--block"),
                    *(f"--node-ip-address={own}", "--object-store-memory=80000000"),
                    *("--disable-usage-stats", *arguments),
                ],
                env=self.environment | {MARK: name},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        ready, deadline = "Ray runtime started", time.monotonic() + START
        while ready not in (self.folder / f"{name}.log").read_text(errors="replace"):
            if process.poll() is not None or time.monotonic() > deadline:
                raise SystemExit(f"node {name} does not start, see {self.folder}/{name}.log")
            time.sleep(0.2)

    def _clean(self) -> None:
        """Remove what an earlier run left of the network."""
        for namespace in Path("/run/netns").glob("pupn*"):
            ip("netns", "del", namespace.name, check=False)
        for link in (*Path("/sys/class/net").glob("pupv*"), Path(BRIDGE)):
            ip("link", "del", link.name, check=False)


@dataclass(frozen=True)
class Stage:
    """A stage as it is run here.

    Attributes:
      command: of `pup`, without where it runs and writes.
      further: tells from its folder how far it is; more is further.
      found: what it found, to be compared; None where lost samples change it.
    """

    command: tuple[str, ...]
    further: Callable[[Path], float]
    found: Callable[[Path], Any] | None


def _written(pattern: str) -> Callable[[Path], float]:
    def further(out: Path) -> float:
        return max(map(_time, out.glob(pattern)), default=0.0)

    return further


def _time(file: Path) -> float:
    """When it was written; 0 of one that is gone by now, as a job tidies up at its end."""
    try:
        return file.stat().st_mtime
    except FileNotFoundError:
        return 0.0


def _document(name: str) -> Callable[[Path], Any]:
    return lambda out: alike(read_json(out / name))


def _logged(out: Path) -> float:
    """Bytes of the training's log for TensorBoard: it grows with each update."""
    return float(sum(file.stat().st_size for file in out.glob("tensorboard/**/events*")))


def stages(recordings: Path, friction: Path) -> dict[str, Stage]:
    """The stages that work on Ray."""
    robot = ("--robot", "darwin_op2")
    some = [str(recordings / f"{name}.parquet") for name in RECORDED]
    fits = ("--actuator", "pd", "--generations", "20", "--subsets", "6")
    fits += ("--subset-generations", "60", "--fraction", "0.5", "--no-comparison")
    return {
        "presysid": Stage(
            ("presysid", *some, *robot, *fits),
            _written("checkpoints/**/*.npz"),
            _document("bounds.json"),
        ),
        "diagnose": Stage(
            ("diagnose", str(friction), "--robot", "darwin_leg", "--effects", "3"),
            _written("checkpoints/*.f32"),
            _document("diagnosis.json"),
        ),
        "train": Stage(
            (
                "train",
                *robot,
                "--steps",
                "400000",
                "--pattern",
                "0",
                "--runners",
                "2",
                "--simulations",
                "64",
            ),
            _logged,
            None,
        ),
    }


def rubbing(folder: Path) -> None:
    """Record a leg whose joints rub, which its nominal model does not know."""
    leg = RobotDescription.load("darwin_leg")
    known = TermSpec("coulomb_friction", "group", leg.groups[0], {"torque": 0.1})
    rubs = write_corrected(leg, folder / "darwin_leg", {}, [known])
    record(rubs, ("step", "chirp"), folder / "recordings", seed=1, actuator="pd")


class Disturber:
    """Disturbs runs of a stage until each way was tried so often.

    Args:
      cluster: on which it runs.
      stage: what runs.
      times: of each way.
      out: folder for its runs.
    """

    def __init__(self, cluster: Cluster, stage: Stage, times: int, out: Path) -> None:
        self.cluster, self.stage, self.out = cluster, stage, out
        self.ways = ["kill", "cut"] * times
        self.recovered: dict[str, list[float]] = {}
        self.runs: list[dict[str, Any]] = []

    def run(self, name: str, disturbed: bool) -> Path:
        """One run of the stage to its end."""
        out = self.out / name
        with (self.out / f"{name}.log").open("ab") as log:
            begin = time.monotonic()
            process = subprocess.Popen(
                [
                    *(sys.executable, "-m", "services.cli", *self.stage.command),
                    *("--address", self.cluster.address, "--out", str(out)),
                ],
                env=self.cluster.environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )
            hits = self._disturb(process, out) if disturbed else 0
            code = process.wait()
        told = {"run": name, "code": code, "seconds": round(time.monotonic() - begin, 1)}
        self.runs.append(told | {"disturbed": hits})
        print(self.runs[-1], flush=True)
        return out

    def _disturb(self, process: "subprocess.Popen[bytes]", out: Path) -> int:
        hits = 0
        if not self._goes_on(process, out, 0.0):
            return hits
        while self.ways and process.poll() is None:
            way, worker = self.ways[0], self.cluster.workers[0]
            begin = time.monotonic()
            if way == "kill":
                self.cluster.kill(worker)
            else:
                self.cluster.cut(worker)
            before = self.stage.further(out)
            if not self._goes_on(process, out, before):
                break  # it ended first: that tells nothing of recovery
            self.ways.pop(0)
            hits += 1
            self._note(f"{way}, goes on", begin)
            if way == "cut":
                self.cluster.kill(worker)
            self.cluster.add()
            if self._goes_on(process, out, self.stage.further(out)):
                self._note(f"{way}, with as many workers as before", begin)
            with suppress(subprocess.TimeoutExpired):
                process.wait(CALM)
        for worker in self.cluster.workers[:-2]:
            self.cluster.kill(worker)
        while len(self.cluster.workers) < 2:
            self.cluster.add()
        return hits

    def _note(self, what: str, begin: float) -> None:
        seconds = time.monotonic() - begin
        self.recovered.setdefault(what, []).append(seconds)
        print(f"{what}: {seconds:.1f} s", flush=True)

    def _goes_on(self, process: "subprocess.Popen[bytes]", out: Path, before: float) -> bool:
        deadline = time.monotonic() + STUCK
        while self.stage.further(out) <= before:
            if process.poll() is not None:
                return False
            if time.monotonic() > deadline:
                process.kill()
                raise SystemExit(f"stuck for {STUCK:.0f} s, see {self.out}")
            time.sleep(0.05)
        return True


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("stage", choices=("presysid", "diagnose", "train"))
    parser.add_argument("--times", type=int, default=20, metavar="N", help="of each way")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--recordings", type=Path, default=Path("pup/robots/darwin_op2/recordings"))
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # nodes are ended then too
    out = options.out.absolute() / options.stage
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    if options.stage == "diagnose":
        rubbing(out / "leg")
    stage = stages(options.recordings.absolute(), out / "leg" / "recordings")[options.stage]
    with Cluster(out) as cluster:
        disturber = Disturber(cluster, stage, options.times, out)
        whole = disturber.run("undisturbed", disturbed=False)
        other = []
        while disturber.ways:
            name = f"run{len(disturber.runs)}"
            again = disturber.run(name, disturbed=True)
            if stage.found and stage.found(again) != stage.found(whole):
                other.append(name)
            if disturber.runs[-1]["code"]:
                other.append(f"{name}: failed")
                break
    told = {
        "stage": options.stage,
        "recovery_s": {
            what: {"count": len(s), "p50": np.median(s), "p95": np.quantile(s, 0.95), "max": max(s)}
            for what, s in disturber.recovered.items()
        },
        "runs": disturber.runs,
        "compared": stage.found is not None,
        "other": other,
    }
    write_json(out / "nodes.json", told)
    print(json.dumps(told, indent=1))
    raise SystemExit(bool(other))


if __name__ == "__main__":
    main()
