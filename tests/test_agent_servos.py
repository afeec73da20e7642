"""What servos hold on to: a watchdog that has bitten, limits of their own, gains and speeds."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest
from agents import CONFIG, DARWIN, Lab, changed, lab, wait
from test_agent_mounting import FACTORY, HEAD, IDS, robot_with

from hardware_agent.body import Body
from hardware_agent.config import Settings
from hardware_agent.registers import REGISTERS, Span
from hardware_agent.senses import Response, Senses
from hardware_agent.virtual.robot import VirtualRobot
from hardware_agent.virtual.tables import MX28_1

pytest.importorskip("mujoco")


def configured(folder: Path, protocol: int, timeout: float) -> Path:
    file = folder / "agent.toml"
    text = CONFIG.format(folder=folder, protocol=protocol, clock="lockstep")
    file.write_text(changed(text, f"[bus]\ntimeout = {timeout}\n"))
    return file


@contextmanager
def robot_and_body(folder: Path, protocol: int) -> Iterator[tuple[VirtualRobot, Body]]:
    with robot_with(folder, FACTORY, protocol) as robot:
        body = Body(Settings.read(configured(folder, protocol, 0.3)), DARWIN)
        try:
            yield robot, body
        finally:
            body.close()


def sensed(body: Body) -> Senses:
    return body.sense(1.0, walking=False, alone=False)


def powers(robot: VirtualRobot) -> set[float]:
    """Share of their duty that servos may use."""
    return set(robot.plant.drives.orders.limit[0].tolist())


def test_a_watchdog_that_has_bitten_keeps_no_servo_at_the_power_of_a_fallen_robot(
    tmp_path: Path,
) -> None:
    """A fall, then the agent ends; the servos' own watchdogs bite, and goals are read-only."""
    with robot_and_body(tmp_path, 2) as (robot, body):
        body.open()
        assert body.enable(sensed(body)) is None and powers(robot) == {1.0}
        body.make_safe(Response.SOFT, sensed(body), 1.0)
        body.bus.read()  # once this is answered, what was written has arrived
        assert powers(robot) == {177 / 885}
        body.close()
        for servo in robot.servos:
            servo.watch(robot.time + 10.0)
        body.open()
        assert body.enable(sensed(body)) is None
        assert powers(robot) == {1.0}


KEPT = {1: "max_torque", 2: "pwm_limit"}
POWER = {1: "torque_limit", 2: "goal_pwm"}


@pytest.mark.parametrize("protocol", [1, 2])
def test_a_servo_keeps_the_power_limit_of_its_own(tmp_path: Path, protocol: int) -> None:
    """Somebody spares a gear with it: it is neither overwritten nor asked for in vain."""
    with robot_and_body(tmp_path, protocol) as (robot, body):
        memory, full = robot.servos[HEAD].memory, {1: 1023, 2: 885}[protocol]
        memory.put(KEPT[protocol], round(0.6 * full))
        told = [line for line in body.open() if "power" in line]
        assert told == [f"servo {IDS[HEAD]} gives head_tilt 60% of its power at most"]
        assert body.enable(sensed(body)) is None
        assert memory.get(POWER[protocol]) == round(0.6 * full)
        body.make_safe(Response.SOFT, sensed(body), 1.0)
        body.bus.read()  # once this is answered, what was written has arrived
        assert memory.get(POWER[protocol]) == pytest.approx(0.12 * full, abs=1)
        body.full_power()
        body.bus.read()
        assert memory.get(POWER[protocol]) == round(0.6 * full)
        assert robot.servos[0].memory.get(POWER[protocol]) == full


def test_a_servo_that_keeps_its_power_limit_is_named_and_nothing_holds(tmp_path: Path) -> None:
    with robot_and_body(tmp_path, 2) as (robot, body):
        body.open()
        servo = robot.servos[HEAD]
        servo.memory.put("goal_pwm", 177)
        servo.memory.put("pwm_limit", 200)  # since it was opened: 885 is refused
        refused = body.enable(sensed(body))
        assert str(refused) == ("enable: not taken: head_tilt has power limit 177 instead of 885")
        assert not any(s.memory.get("torque_enable") for s in robot.servos)


LEFT = {1: ("d_gain", 26), 2: ("position_d_gain", 80)}
ACCELERATION = {1: "goal_acceleration", 2: "profile_acceleration"}


