"""Robots of other makes: Protocol 2.0, the board's own IMU, I2C, distance hooks, systemd."""

import math
import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from agents import DARWIN, Lab, bundle, lab, standing, wait
from test_agent import assign, at_work
from test_agent_holds import enabled, holding

from hardware_agent.config import ImuSettings
from hardware_agent.imu import Bno055, imu_of
from hardware_agent.port import BusError
from pup.errors import InputError
from pup.recording import Recording
from pup.wire import Finished, Outcome, Running

pytest.importorskip("mujoco")

from hardware_agent.virtual.plant import Hold
from hardware_agent.virtual.robot import VirtualRobot


def taken_up(made: Lab) -> None:
    """Somebody picks the robot up and has it hold."""
    made.side(cmd="reset")
    enabled(made)


def recorded(folder: Path, ended: Finished) -> Recording:
    return Recording.read(folder / "state" / "recordings" / f"{ended.recording}.parquet")


def test_a_trial_with_servos_of_protocol_2(
    tmp_path: Path, check_contract: Callable[[Path], None]
) -> None:
    policy = bundle(tmp_path / "policies" / "still", standing())
    with at_work(tmp_path, protocol=2) as (made, gateway):
        ended = gateway.run(assign(policy, "a", horizon=1.0), told=made.log)
        assert (ended.state, ended.reason) == (Outcome.SUCCEEDED, "reached the horizon")
        check_contract(tmp_path / "state" / "recordings")
        recording = recorded(tmp_path, ended)
        recording.validate(DARWIN)
        assert np.abs(recording.position - recording.target).max() < 0.3
        assert 9 < np.median(recording.extras["voltage"]) < 13


def test_whatever_ends_it_servos_of_protocol_2_let_go(tmp_path: Path) -> None:
    """By a stop while it walks, by a servo that is dead, by kill -9."""
    policy = bundle(tmp_path / "policies" / "still", standing())
    with at_work(tmp_path, speed=1.0, protocol=2) as (made, gateway):
        gateway.send(assign(policy, "a", horizon=30.0))
        gateway.wait(Running, told=made.log)
        made.say("stop")
        made.until("stopped")
        wait(lambda: holding(made) == 0, 2, made.log)
        wait(lambda: bool(gateway.of(Finished)), 20, made.log)
        assert gateway.of(Finished)[0].state is Outcome.ABORTED
        taken_up(made)
        made.side(cmd="fault", kind="dead_servo", id=14)
        assert made.until("fault")["reason"].startswith("stale servo: ")
        wait(lambda: holding(made) <= 1, 2, made.log)
        made.side(cmd="fault", kind="dead_servo", id=14, off=True)
        wait(lambda: holding(made) == 0, 10, made.log)
        taken_up(made)
        assert holding(made) == 20
        made.kill()
        wait(lambda: holding(made) == 0, 2, made.log)


def test_a_trial_with_the_boards_own_imu(tmp_path: Path) -> None:
    """Its tilt, filtered from gyroscope and accelerometer, is the torso's."""
    policy = bundle(tmp_path / "policies" / "still", standing())
    with at_work(tmp_path, more='[imu]\nkind = "cm740"\n') as (made, gateway):
        ended = gateway.run(assign(policy, "a", horizon=1.0), told=made.log)
        assert ended.reason == "reached the horizon"
        roll, pitch, _ = made.side(cmd="pose")["tilt"]
        recording = recorded(tmp_path, ended)
        assert recording.extras["imu/pitch"][-1] == pytest.approx(pitch, abs=0.06)
        assert recording.extras["imu/roll"][-1] == pytest.approx(roll, abs=0.06)


class Wires:
    """smbus2's bus with a virtual BNO055 on it: no I2C device is at hand, so this one seam is ours.

    Attributes:
      robot: whose torso carries the chip.
      cut: whether the cable is out.
    """

    robot: VirtualRobot
    cut = False

    def __init__(self, number: int) -> None:
        assert number == 1

    def close(self) -> None:
        pass

    def write_byte_data(self, address: int, register: int, value: int) -> None:
        assert self._asked(address, bytes([0xAA, 0x00, register, 1, value])) == b"\xee\x01"

    def read_i2c_block_data(self, address: int, register: int, length: int) -> list[int]:
        return list(self._asked(address, bytes([0xAA, 0x01, register, length]))[2:])

    def _asked(self, address: int, message: bytes) -> bytes:
        if type(self).cut or address != 0x28:
            raise OSError(121, "Remote I/O error")
        (answer,) = self.robot.imu.feed(message)
        return answer


