"""What servos hold on to: a watchdog that has bitten, limits of their own, gains and speeds."""

from pathlib import Path

import numpy as np
import pytest
from agents import CONFIG, DARWIN
from test_agent_mounting import FACTORY, HEAD, IDS, robot_with

from hardware_agent.body import Body
from hardware_agent.bus import Bus
from hardware_agent.config import BusSettings, Settings
from hardware_agent.senses import Response, Senses
from hardware_agent.virtual.robot import VirtualRobot

pytest.importorskip("mujoco")


def bus_of(folder: Path, protocol: int) -> Bus:
    settings = BusSettings(str(folder / "bus"), protocol=protocol, board=200, timeout=0.3)
    return Bus(settings, IDS)


def pose_of(bus: Bus) -> np.ndarray:
    answers = bus.read().servos
    return np.array([answers[name].position for name in IDS])


def body_of(folder: Path, protocol: int) -> Body:
    file = folder / "agent.toml"
    file.write_text(CONFIG.format(folder=folder, protocol=protocol, clock="lockstep"))
    return Body(Settings.read(file), DARWIN)


def sensed(body: Body) -> Senses:
    return body.sense(1.0, walking=False, alone=False)


def powers(robot: VirtualRobot) -> set[float]:
    """Share of their duty that servos may use."""
    return set(robot.plant.drives.orders.limit[0].tolist())


def test_a_watchdog_that_has_bitten_keeps_no_servo_at_the_power_of_a_fallen_robot(
    tmp_path: Path,
) -> None:
    """A fall, then the agent ends; the servos' own watchdogs bite, and goals are read-only."""
    with robot_with(tmp_path, FACTORY, protocol=2) as robot:
        body = body_of(tmp_path, 2)
        body.open()
        assert body.enable(sensed(body)) is None and powers(robot) == {1.0}
        body.make_safe(Response.SOFT, sensed(body), 1.0)
        assert powers(robot) == {177 / 885}
        body.close()
        for servo in robot.servos:
            servo.watch(robot.time + 10.0)
        body.open()
        assert body.enable(sensed(body)) is None
        assert powers(robot) == {1.0}
        body.close()


def test_a_servo_that_keeps_its_power_limit_is_named_and_nothing_holds(tmp_path: Path) -> None:
    with robot_with(tmp_path, FACTORY, protocol=2) as robot:
        body = body_of(tmp_path, 2)
        body.open()
        servo = robot.servos[HEAD]
        servo.memory.put("goal_pwm", 177)
        servo.memory.put("pwm_limit", 200)  # since it was opened: 885 is refused
        refused = body.enable(sensed(body))
        assert str(refused) == ("enable: not taken: head_tilt has power limit 177 instead of 885")
        assert not any(s.memory.get("torque_enable") for s in robot.servos)
        body.close()
