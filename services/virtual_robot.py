"""The job behind `pup virtual-robot`: a robot that is not there, on pseudo-terminals."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hardware_agent.virtual.robot import VirtualRobot
from hardware_agent.virtual.server import Ports, Server
from pup.robot import RobotDescription


@dataclass(frozen=True)
class Wanted:
    """Which robot, where, and how its time passes.

    Attributes:
      seed: decides on its physics.
      protocol: of the Dynamixel bus, 1 or 2.
      speed: of simulated time against the clock; 0 for lock-step.
      period: that passes in lock-step with every write of goals, s.
      ports: where it is found.
    """

    seed: int
    protocol: int
    speed: float
    period: float
    ports: Ports

    @classmethod
    def of(cls, link: Path, imu: Path, side: Path, **others: Any) -> "Wanted":
        """From the options of the command line."""
        return cls(ports=Ports(link, imu, side), **others)


def serve(robot: RobotDescription, wanted: Wanted, ready: Callable[[str], None]) -> dict[str, Any]:
    """Let the robot live until the process is stopped.

    Args:
      robot: its description.
      wanted: which one.
      ready: called once the ports are there, with a line to tell.

    Returns:
      What is said when it has ended.

    Raises:
      InputError: the robot has no servo ids, or a port cannot be made.
    """
    body = VirtualRobot(robot, wanted.seed, wanted.protocol)
    ports = wanted.ports
    with suppress(KeyboardInterrupt), Server(body, ports, wanted.speed, wanted.period) as server:
        pace = f"{wanted.speed:g} x real time" if wanted.speed else "lock-step"
        ready(f"{robot.name}: bus {ports.link}, imu {ports.imu}, side {ports.side}; {pace}")
        server.run()
    return {"robot": robot.name, "seed": wanted.seed, "time": body.time}
