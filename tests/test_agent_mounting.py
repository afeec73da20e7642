"""Servos that are mounted the other way round, or whose zero is not in the middle."""

import math
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from agents import CONFIG, DARWIN, Lab, changed, wait
from hypothesis import given
from hypothesis import strategies as st

from hardware_agent.body import Body
from hardware_agent.bus import Bus
from hardware_agent.cli import main
from hardware_agent.config import BusSettings, Settings
from hardware_agent.mounting import LAST, TICK, Mounting
from hardware_agent.registers import REGISTERS
from pup.errors import InputError
from pup.recording import Recording
from pup.sysid.scripts import scripts

pytest.importorskip("mujoco")

from hardware_agent.virtual.plant import Hold
from hardware_agent.virtual.robot import VirtualRobot
from hardware_agent.virtual.server import Ports, Server
from hardware_agent.virtual.servo import Servo

IDS = [joint.servo_id or 0 for joint in DARWIN.joints]
N = len(IDS)
FACTORY = [Mounting()] * N
OTHERWISE = [Mounting((-1) ** j, 2048 + (0, 71, -113)[j % 3]) for j in range(N)]
"""The arms' pitch, joints 0 and 3, needs all of its servos' range, whose zero is the middle."""
HEAD = DARWIN.joint_names.index("head_tilt")

mountings = st.builds(Mounting, st.sampled_from((1, -1)), st.integers(0, LAST))


@given(mountings, st.integers(0, LAST))
def test_ticks_and_angles_are_each_others_inverse(mounting: Mounting, ticks: int) -> None:
    """So a limp servo is told to hold exactly where it stands."""
    assert mounting.ticks(mounting.angle(ticks)) == ticks
    least, largest = mounting.reach
    assert least <= mounting.angle(ticks) <= largest


@given(mountings, st.floats(-10.0, 10.0))
def test_a_goal_is_the_nearest_that_the_servo_reaches(mounting: Mounting, goal: float) -> None:
    told = mounting.angle(mounting.ticks(goal))
    assert told == pytest.approx(np.clip(goal, *mounting.reach), abs=TICK / 2 + 1e-9)


@given(mountings, st.integers(-1023, 1023), st.integers(-1000, 1000), st.integers(0, LAST))
def test_speed_and_load_turn_with_the_angle(
    mounting: Mounting, speed: int, load: int, ticks: int
) -> None:
    for registers in REGISTERS.values():
        block = _block(registers.protocol, ticks, speed, load)
        as_built = registers.status(block, 0, True, Mounting())
        told = registers.status(block, 0, True, mounting)
        assert (told.velocity, told.load) == (
            mounting.sign * cast(float, as_built.velocity),
            mounting.sign * cast(float, as_built.load),
        )
        assert told.position == mounting.angle(ticks)
        assert (told.voltage, told.temperature) == (11.8, 45.0)
        at = registers.position[0] - registers.block[0]
        alone = block[at : at + registers.position[1]]
        assert registers.status(alone, 0, False, mounting).position == told.position


def _block(protocol: int, ticks: int, speed: int, load: int) -> bytes:
    """What a servo answers that is at these ticks."""
    if protocol == 1:
        words = [ticks, *(abs(x) | 0x400 * (x < 0) for x in (speed, load))]
        return b"".join(x.to_bytes(2, "little") for x in words) + bytes([118, 45])
    block = bytearray(21)
    block[0:2] = load.to_bytes(2, "little", signed=True)
    block[2:6] = speed.to_bytes(4, "little", signed=True)
    block[6:10] = ticks.to_bytes(4, "little", signed=True)
    block[18], block[20] = 118, 45
    return bytes(block)


class Remounted(Servo):
    """A virtual servo that turns its joint otherwise; its own side is that of the bus."""

    mounting: Mounting

    @property
    def position(self) -> int:
        return self.mounting.zero + self.mounting.sign * (super().position - 2048)

    @property
    def speed(self) -> float:
        return self.mounting.sign * super().speed

    @property
    def duty(self) -> float:
        return self.mounting.sign * super().duty

    def _goal(self, ticks: float) -> None:
        super()._goal(2048 + self.mounting.sign * (ticks - self.mounting.zero))

    def _enable(self, on: bool) -> None:
        if on and not self.plant.drives.orders.power[self.at]:
            self.plant.drives.engage(self.at, super().position)
        self._order("power", float(on))


