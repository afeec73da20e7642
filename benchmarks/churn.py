"""Many short trials through the whole chain while all of it is killed and cut.

Gateway, agent and virtual robot are processes; every few seconds the gateway or the agent is
killed (SIGKILL), the link between them is cut for a while, or the gateway's database is locked.
Whoever has died is started again, and a trial that was cut off while the robot moved is, as an
operator would, asked for once more under a new attempt. At the end the histories of both sides are
compared: the gateway's trials and events, and the agent's journal.

    python -m benchmarks.churn forward/policy --trials 1000 --out churn
"""

import argparse
import json
import random
import socket
import sqlite3
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

from hardware_agent.journal import Journal
from pup.files import sha256, write_json
from pup.policy.bundle import CARD, NumpyPolicy
from pup.robot import RobotDescription
from pup.wire import without_mark
from services.laboratory import AGENT, Laboratory
from services.transfer import Gateway

STUDY = "churn"
LOOK = 0.3
"""Between two looks at the study, s."""
CUT, LOCK = (0.2, 4.0), (0.2, 8.0)
"""How long a link is cut and a database locked, s; SQLite gives up waiting after 5."""


class Cable:
    """What passes bytes on between the agent and the gateway, and can be cut.

    Args:
      port: of the gateway's link on this computer.
    """

    def __init__(self, port: int) -> None:
        self._port, self._until = port, 0.0
        self._ends: set[socket.socket] = set()
        self._door = socket.create_server(("127.0.0.1", 0))
        self.address = f"tcp://127.0.0.1:{self._door.getsockname()[1]}"
        threading.Thread(target=self._serve, daemon=True).start()

    def cut(self, seconds: float) -> None:
        """Drop all connections, and every new one until some time has passed."""
        self._until = time.monotonic() + seconds
        for end in list(self._ends):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def _serve(self) -> None:
        while True:
            near, _ = self._door.accept()
            try:
                if time.monotonic() < self._until:
                    raise ConnectionError
                far = socket.create_connection(("127.0.0.1", self._port), 1.0)
            except OSError:
                near.close()
                continue
            far.settimeout(None)
            for source, sink in ((near, far), (far, near)):
                self._ends.add(source)
                threading.Thread(target=self._pass, args=(source, sink), daemon=True).start()

    def _pass(self, source: socket.socket, sink: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(65536):
                sink.sendall(data)
        for end in (source, sink):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
        self._ends.discard(source)
        source.close()


class Churned(Laboratory):
    """A laboratory whose processes may end as often as they like, with a cable in its link."""

    restarts = 1_000_000

    def _config(self, gateway: str, keys: tuple[Path, Path]) -> str:
        self.cable = Cable(int(gateway.rpartition(":")[2]))
        return super()._config(self.cable.address, keys)

    def kill(self, name: str) -> None:
        """End a process as a power cut would."""
        self._processes[name].kill()

    def lock(self, seconds: float) -> None:
        """Keep everyone else from writing to the gateway's database."""
        file = self.folder / "gateway" / "gateway.db"
        with (
            closing(sqlite3.connect(file, timeout=10.0, isolation_level=None)) as store,
            suppress(sqlite3.OperationalError),
        ):
            store.execute("BEGIN EXCLUSIVE")
            time.sleep(seconds)
            store.execute("ROLLBACK")


class Faults(threading.Thread):
    """Does harm at random times until it is told to end."""

    def __init__(self, laboratory: Churned, mean: float, seed: int) -> None:
        super().__init__(daemon=True)
        self.count: Counter[str] = Counter()
        self.done = threading.Event()
        self._rng, self._mean = random.Random(seed), mean
        uniform = self._rng.uniform
        self._kinds: dict[str, Callable[[], None]] = {
            "gateway killed": lambda: laboratory.kill("gateway"),
            "agent killed": lambda: laboratory.kill("agent"),
            "link cut": lambda: laboratory.cable.cut(uniform(*CUT)),
            "database locked": lambda: laboratory.lock(uniform(*LOCK)),
        }

    def run(self) -> None:
        """Until `done`."""
        while not self.done.wait(self._rng.expovariate(1 / self._mean)):
            kind = self._rng.choice(sorted(self._kinds))
            self._kinds[kind]()
            self.count[kind] += 1


def churn(policy: Path, trials: int, mean: float, seed: int, out: Path) -> dict[str, Any]:
    """All trials, and what the histories say.

    Args:
      policy: a bundle.
      trials: that must succeed.
      mean: between two faults, s.
      seed: of faults and study.
      out: folder for stores, journals and logs; empty.
    """
    robot = RobotDescription.load("darwin_op2")
    card = NumpyPolicy.load(policy, robot).card
    settings = {
        "name": STUDY,
        "robot": card.robot,
        "policy": sha256(policy / CARD),
        "lower": list(card.eta_lower),
        "upper": list(card.eta_upper),
        "trials": trials,
        "initial": trials,
        "repeats": 0,
        "horizon": 0.5,
        "lease": 600.0,
        "failures": 1,
        "gate": "auto",
        "agent": AGENT,
        "seed": seed,
    }
    began = time.monotonic()
    with Churned(out, robot, policy, seed) as laboratory:
        gateway = Gateway(laboratory.url, laboratory.token, lambda _: laboratory.tend())
        gateway.post("/v1/studies", settings)
        faults = Faults(laboratory, mean, seed)
        faults.start()
        place, told = f"/v1/studies/{STUDY}", -1
        while (study := gateway.get(place))["state"] != "done":
            laboratory.tend()
            if study["state"] == "paused":
                again(gateway, place)
            if study["walks"] >= told + 10:
                told = study["walks"]
                print(f"{told} of {trials}, {time.monotonic() - began:.0f} s", flush=True)
            time.sleep(LOOK)
        faults.done.set()
        faults.join()
        laboratory.tend()
        counted = gateway.all(f"{place}/trials", "trials")
        history = gateway.all(f"{place}/history", "events")
    journal = Journal(out / "agent" / "journal").entries
    told = verdict(counted, history, journal, trials)
    return told | {"faults": dict(faults.count), "seconds": round(time.monotonic() - began)}


def again(gateway: Gateway, place: str) -> None:
    """Ask for the trial that was cut off once more."""
    last = gateway.all(f"{place}/trials", "trials")[-1]
    if last["state"] in ("aborted", "lost"):
        attempt = {"attempt": last["attempt"] + 1}
        gateway.post(f"{place}/trials/{last['number']}:retry", attempt)
    else:
        gateway.post(f"{place}:resume", None)


def verdict(
    trials: list[dict[str, Any]],
    history: list[dict[str, Any]],
    journal: list[dict[str, Any]],
    wanted: int,
) -> dict[str, Any]:
    """What both histories say of trials lost, executed twice and told twice."""
    journal = [e | {"trial": without_mark(e["trial"])} for e in journal if "trial" in e]
    moved = Counter((e["trial"], e["attempt"]) for e in journal if e["event"] == "running")
    ended = {(e["trial"], e["attempt"]): e["finished"] for e in journal if e["event"] == "finished"}
    succeeded = Counter(e["trial"] for e in history if e["kind"] == "succeeded")
    results = {t["id"]: t for t in trials if t["state"] == "succeeded"}
    walked = Counter(trial for (trial, _), end in ended.items() if end["state"] == "succeeded")
    agree = sum(
        ended[name, t["attempt"]]["distance"] == t["distance"] for name, t in results.items()
    )
    return {
        "trials": len(results),
        "motions": sum(moved.values()),
        "attempts": sum(t["attempt"] for t in trials),
        "lost": wanted - len(results) + len(walked.keys() - results.keys()),
        "executed_twice": sum(count > 1 for count in [*moved.values(), *walked.values()]),
        "told_twice": sum(count > 1 for count in succeeded.values()),
        "told_but_not_walked": len(results.keys() - walked.keys()),
        "distances_agree": agree == len(results),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policy", type=Path)
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument("--mean", type=float, default=4.0, help="between two faults, s")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    told = churn(given.policy, given.trials, given.mean, given.seed, given.out)
    write_json(given.out / "churn.json", told)
    print(json.dumps(told, indent=1))


if __name__ == "__main__":
    main()
