"""How soon the agent makes the robot safe, trigger by trigger, at the virtual robot's bus.

A stop is measured to the first packet that turns torque off (for a fall: that leaves it a share of
its power). It begins where the fault is caused: the command to the virtual robot has been sent, or
the signal. Where the fault is evidence that builds up (a fall, a stuck encoder, an overload), it
begins with the first byte of the question whose answers completed it.
"""

import itertools
import json
import os
import pty
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.tap import Tap, tapped
from hardware_agent.control import Unreachable
from hardware_agent.policies import digest_of
from pup.errors import InputError
from pup.robot import Harmonics
from pup.wire import Assign, Hello, Running, Stop

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from agents import Lab, bundle, children, standing, wait
from far_end import Gateway

PERIOD = 1 / 33
NODDING = Harmonics(0.2, (0.3, 0.0), (0.0, 0.0))
NONSENSE = Harmonics(0.0, (1.7e308, -1.7e308), (1.7e308, -1.7e308))
"""Sums of these are infinite, and their differences no number."""


@dataclass
class Bench:
    """A robot at work: its lab, the tap in its bus and the gateway that it is linked to.

    Attributes:
      made: virtual robot and agent.
      tap: in the bus.
      gateway: hands out trials.
      key: the far end of the operator's terminal.
    """

    made: Lab
    tap: Tap
    gateway: Gateway
    key: int = -1
    _trial: itertools.count = field(default_factory=itertools.count)

    @property
    def agent(self) -> int:
        """Its process."""
        assert self.made.agent is not None
        return self.made.agent.pid

    def fault(self, **fault: Any) -> None:
        """Break something."""
        self.made.side(cmd="fault", **fault)

    def children(self, name: str) -> list[int]:
        """Processes that the agent started, by their command; the dead have none."""
        return [c for c in children(self.agent) if name in Path(f"/proc/{c}/cmdline").read_text()]

    def walk(self, policy: Path) -> bool:
        """Begin a trial; False where the robot was stopped before it walked."""
        trial = f"t{next(self._trial)}"
        before = len(self.gateway.of(Running))
        study = ("stops", trial, 1, 1, digest_of(policy), (0.0, 0.5, -0.5), 15.0)
        self.gateway.send(Assign(*study))

        def walks() -> bool:
            return len(self.gateway.of(Running)) > before

        wait(lambda: walks() or self.made.health()["state"] == "fault", 20, self.made.log)
        return walks()


def enable(made: Lab) -> None:
    """Torque on, the robot on its feet."""

    def tried() -> bool:
        try:
            made.side(cmd="reset")
            made.say("enable")
        except (InputError, AssertionError):
            return False
        return bool(made.health()["state"] == "enabled")

    wait(tried, 30, made.log)


@dataclass(frozen=True)
class Trigger:
    """What makes the robot safe.

    Attributes:
      act: causes it; None where it comes by itself.
      reason: with which the agent's own words begin; empty where it cannot say.
      policy: that the robot walks by meanwhile; empty for a robot that stands.
      evidence: whether it builds up, and its last question counts.
      settings: of the agent.
    """

    act: Callable[[Bench], object] | None
    reason: str = ""
    policy: str = ""
    evidence: bool = False
    settings: str = ""


def _late(bench: Bench) -> None:
    """The loop hangs for 0.2 s, less than the watchdog's patience."""
    os.kill(bench.agent, signal.SIGSTOP)
    time.sleep(0.2)
    os.kill(bench.agent, signal.SIGCONT)


def _fault(**fault: Any) -> Callable[[Bench], object]:
    return lambda bench: bench.fault(**fault)


def _kill(number: int) -> Callable[[Bench], object]:
    return lambda bench: os.kill(bench.agent, number)


HOT = 13
"""A servo of a knee."""
PIN = '[stop]\ncommand = ["sleep", "100000"]\n'
TENDER = "[safety]\ncurrent = 0.05\ncurrent_time = 0.5\n"
TRIGGERS = {
    "e-stop by command": Trigger(lambda b: b.made.say("stop"), "stop: "),
    "e-stop by key": Trigger(lambda b: os.write(b.key, b" "), "stop: by the operator"),
    "e-stop by pin": Trigger(
        lambda b: os.kill(b.children("sleep")[0], signal.SIGTERM), "stop: ", settings=PIN
    ),
    "e-stop by the gateway": Trigger(
        lambda b: b.gateway.send(Stop("from afar")), "stop: gateway: from afar"
    ),
    "kill -9": Trigger(_kill(signal.SIGKILL)),
    "SIGTERM": Trigger(_kill(signal.SIGTERM)),
    "hung (SIGSTOP, watchdog 0.3 s)": Trigger(_kill(signal.SIGSTOP)),
    "watchdog killed": Trigger(
        lambda b: os.kill(b.children("watchdog")[0], signal.SIGKILL), "watchdog: "
    ),
    "stale command (hung for 0.2 s)": Trigger(_late, "stale command: "),
    "dead servo": Trigger(_fault(kind="dead_servo", id=14), "stale servo: l_knee"),
    "bus cable pulled": Trigger(_fault(kind="bus_pulled"), "stale servo: "),
    "IMU silent": Trigger(_fault(kind="imu_silent"), "stale IMU: "),
    "hot servo": Trigger(_fault(kind="hot_motor", id=HOT, temperature=75.0), "over-temperature: "),
    "servo's own alarm": Trigger(
        _fault(kind="hot_motor", id=HOT, temperature=90.0), "servo alarm: "
    ),
    "heating (dT/dt)": Trigger(_fault(kind="hot_motor", id=HOT, temperature=60.0), "heating: "),
    "under-voltage": Trigger(_fault(kind="low_battery", charge=-1.0), "voltage: "),
    "overload (I²t)": Trigger(None, "overload: ", evidence=True, settings=TENDER),
    "fall": Trigger(None, "", "stepping", evidence=True),
    "stuck encoder": Trigger(
        _fault(kind="stuck_encoder", id=20), "stuck encoder: ", "nodding", evidence=True
    ),
    "IMU frozen": Trigger(_fault(kind="imu_frozen"), "frozen IMU: ", "nodding", evidence=True),
    "target that is no number": Trigger(None, "bad target: ", "nonsense", evidence=True),
}