@contextmanager
def robot_with(
    folder: Path, mounted: Sequence[Mounting], protocol: int = 1
) -> Iterator[VirtualRobot]:
    """A virtual robot in lock-step whose servos are mounted like this."""
    folder.mkdir(exist_ok=True)
    robot = VirtualRobot(DARWIN, 1, protocol)
    for servo, mounting in zip(robot.servos, mounted, strict=True):
        kind = type("Otherwise", (Remounted, type(servo)), {"mounting": mounting})
        cast(Any, servo).__class__ = kind
        servo.restart()
    ports = Ports(*(folder / name for name in ("bus", "imu", "side")))
    stop = threading.Event()
    with Server(robot, ports, speed=0.0, period=1 / 33) as server:
        living = threading.Thread(target=server.run, args=(stop,), daemon=True)
        living.start()
        try:
            yield robot
        finally:
            stop.set()
            living.join(10)


def moved(bus: Bus, seconds: float = 1.0) -> dict[str, np.ndarray]:
    """What servos tell that are enabled, and whose head is told to go somewhere."""
    told = []
    pose = np.array([bus.read().servos[name].position for name in IDS])
    assert bus.prepare(pose, 1.0) == {}
    bus.torque(True)
    goal = pose.copy()
    for k in range(round(33 * seconds)):
        goal[HEAD] = pose[HEAD] + min(0.3, 0.02 * k)
        bus.write(goal)
        answers = bus.read().servos
        told.append([(s.position, s.velocity, s.load) for s in (answers[name] for name in IDS)])
    bus.torque(False)
    bus.close()
    position, velocity, load = np.moveaxis(np.array(told), 2, 0)
    return {"start": pose, "position": position, "velocity": velocity, "load": load}


@pytest.mark.parametrize("protocol", [1, 2])
def test_a_robot_with_turned_servos_tells_and_does_the_same(tmp_path: Path, protocol: int) -> None:
    """Over real packets, in lock-step: to the last bit."""
    found = []
    for name, mounted in (("factory", FACTORY), ("otherwise", OTHERWISE)):
        with robot_with(tmp_path / name, mounted, protocol) as robot:
            port = str(tmp_path / name / "bus")
            settings = BusSettings(port, protocol=protocol, board=200, timeout=0.3)
            bus = Bus(settings, IDS, mountings=mounted)
            bus.open()
            robot.reset(Hold.ROPE)
            found.append(moved(bus))
            np.testing.assert_allclose(found[-1]["position"][0], found[-1]["start"], atol=0.06)
            true = robot.plant.angles[0]
            np.testing.assert_allclose(found[-1]["position"][-1], true, atol=0.06)
    factory, otherwise = found
    assert factory["position"][-1, HEAD] - factory["start"][HEAD] > 0.2
    for what, told in factory.items():
        np.testing.assert_array_equal(otherwise[what], told, what)


def config(folder: Path, joints: Mapping[str, Mounting]) -> str:
    """A configuration that tells how servos are mounted."""
    text = CONFIG.format(folder=folder, protocol=1, clock="lockstep")
    told = (f"[bus.joints.{k}]\nsign = {m.sign}\nzero = {m.zero}\n" for k, m in joints.items())
    return changed(text, "".join(told))


def recorded(folder: Path, mounted: Sequence[Mounting]) -> Recording:
    """A script that an agent plays, on a robot whose servos are mounted like this."""
    (script,) = scripts(DARWIN, ("step:0.1",), np.random.default_rng(1))
    with robot_with(folder, mounted) as robot:
        joints = dict(zip(DARWIN.joint_names, mounted, strict=True))
        (folder / "agent.toml").write_text(config(folder, joints))
        made = Lab(folder, cast(Any, None))  # the robot lives in this process
        try:
            made.start()
            made.side(cmd="reset", hold="rope")
            wait(lambda: "position" in made.health(), 20, made.log)
            true = dict(zip(DARWIN.joint_names, robot.plant.angles[0], strict=True))
            assert made.health()["position"] == pytest.approx(true, abs=0.06)
            made.say("enable")
            made.say("pose", script=script.document())
            wait(lambda: made.health()["script"]["stage"] == "ready", 60, made.log)
            made.say("play")
            wait(lambda: made.health()["script"]["stage"] == "", 120, made.log)
            result = made.health()["script"]["result"]
            assert "recording" in result, result
            return Recording.read(Path(result["recording"]))
        finally:
            made.end()


