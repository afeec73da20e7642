"""The agent and a virtual robot: real packets on a pseudo-terminal, a real link, real processes."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from agents import DARWIN, Lab, alive, bundle, children, lab, memory, standing, wait
from far_end import Gateway

from hardware_agent.bus import Bus
from hardware_agent.config import BusSettings
from hardware_agent.policies import digest_of
from hardware_agent.port import BusyError
from pup.recording import Recording
from pup.robot import Harmonics
from pup.wire import (
    Accepted,
    Armed,
    Assign,
    Cancel,
    Finished,
    Heartbeat,
    Hello,
    Outcome,
    RecordingChunk,
    Running,
    Sample,
    Stop,
)

pytest.importorskip("mujoco")

IDS = [joint.servo_id or 0 for joint in DARWIN.joints]
MODES = {
    "1.0": BusSettings("", protocol=1),
    "1.0, rotating": BusSettings("", protocol=1, detail="rotating"),
    "2.0, bulk": BusSettings("", protocol=2, write="bulk"),
    "2.0, sync": BusSettings("", protocol=2, read="sync"),
}
FAST = ("1.0", "2.0, bulk")


def assign(policy: Path, trial: str = "t", horizon: float = 0.4) -> Assign:
    return Assign("study", trial, 1, 1, digest_of(policy), (0.0, 0.5, -0.5), horizon)


@contextmanager
def at_work(
    folder: Path, speed: float = 0.0, more: str = "", protocol: int = 1
) -> Iterator[tuple[Lab, Gateway]]:
    """A lab whose agent is linked to a gateway and has its robot enabled."""
    gateway = Gateway(folder / "keys")
    try:
        with lab(folder, speed, protocol, more=gateway.config + more) as made:
            made.start()
            wait(lambda: bool(gateway.of(Hello)), 20, made.log)
            made.say("enable")
            yield made, gateway
    finally:
        gateway.close()


def taken(bus: Bus) -> bool:
    try:
        bus.take()
    except BusyError:
        return False
    return True


def limp(made: Lab) -> bool:
    """Whether all servos say that their torque is off, once their owner has gone."""
    bus = Bus(BusSettings(str(made.folder / "bus"), timeout=0.05), IDS)
    wait(lambda: taken(bus), 10, made.log)
    told = {bus.torque_enabled(name) for name in IDS}
    bus.close()
    return told == {False}


@pytest.mark.parametrize(
    "mode",
    [pytest.param(m, marks=() if n in FAST else pytest.mark.slow) for n, m in MODES.items()],
    ids=MODES,
)
def test_the_bus_speaks_both_protocols(tmp_path: Path, mode: BusSettings) -> None:
    """All servos told and asked at once; noise on the wire is asked over, not believed."""
    with lab(tmp_path, speed=1.0, protocol=mode.protocol) as made:
        settings = BusSettings(
            **vars(mode) | {"port": str(tmp_path / "bus"), "board": 200, "timeout": 0.1}
        )
        bus = Bus(settings, IDS)
        put_right = bus.open()
        assert len(put_right) == len(IDS), "return delay of the factory"
        made.side(cmd="reset")
        answers = bus.read()
        known = [answers.servos[name] for name in IDS]
        pose = np.array([status.position for status in known])
        assert DARWIN.gait is not None
        assert pose == pytest.approx(DARWIN.gait.start, abs=0.1)
        told = [status for status in known if status.voltage is not None]
        assert len(told) == (1 if mode.detail == "rotating" else len(IDS))
        assert all(9 < (status.voltage or 0) < 13 for status in told)
        assert bus.prepare(pose, 1.0) == {}
        bus.torque(True)
        goal = pose.copy()
        goal[6] += 0.3  # the head, which moves nothing else
        for _ in range(30):
            bus.write(goal)
            time.sleep(0.02)
        moved = bus.read().servos
        assert moved[19].position == pytest.approx(goal[6], abs=0.08)
        made.side(cmd="fault", kind="noise", rate=0.1)
        for _ in range(20):
            for name, status in bus.read().servos.items():
                assert status.position == pytest.approx(moved[name].position, abs=0.15)
        made.side(cmd="fault", kind="noise", off=True)
        with pytest.raises(BusyError):
            Bus(settings, IDS).take()
        bus.torque(False)
        assert [bus.torque_enabled(name) for name in IDS] == [False] * len(IDS)
        bus.close()


def test_trials_run_on_board_are_told_and_recorded(
    tmp_path: Path, check_contract: Callable[[Path], None]
) -> None:
    """Lock-step, where a trial is the same each time."""
    policy = bundle(tmp_path / "policies" / "still")
    with at_work(tmp_path) as (made, gateway):
        assert [p.sha256 for p in gateway.of(Hello)[0].policies] == [digest_of(policy)]
        first = gateway.run(assign(policy, "a"), told=made.log)
        assert first.state is Outcome.SUCCEEDED and first.reason == "reached the horizon"
        assert first.time == pytest.approx(0.4, abs=1 / 33)
        assert abs(first.distance or 9) < 0.3
        told = (gateway.of(k)[0].trial for k in (Accepted, Armed, Running, Sample))
        assert list(told) == ["a"] * 4
        fallen = gateway.run(assign(policy, "b", horizon=8.0), told=made.log)
        assert fallen.state is Outcome.SUCCEEDED and fallen.reason.startswith("fall: ")
        wait(lambda: made.health()["state"] == "enabled", 5)
        copied = digest_of(bundle(tmp_path / "policies" / "other", parameters=("a", "b")))
        wait(lambda: copied in [p.sha256 for p in gateway.of(Hello)[-1].policies], 20, made.log)
        unknown = gateway.run(Assign("study", "c", 1, 1, "0" * 64, (0.0,), 1.0))
        assert unknown.state is Outcome.ABORTED and "no policy" in unknown.reason

        def ends() -> list[Finished]:
            return [f for f in gateway.of(Finished) if f.trial == "b"]  # others' are told again

        before = len(ends())
        gateway.send(assign(policy, "b", horizon=8.0))
        wait(lambda: len(ends()) > before, 30, made.log)
        assert ends()[-1] == fallen, "told again, not run again"
        assert [r.trial for r in gateway.of(Running)] == ["a", "b"]
        folder = tmp_path / "state" / "recordings"
        check_contract(folder)
        assert len(list(folder.iterdir())) == 2
        recording = Recording.read(folder / f"{fallen.recording}.parquet")
        recording.validate(DARWIN)
        assert (recording.motion, recording.source) == ("walk", "simulation")
        assert np.diff(recording.time) == pytest.approx(1 / 33)
        assert recording.time[-1] == pytest.approx(fallen.time)
        assert abs(recording.extras["imu/pitch"][-1]) > 0.5
        chunks = [c for c in gateway.of(RecordingChunk) if c.recording == fallen.recording]
        data = b"".join(c.data for c in sorted(chunks, key=lambda c: c.number))
        assert data == (folder / f"{fallen.recording}.parquet").read_bytes()
        assert made.agent is not None and memory(made.agent.pid) < 120, "light after trials too"


@pytest.mark.slow
def test_a_policy_that_tells_nonsense_is_infeasible_and_the_robot_limp(tmp_path: Path) -> None:
    huge = 1.7e308  # sums of these are infinite, and their differences no number
    wild = standing(head_tilt=Harmonics(0.0, (huge, -huge), (huge, -huge)))
    policy = bundle(tmp_path / "policies" / "odd", wild)
    with at_work(tmp_path) as (made, gateway):
        ended = gateway.run(assign(policy, horizon=8.0), told=made.log)
        assert ended.state is Outcome.INFEASIBLE and "bad target" in ended.reason
        assert made.health()["state"] == "fault"


def test_a_cancelled_trial_stands_and_a_restart_never_repeats_a_motion(tmp_path: Path) -> None:
    policy = bundle(tmp_path / "policies" / "still", standing())
    with at_work(tmp_path, speed=1.0) as (made, gateway):
        gateway.send(assign(policy, "a", horizon=30.0))
        gateway.wait(Armed)
        gateway.send(Cancel("a", 1, 1))
        wait(lambda: bool(gateway.of(Heartbeat)) and not made.health()["trial"], 20, made.log)
        assert made.health()["state"] == "enabled"
        gateway.send(assign(policy, "b", horizon=30.0))
        gateway.wait(Running, told=made.log)
        before = len(gateway.of(Running))
        wait(lambda: any(s.number > 20 for s in gateway.of(Sample)), 20, made.log)
        made.kill()
        wait(lambda: limp(made), 10)
        known = len(gateway.of(Hello))
        made.start()
        wait(lambda: len(gateway.of(Hello)) > known, 20, made.log)
        told = gateway.of(Hello)[known]
        wait(lambda: any(f.trial == "b" for f in gateway.of(Finished)), 20, made.log)
        ended = [f for f in gateway.of(Finished) if f.trial == "b"]
        assert {(f.state, f.reason) for f in ended} == {(Outcome.ABORTED, "agent restarted")}
        assert [e.trial for e in told.journal] == ["b"]
        saved = Recording.read(tmp_path / "state" / "recordings" / f"{ended[0].recording}.parquet")
        saved.validate(DARWIN)
        assert len(saved.time) > 20 and saved.time[-1] == ended[0].time, "what it did so far"
        assert any(c.recording == ended[0].recording for c in gateway.of(RecordingChunk))
        gateway.send(assign(policy, "b", horizon=30.0))
        time.sleep(1.0)
        assert len(gateway.of(Running)) == before
        assert made.health()["state"] == "disabled"


@pytest.mark.slow
def test_starting_moves_nothing_and_enabling_holds_the_pose(tmp_path: Path) -> None:
    """The goal that the first torque meets is where the joints are."""
    with lab(tmp_path, speed=1.0) as made:
        made.side(cmd="reset")
        before = made.side(cmd="pose")["position"]
        made.start()
        assert made.health()["state"] == "disabled"
        made.say("enable")
        time.sleep(1.0)
        after = made.side(cmd="pose")["position"]
        assert np.abs(np.array(after) - before).max() < 0.06
        assert made.health()["state"] == "enabled"
        other = subprocess.run(
            [sys.executable, "-m", "hardware_agent.cli", "run", "--config", str(made.config)],
            capture_output=True,
            text=True,
            timeout=60,
        )
        assert other.returncode == 2 and "another agent listens" in other.stderr
        made.end()
        assert limp(made)


def test_the_agent_is_light(tmp_path: Path) -> None:
    with lab(tmp_path, speed=1.0) as made:
        made.start()
        assert made.agent is not None
        assert memory(made.agent.pid) < 120
        (watchdog,) = children(made.agent.pid)
        assert memory(watchdog) < 40
        loaded = Path(f"/proc/{made.agent.pid}/maps").read_text()
        assert not any(name in loaded for name in ("mujoco", "torch", "jaxlib", "_raylet"))


def test_killed_or_hung_the_robot_is_limp_soon(tmp_path: Path) -> None:
    with lab(tmp_path, speed=1.0, more="[watchdog]\ntimeout = 0.5\n") as made:
        for signalled in (signal.SIGKILL, signal.SIGSTOP):
            made.start()
            made.say("enable")
            assert made.agent is not None
            os.kill(made.agent.pid, signalled)
            made.agent.wait(timeout=10)
            wait(lambda: limp(made), 10, made.log)
        assert "did not tick for 0.5 s" in made.log()


def test_asked_to_end_it_leaves_the_robot_limp_without_waiting(tmp_path: Path) -> None:
    with lab(tmp_path, speed=1.0) as made:
        made.start()
        made.say("enable")
        asked = time.monotonic()
        made.end()
        assert time.monotonic() - asked < 4  # agent and watchdog waited 5 s for each other once
        assert limp(made)
        assert "the agent has ended; torque is off" in made.log()


@pytest.mark.slow
def test_without_its_watchdog_the_agent_lets_go(tmp_path: Path) -> None:
    with lab(tmp_path, speed=1.0) as made:
        made.start()
        made.say("enable")
        assert made.agent is not None
        (watchdog,) = children(made.agent.pid)
        os.kill(watchdog, signal.SIGKILL)
        told = made.until("fault")
        assert told["reason"] == "watchdog: its process has ended" and told["problems"]
        assert not alive(watchdog)
        made.end()
        assert limp(made)


FAULTS = {
    "a dead servo": ({"kind": "dead_servo", "id": 14}, "stale servo: "),
    "the bus pulled": ({"kind": "bus_pulled"}, "stale servo: "),
    "the port pulled": ({"kind": "port_pulled"}, "bus: "),
    "a hot motor": ({"kind": "hot_motor", "id": 13, "temperature": 75.0}, "over-temperature: "),
    "a silent IMU": ({"kind": "imu_silent"}, "stale IMU: "),
    "an empty battery": ({"kind": "low_battery", "charge": -1.0}, "voltage: "),
}


def test_every_fault_of_the_robot_stops_it_for_its_own_reason(tmp_path: Path) -> None:
    with lab(tmp_path, speed=1.0) as made:
        made.start()
        for fault, reason in FAULTS.values():
            made.side(cmd="reset")
            wait(lambda: made.health()["bus"]["works"], 20, made.log)
            wait(lambda: _enabled(made), 20, made.log)
            made.side(cmd="fault", **fault)
            told = made.until("fault")
            assert told["reason"].startswith(reason), told
            assert told["problems"]
            made.side(cmd="clear")
            made.side(cmd="fault", kind=fault["kind"], id=fault.get("id", 1), off=True)
        wait(lambda: made.health()["bus"]["works"], 20, made.log)
        made.say("disable")
        assert made.health()["state"] == "disabled"


def _enabled(made: Lab) -> bool:
    try:
        made.say("enable")
    except Exception:  # a bus that has just come back has not told everything yet
        return False
    return made.health()["state"] == "enabled"


@pytest.mark.slow
def test_whoever_presses_it_the_robot_stops(tmp_path: Path) -> None:
    """A message, the command line, and a pin whose command ends; then it is enabled again."""
    button = '[stop]\ncommand = ["sleep", "1000"]\n'
    with at_work(tmp_path, speed=1.0, more=button) as (made, gateway):
        gateway.send(Stop("from afar"))
        assert made.until("stopped")["reason"] == "stop: gateway: from afar"
        made.say("enable")
        command = [sys.executable, "-m", "hardware_agent.cli"]
        subprocess.run([*command, "stop", "--config", str(made.config)], check=True, timeout=30)
        assert made.until("stopped")["problems"] == []
        made.say("enable")
        assert made.agent is not None
        (pin,) = [c for c in children(made.agent.pid) if "sleep" in _command(c)]
        os.kill(pin, signal.SIGTERM)
        assert "command has ended" in made.until("stopped")["reason"]
        told = subprocess.run(
            [*command, "health", "--json", "--config", str(made.config)],
            capture_output=True,
            text=True,
            timeout=30,
        )
        assert told.returncode == 0 and json.loads(told.stdout)["state"] == "stopped"
        made.kill()
        wait(lambda: limp(made), 10)
        done = subprocess.run([*command, "disable", "--config", str(made.config)], timeout=60)
        assert done.returncode == 0, "also where no agent runs"


def _command(pid: int) -> str:
    return Path(f"/proc/{pid}/cmdline").read_text()