@pytest.mark.parametrize("protocol", [1, 2])
@pytest.mark.parametrize("lost", [1, 2])
def test_gains_arrive_or_nothing_holds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, protocol: int, lost: int
) -> None:
    """Another program left its own; noise spoils one packet with the D gain, or both."""
    gain, address = LEFT[protocol]
    with robot_and_body(tmp_path, protocol) as (robot, body):
        body.open()
        for servo in robot.servos:
            servo.memory.put(gain, 99)
        left, send = [lost], body.bus.send

        def noisy(span: Span, values: Mapping[int, int]) -> None:
            if span[0] == address and left[0]:
                left[0] -= 1
            else:
                send(span, values)

        monkeypatch.setattr(body.bus, "send", noisy)
        refused = body.enable(sensed(body))
        if lost == 2:
            wanted = REGISTERS[protocol].paper[2]
            assert f"l_sho_pitch has D gain 99 instead of {wanted}, " in str(refused)
            assert str(refused).endswith(" and 17 more")
            assert not any(s.memory.get("torque_enable") for s in robot.servos)
        else:
            assert refused is None


@pytest.mark.parametrize("protocol", [1, 2])
def test_an_acceleration_that_another_program_left_is_taken_back(
    tmp_path: Path, protocol: int
) -> None:
    with robot_and_body(tmp_path, protocol) as (robot, body):
        body.open()  # which gives servos current
        robot.servos[HEAD].memory.put(ACCELERATION[protocol], 10)
        told = [line for line in body.open() if "acceleration" in line]
        assert told == [f"servo {IDS[HEAD]}: goal acceleration 10 made 0"]
        assert robot.servos[HEAD].memory.get(ACCELERATION[protocol]) == 0


@pytest.mark.parametrize(
    ("protocol", "register", "value"),
    [(1, "cw_angle_limit", 2300), (2, "min_position", 2300), (2, "homing_offset", -2200)],
)
def test_a_joint_beyond_what_its_servo_takes_is_not_enabled(
    tmp_path: Path, protocol: int, register: str, value: int
) -> None:
    """The servo could not be told to stay there: it would snap to the end of what it takes."""
    with robot_and_body(tmp_path, protocol) as (robot, body):
        robot.servos[HEAD].memory.put(register, value)
        body.open()
        refused = str(body.enable(sensed(body)))
        assert refused.startswith("enable: head_tilt is at ") and "turn it back by hand" in refused
        assert not any(s.memory.get("torque_enable") for s in robot.servos)
        robot.servos[HEAD].memory.put(register, 0)
        body.open()
        assert body.enable(sensed(body)) is None


def test_a_robot_that_is_switched_on_later_is_told_of_as_at_the_start(tmp_path: Path) -> None:
    """What is missing, then what was put right in the servos; and no trouble that is over."""
    with lab(tmp_path, speed=0.0) as made:
        made.side(cmd="fault", kind="dead_servo", id=11)
        made.start_silent()
        wait((tmp_path / "agent.sock").exists, 20, made.log)
        wait(lambda: "no answer from servo 11" in str(made.health()["problems"]), 20, made.log)
        made.side(cmd="fault", kind="dead_servo", id=11, off=True)
        wait(made.ready, 20, made.log)
        told = made.health()
        assert (told["state"], told["reason"], told["problems"]) == ("disabled", "", [])
        assert "servo 11: return delay 250 made 0" in made.log()


def test_old_firmware_has_no_acceleration(tmp_path: Path) -> None:
    with robot_and_body(tmp_path, 1) as (robot, body):
        old = replace(MX28_1, size=52, registers=MX28_1.registers[:-1])
        robot.servos[HEAD].memory.table = old
        body.open()
        assert body.enable(sensed(body)) is None


def test_servos_whose_board_was_reset_get_their_current_back(tmp_path: Path) -> None:
    """By the agent, which nobody has to start again."""
    with robot_with(tmp_path, FACTORY) as robot:
        configured(tmp_path, 1, 0.05)
        made = Lab(tmp_path, cast(Any, None))  # the robot lives in this process
        try:
            made.start()
            made.side(cmd="reset", hold="rope")
            wait(lambda: "position" in made.health(), 20, made.log)
            made.say("enable")
            robot.board.restart()
            assert "did not answer" in made.until("fault")["reason"]
            wait(lambda: all(servo.supplied for servo in robot.servos), 20, made.log)
            wait(lambda: made.health()["bus"]["works"] and made.health()["limp"], 20, made.log)
            assert made.say("enable")["state"] == "enabled"
        finally:
            made.end()
