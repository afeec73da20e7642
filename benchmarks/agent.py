"""The agent against the virtual robot's bus: how regular its loop is, and how soon it lets go.

    python -m benchmarks.agent jitter --minutes 10
    python -m benchmarks.agent stops --repeats 100

Between agent and robot sits a tap: two pseudo-terminals whose bytes are passed on and whose packets
are noted with their time. Times are therefore those of the bus and not of a log. A stop is measured
from the moment the fault is caused (the command to the virtual robot has been sent, or the signal)
to the first packet that turns torque off. Where the fault is evidence that builds up (a fall, a
stuck encoder, an overload), from the first byte of the question whose answers completed it.
"""

import argparse
import contextlib
import json
import os
import platform
import select
import signal
import sys
import tempfile
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from agents import Lab, lab, wait

from hardware_agent.control import Unreachable
from pup.errors import InputError

PERIOD = 1 / 33
TORQUE, GOAL = 24, 30  # registers of Protocol 1.0
SYNC_WRITE, BULK_READ = 0x83, 0x92

STRICT = """[bus]
timeout = 0.004
[imu]
timeout = 0.004
[safety]
late = 0.15
stale = 0.02
[watchdog]
timeout = 0.3
"""
"""The defaults that tests on a busy machine soften."""


@dataclass
class Tap:
    """Two ends of a bus and what went between them.

    Attributes:
      outer: link for the agent.
      inner: the virtual robot's own.
      goals: times of goals, s of CLOCK_MONOTONIC.
      offs: of torque off.
      questions: of bulk reads.
    """

    outer: Path
    inner: Path
    goals: list[float] = field(default_factory=list)
    offs: list[float] = field(default_factory=list)
    questions: list[float] = field(default_factory=list)
    ending: bool = False

    def __post_init__(self) -> None:
        self._master, slave = os.openpty()
        tty.setraw(self._master)
        tty.setraw(slave)
        self.outer.unlink(missing_ok=True)
        self.outer.symlink_to(os.ttyname(slave))
        self._far = os.open(self.inner, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self._far)
        settings = termios.tcgetattr(self._far)
        settings[4] = settings[5] = termios.B1000000
        termios.tcsetattr(self._far, termios.TCSANOW, settings)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        left = b""
        while not self.ending:
            ready, _, _ = select.select([self._master, self._far], [], [], 0.2)
            for one in ready:
                try:
                    data = os.read(one, 4096)
                    other = self._far if one == self._master else self._master
                    os.write(other, data)
                except OSError:
                    continue
                if one == self._master:
                    left = self._note(left + data, time.monotonic())

    def _note(self, data: bytes, now: float) -> bytes:
        while (start := data.find(b"\xff\xff\xfe")) >= 0 and len(data) >= start + 7:
            size = data[start + 3] + 4
            if len(data) < start + size:
                return data[start:]
            packet = data[start : start + size]
            if packet[4] == BULK_READ:
                self.questions.append(now)
            elif packet[4] == SYNC_WRITE and packet[5] == GOAL:
                self.goals.append(now)
            elif packet[4] == SYNC_WRITE and packet[5] == TORQUE and packet[8] == 0:
                self.offs.append(now)
            data = data[start + size :]
        return data[-250:]

    def close(self) -> None:
        """Stop listening."""
        self.ending = True
        self._thread.join()
        os.close(self._master)
        os.close(self._far)


@contextlib.contextmanager
def tapped(folder: Path, more: str = STRICT) -> Iterator[tuple[Lab, Tap]]:
    """A lab with a tap in its bus."""
    with lab(folder, more=more + f'[bus]\nport = "{folder}/tap"\n') as made:
        tap = Tap(folder / "tap", folder / "bus")
        try:
            yield made, tap
        finally:
            made.end()
            tap.close()


def jitter(minutes: float) -> dict[str, Any]:
    """Periods between goals on the bus while the robot holds its pose."""
    with tempfile.TemporaryDirectory() as name, tapped(Path(name)) as (made, tap):
        made.start()
        enable(made)
        time.sleep(2.0)
        tap.goals.clear()
        before = made.health()["loop"]["missed"]
        time.sleep(60 * minutes)
        told = made.health()
        periods = np.diff(tap.goals)
        return {
            "ticks": len(periods),
            "nominal_ms": 1000 * PERIOD,
            **{
                f"p{q:g}_ms": round(1000 * float(np.quantile(periods, q / 100)), 3)
                for q in (1, 50, 90, 99, 99.9)
            },
            "longest_ms": round(1000 * float(periods.max()), 3),
            "p99_over_nominal": round(float(np.quantile(periods, 0.99)) / PERIOD, 3),
            "missed": told["loop"]["missed"] - before,
            "state": f"{told['state']} {told['reason']}".strip(),
        }