def stops(folder: Path, repeats: int, names: Sequence[str] = ()) -> dict[str, Any]:
    """Time from each trigger to torque off on the bus, in control periods.

    A stop whose reason is another than the trigger's is not counted: on a busy machine the virtual
    robot is at times too late with its answers.

    Args:
      folder: for labs; empty.
      repeats: of each trigger.
      names: only triggers whose name has one of these; empty for all.
    """
    rng = np.random.default_rng(0)
    chosen = {
        name: trigger
        for name, trigger in TRIGGERS.items()
        if not names or any(part in name for part in names)
    }
    told = {}
    for number, settings in enumerate(dict.fromkeys(t.settings for t in chosen.values())):
        place = folder / f"lab{number}"
        place.mkdir()
        gateway = Gateway(place / "keys")
        policies = {
            "stepping": bundle(place / "policies" / "stepping"),
            "nodding": bundle(place / "policies" / "nodding", standing(head_tilt=NODDING)),
            "nonsense": bundle(place / "policies" / "nonsense", standing(head_tilt=NONSENSE)),
        }
        try:
            with tapped(place, gateway.config + settings) as (made, tap):
                bench = Bench(made, tap, gateway)
                for name, trigger in chosen.items():
                    if trigger.settings == settings:
                        told[name] = _repeated(bench, trigger, policies, repeats, rng)
                        print(name, json.dumps(told[name]), file=sys.stderr, flush=True)
        finally:
            gateway.close()
    return told


def _repeated(
    bench: Bench,
    trigger: Trigger,
    policies: dict[str, Path],
    repeats: int,
    rng: np.random.Generator,
) -> dict[str, Any]:
    took: list[float] = []
    others = 0
    while len(took) < repeats and others < repeats:
        _start(bench)
        enable(bench.made)
        count = len(bench.tap.safes)
        ready = not trigger.policy or bench.walk(policies[trigger.policy])
        seconds = _until_safe(bench, trigger, count, rng) if ready else None
        if seconds is not None and _is_why(bench, trigger):
            took.append(seconds / PERIOD)
        else:
            others += 1
        _mend(bench)
    row = {f"p{q}": round(float(np.quantile(took, q / 100)), 2) for q in (50, 99)} if took else {}
    longest = {"longest": round(max(took), 2)} if took else {}
    return {"n": len(took), **row, **longest, "tripped_by_itself": others}


def _start(bench: Bench) -> None:
    """An agent that runs, greeted by its gateway, with an operator at its prompt."""
    made = bench.made
    if made.agent is not None and made.agent.poll() is None:
        return
    greeted = len(bench.gateway.of(Hello))
    made.start()
    wait(lambda: len(bench.gateway.of(Hello)) > greeted, 20, made.log)
    if bench.key >= 0:
        os.close(bench.key)
    bench.key, theirs = pty.openpty()
    prompt = [sys.executable, "-m", "hardware_agent.cli", "operate", "--config", str(made.config)]
    shown = made.folder / "prompt.log"
    with shown.open("wb") as log:  # the prompt ends by itself when its agent has gone
        subprocess.Popen([*prompt[:1], "-u", *prompt[1:]], stdin=theirs, stdout=log, stderr=log)
    os.close(theirs)
    wait(lambda: b"STOPS" in shown.read_bytes(), 20)


def _until_safe(
    bench: Bench, trigger: Trigger, count: int, rng: np.random.Generator
) -> float | None:
    """Seconds until the robot is safe; None where it was so before anything was done."""
    tap = bench.tap
    if trigger.act is not None:
        time.sleep(0.1 + rng.uniform(0, PERIOD))
        if len(tap.safes) > count:
            return None
        began = time.monotonic()
        trigger.act(bench)
        if trigger.act is _late:
            began = time.monotonic()
    wait(lambda: len(tap.safes) > count, 30, bench.made.log)
    safe = tap.safes[count]
    if trigger.evidence:
        began = max(asked for asked in list(tap.questions) if asked < safe)
    return safe - began


def _is_why(bench: Bench, trigger: Trigger) -> bool:
    """Whether the robot was stopped for this; an agent that is dead cannot say."""
    made = bench.made
    assert made.agent is not None
    if not trigger.reason or made.agent.poll() is not None:
        return True
    wait(lambda: bool(made.health()["reason"]), 10, made.log)
    return str(made.health()["reason"]).startswith(trigger.reason)


def _mend(bench: Bench) -> None:
    """Everything is well again, and nothing has torque."""
    made = bench.made
    assert made.agent is not None
    bench.fault(kind="dead_servo", id=HOT)  # one that has shut down comes back with its power
    made.side(cmd="clear")
    try:
        if made.agent.poll() is None:
            wait(lambda: not made.health()["trial"], 20, made.log)
            made.say("disable")
            if not bench.children("watchdog"):
                made.end()
    except (Unreachable, InputError):
        made.agent.wait(timeout=10)