def test_an_agent_records_and_obeys_the_same_on_turned_servos(tmp_path: Path) -> None:
    factory = recorded(tmp_path / "factory", FACTORY)
    otherwise = recorded(tmp_path / "otherwise", OTHERWISE)
    np.testing.assert_array_equal(otherwise.target, factory.target)
    np.testing.assert_allclose(otherwise.position, factory.position, atol=4 * TICK)
    assert np.ptp(factory.position, axis=0).max() > 0.07
    for name in (f"{kind}/{j}" for kind in ("velocity", "load") for j in DARWIN.joint_names):
        one, two = factory.extras[name], otherwise.extras[name]
        assert np.linalg.norm(two - one) < 0.5 * np.linalg.norm(two + one), name


def test_a_joint_that_is_none_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "agent.toml"
    file.write_text(config(tmp_path, {"l_nee": Mounting(-1)}))
    assert main(["run", "--config", str(file)]) == 2
    (told,) = capsys.readouterr().err.splitlines()
    assert "bus.joints.l_nee: robot 'darwin_op2' has no such joint; it has l_sho_pitch" in told


def test_what_a_servo_does_not_reach_is_held_back(tmp_path: Path) -> None:
    """So a recording tells the goal that the servo was told; a range out of reach is refused."""
    file = tmp_path / "agent.toml"
    file.write_text(config(tmp_path, {"l_knee": Mounting(1, 1000)}))
    body = Body(Settings.read(file), DARWIN)
    knee = DARWIN.joint_names.index("l_knee")
    assert DARWIN.joints[knee].lower < -1.8
    assert body.limiter.within(np.full(N, -9.0))[knee] == pytest.approx(-1000 * TICK)
    file.write_text(config(tmp_path, {"l_knee": Mounting(1, 0)}))
    with pytest.raises(InputError, match=r"joints.l_knee: the servo reaches 0.00 to 6.28 rad only"):
        Body(Settings.read(file), DARWIN)
    assert math.isclose(Mounting(-1, 0).reach[0], -LAST * TICK)


@pytest.mark.parametrize("protocol", [1, 2])
def test_limits_that_a_servo_holds_itself_hold_targets_back(tmp_path: Path, protocol: int) -> None:
    """Else the servo would stay where it is, and the recording tell a goal that it never had."""
    least, largest = (
        ("cw_angle_limit", "ccw_angle_limit") if protocol == 1 else ("min_position", "max_position")
    )
    with robot_with(tmp_path, FACTORY, protocol) as robot:
        file = tmp_path / "agent.toml"
        file.write_text(CONFIG.format(folder=tmp_path, protocol=protocol, clock="lockstep"))
        body = Body(Settings.read(file), DARWIN)
        robot.servos[HEAD].memory.put(largest, 2048 + 200)
        told = [line for line in body.open() if "only" in line]
        limit = 200 * TICK
        assert told == [f"servo {IDS[HEAD]} takes head_tilt from -3.14 to {limit:.2f} rad only"]
        assert DARWIN.limits[1][HEAD] > limit
        assert body.limiter.within(np.full(N, 9.0))[HEAD] == pytest.approx(limit)
        body.close()
        robot.servos[HEAD].memory.put(least, 2048 + 199)
        robot.servos[HEAD].memory.put(largest, 2048 - 199)
        with pytest.raises(InputError, match=f"servo {IDS[HEAD]} takes no angles, as its angle"):
            body.open()
        body.close()


@pytest.mark.parametrize("protocol", [1, 2])
def test_a_servo_in_another_mode_is_refused(tmp_path: Path, protocol: int) -> None:
    with robot_with(tmp_path, FACTORY, protocol) as robot:
        memory = robot.servos[HEAD].memory
        if protocol == 1:
            memory.put("ccw_angle_limit", 0)  # of the wheel mode, with the other limit at 0
        else:
            memory.put("operating_mode", 4)
        port = str(tmp_path / "bus")
        bus = Bus(BusSettings(port, protocol=protocol, board=200, timeout=0.3), IDS)
        told = "limits are 0 and 0; set joint mode" if protocol == 1 else "mode 4 and takes no angl"
        with pytest.raises(InputError, match=f"{port}: servo {IDS[HEAD]} .*{told}"):
            bus.open()
        bus.close()