def enable(made: Lab) -> None:
    def tried() -> bool:
        try:
            made.side(cmd="reset")
            made.say("enable")
        except (InputError, AssertionError):
            return False
        return bool(made.health()["state"] == "enabled")

    wait(tried, 30, made.log)


Cause = Callable[[Lab], None]


def _fault(**fault: Any) -> Cause:
    return lambda made: made.side(cmd="fault", **fault) and None


def _signal(number: int) -> Cause:
    def cause(made: Lab) -> None:
        assert made.agent is not None
        os.kill(made.agent.pid, number)

    return cause


CAUSES: dict[str, Cause] = {
    "e-stop by command": lambda made: made.say("stop") and None,
    "kill -9": _signal(signal.SIGKILL),
    "dead servo": _fault(kind="dead_servo", id=14),
    "bus cable pulled": _fault(kind="bus_pulled"),
    "IMU silent": _fault(kind="imu_silent"),
    "hot servo": _fault(kind="hot_motor", id=13, temperature=75.0),
    "under-voltage": _fault(kind="low_battery", charge=-1.0),
    "hung (SIGSTOP, watchdog 0.3 s)": _signal(signal.SIGSTOP),
}


REASONS = {
    "e-stop by command": "stop: ",
    "dead servo": "stale servo: l_knee",
    "bus cable pulled": "stale servo: ",
    "IMU silent": "stale IMU: ",
    "hot servo": "over-temperature: ",
    "under-voltage": "voltage: ",
}


def stops(repeats: int, causes: str) -> dict[str, Any]:
    """Time from each cause to torque off on the bus, in control periods.

    A stop whose reason is another than the cause's is not counted: on a busy machine the virtual
    robot is at times too late with its answers.
    """
    table = {}
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as name, tapped(Path(name)) as (made, tap):
        for cause, act in ((c, a) for c, a in CAUSES.items() if causes in c):
            took, others = [], 0
            while len(took) < repeats and others < repeats:
                if made.agent is None or made.agent.poll() is not None:
                    made.start()
                enable(made)
                time.sleep(0.1 + rng.uniform(0, PERIOD))
                if made.health()["state"] != "enabled":
                    others += 1  # this machine was too busy: it tripped by itself
                    continue
                seconds = _until_off(made, tap, act)
                if _is_why(made, cause):
                    took.append(seconds / PERIOD)
                else:
                    others += 1
                _mend(made)
            table[cause] = _row(took) | {"tripped_by_itself": others}
            print(cause, json.dumps(table[cause]), file=sys.stderr, flush=True)
    return table


def _until_off(made: Lab, tap: Tap, act: Cause) -> float:
    """Seconds from a cause to torque off on the bus."""
    count, before = len(tap.offs), time.monotonic()
    act(made)
    wait(lambda: len(tap.offs) > count, 10, made.log)
    return tap.offs[count] - before


def _is_why(made: Lab, cause: str) -> bool:
    """Whether the agent stopped the robot for this cause; one that is dead cannot say."""
    assert made.agent is not None
    if cause not in REASONS or made.agent.poll() is not None:
        return True
    told = made.health
    wait(lambda: bool(told()["reason"]), 10, made.log)
    return str(told()["reason"]).startswith(REASONS[cause])


def _mend(made: Lab) -> None:
    """Everything is well again, and nothing has torque."""
    made.side(cmd="clear")
    for kind in ("bus_pulled", "imu_silent"):
        made.side(cmd="fault", kind=kind, off=True)
    assert made.agent is not None
    try:
        if made.agent.poll() is None:
            made.say("disable")
    except (Unreachable, InputError):
        made.agent.wait(timeout=10)


def _row(took: list[float]) -> dict[str, Any]:
    told = {f"p{q}": round(float(np.quantile(took, q / 100)), 2) for q in (50, 99)}
    return {"n": len(took), **told, "longest": round(max(took), 2)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    what = parser.add_subparsers(dest="what", required=True)
    what.add_parser("jitter").add_argument("--minutes", type=float, default=10.0)
    stop = what.add_parser("stops")
    stop.add_argument("--repeats", type=int, default=100)
    stop.add_argument("--cause", default="", help="only those whose name has this")
    options = parser.parse_args()
    load = os.getloadavg()[0]
    told = (
        jitter(options.minutes)
        if options.what == "jitter"
        else stops(options.repeats, options.cause)
    )
    machine = f"{os.cpu_count()} cores, {platform.processor() or platform.machine()}"
    print(
        json.dumps(
            {options.what: told, "machine": machine, "load": [load, os.getloadavg()[0]]}, indent=1
        )
    )


if __name__ == "__main__":
    main()