@pytest.fixture
def wires(monkeypatch: pytest.MonkeyPatch) -> Iterator[type[Wires]]:
    module = ModuleType("smbus2")
    monkeypatch.setattr(module, "SMBus", Wires, raising=False)
    monkeypatch.setitem(sys.modules, "smbus2", module)
    Wires.robot, Wires.cut = VirtualRobot(DARWIN, 1), False
    Wires.robot.board.write(24, b"\x01")
    yield Wires


def test_a_bno055_on_i2c_tells_what_it_tells_on_its_uart(wires: type[Wires]) -> None:
    imu = imu_of(ImuSettings(kind="bno055-i2c", port="1"))
    assert isinstance(imu, Bno055)
    imu.open()
    wires.robot.reset(Hold.ROPE)
    for _ in range(3):
        wires.robot.advance(0.1)
        imu.ask()
        told = imu.take(None, 0.0)
        assert told is not None
        roll, pitch, _ = wires.robot.pose().tilt
        assert (told.roll, told.pitch) == pytest.approx((roll, pitch), abs=0.06)
        assert math.hypot(*told.accel) == pytest.approx(9.81, abs=0.8)
        assert np.abs(told.gyro).max() < 0.5
    wires.cut = True
    imu.ask()
    assert imu.take(None, 0.0) is None, "no reading; the rule of stale IMUs does the rest"
    with pytest.raises(BusError, match="no BNO055 answers"):
        imu.open()


def test_without_smbus2_i2c_is_refused_in_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "smbus2", None)
    imu = imu_of(ImuSettings(kind="bno055-i2c", port="1"))
    assert imu is not None
    with pytest.raises(InputError, match="pip install smbus2"):
        imu.open()


HOOK = """#!/bin/sh
echo "$1 $PUP_STUDY $PUP_TRIAL $PUP_ATTEMPT $PUP_DIRECTION" >> "{log}"
[ "$1" = start ] && exit 0
case "$PUP_TRIAL" in
  good) echo "looking for the markers"; echo 0.73;;
  fails) echo "no marker is seen" >&2; exit 3;;
  nan) echo nan;;
  millimetres) echo 730;;
  mute) ;;
  hangs) exec sleep 60;;
esac
"""
SAID = {
    "fails": "the distance hook ended with 3: no marker is seen",
    "nan": "the distance hook printed 'nan', not a number of metres",
    "millimetres": "730 m in a walk of 0.2 s cannot be (1 m at most); tell it in metres",
    "mute": "the distance hook printed 'nothing', not a number of metres",
    "hangs": "timed out after 1",
}


def test_a_hook_measures_and_its_failures_cost_a_trial_and_no_agent(tmp_path: Path) -> None:
    policy = bundle(tmp_path / "policies" / "still", standing())
    hook, log = tmp_path / "hook", tmp_path / "hook.log"
    hook.write_text(HOOK.format(log=log))
    hook.chmod(0o755)
    more = f'[distance]\nkind = "hook"\ncommand = ["{hook}"]\ntimeout = 1.0\n'
    with at_work(tmp_path, more=more) as (made, gateway):
        for trial, reason in SAID.items():
            ended = gateway.run(assign(policy, trial, horizon=0.2), told=made.log)
            assert ended.state is Outcome.ABORTED and reason in ended.reason
        ended = gateway.run(assign(policy, "good", horizon=0.2), told=made.log)
        assert (ended.state, ended.distance) == (Outcome.SUCCEEDED, 0.73)
        hook.chmod(0o644)
        ended = gateway.run(assign(policy, "locked", horizon=0.2), told=made.log)
        assert ended.state is Outcome.ABORTED and "the distance hook failed" in ended.reason
        assert made.health()["state"] == "enabled"
    told = log.read_text().splitlines()
    assert told[-2:] == [f"{what} study good 1 forward" for what in ("start", "end")]


def test_systemd_is_told_that_it_is_ready_alive_and_ending(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
        line.bind(str(tmp_path / "notify"))
        line.settimeout(20)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        with lab(tmp_path) as made:
            made.start()
            told = [line.recv(4096).decode() for _ in range(20)]
            assert told[0] == "READY=1"
            assert all(x.startswith("WATCHDOG=1\nSTATUS=disabled") for x in told[1:])
            assert made.agent is not None
            os.kill(made.agent.pid, signal.SIGTERM)
            end = time.monotonic() + 20
            while "STOPPING=1" not in told and time.monotonic() < end:
                told.append(line.recv(4096).decode())
            assert told[-1] == "STOPPING=1"
            made.agent.wait(20)
