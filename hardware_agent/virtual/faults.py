"""Faults on demand: what breaks on a real robot, and how it is mended."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from hardware_agent.virtual.robot import VirtualRobot
from hardware_agent.virtual.servo import Servo
from pup.errors import InputError


class Faults:
    """What is broken.

    Attributes:
      pulled: whether the bus's cable is out: no byte gets through.
      unplugged: whether the port itself is gone.
      noise: probability that a burst of bytes is disturbed.

    Args:
      robot: that breaks.
      seed: of the noise.
    """

    def __init__(self, robot: VirtualRobot, seed: int) -> None:
        self.robot = robot
        self._rng = np.random.default_rng((seed, 0xFA17))
        self.pulled = self.unplugged = False
        self.noise = 0.0
        self._kinds = {
            "dead_servo": self._dead_servo,
            "stuck_encoder": self._stuck_encoder,
            "hot_motor": self._hot_motor,
            "noise": self._noise,
            "bus_pulled": self._bus_pulled,
            "port_pulled": self._port_pulled,
            "imu_silent": self._imu_silent,
            "imu_frozen": self._imu_frozen,
            "low_battery": self._low_battery,
        }

    def cause(self, told: Mapping[str, Any]) -> None:
        """Break something.

        Args:
          told: `kind`, and what the kind needs: `id`, `temperature`, `rate`, `charge`; `off` mends.

        Raises:
          InputError: no such fault, or no such servo.
        """
        kind = self._kinds.get(str(told.get("kind")))
        if kind is None:
            raise InputError(
                f"fault {told.get('kind')!r} is unknown; known: {', '.join(self._kinds)}"
            )
        kind(told, not told.get("off", False))

    def clear(self) -> None:
        """Mend everything; what is hot cools down, servos that let go stay so."""
        self.pulled = self.unplugged = False
        self.noise = 0.0
        self.robot.imu.alive, self.robot.imu.frozen = True, False
        self.robot.plant.drives.stuck.clear()
        for servo in self.robot.servos:
            servo.plug(True)
        self.robot.cool()
        self.robot.battery()

    def disturb(self, data: bytes) -> bytes:
        """What of some bytes arrives."""
        if not data or self._rng.random() >= self.noise:
            return data
        place = int(self._rng.integers(len(data)))
        strange = self._rng.bytes(int(self._rng.integers(1, 9)))
        if self._rng.random() < 0.5:
            return data[:place] + strange + data[place:]
        return data[:place] + strange[:1] + data[place + 1 :]

    def _servo(self, told: Mapping[str, Any]) -> Servo:
        for servo in self.robot.servos:
            if servo.id == told.get("id"):
                return servo
        raise InputError(f"fault {told['kind']}: no servo has id {told.get('id')!r}")

    def _dead_servo(self, told: Mapping[str, Any], on: bool) -> None:
        """It neither answers nor holds."""
        self._servo(told).plug(not on)

    def _stuck_encoder(self, told: Mapping[str, Any], on: bool) -> None:
        servo = self._servo(told)
        stuck = self.robot.plant.drives.stuck
        if on:
            stuck[servo.at] = float(servo.position)
        else:
            stuck.pop(servo.at, None)

    def _hot_motor(self, told: Mapping[str, Any], on: bool) -> None:
        servo = self._servo(told)
        drives = self.robot.plant.drives
        if on:
            degrees = _number(told, "temperature", 85.0, -20.0, 200.0)
            drives.case[servo.at] = drives.winding[servo.at] = degrees
        else:
            drives.cool()

    def _noise(self, told: Mapping[str, Any], on: bool) -> None:
        self.noise = _number(told, "rate", 0.1, 0.0, 1.0) if on else 0.0

    def _bus_pulled(self, told: Mapping[str, Any], on: bool) -> None:
        self.pulled = on

    def _port_pulled(self, told: Mapping[str, Any], on: bool) -> None:
        self.unplugged = on

    def _imu_silent(self, told: Mapping[str, Any], on: bool) -> None:
        self.robot.imu.alive = not on

    def _imu_frozen(self, told: Mapping[str, Any], on: bool) -> None:
        self.robot.imu.frozen = on

    def _low_battery(self, told: Mapping[str, Any], on: bool) -> None:
        if on:
            self.robot.plant.drives.charge[0] = _number(told, "charge", 0.0, -1.0, 1.0)
            self.robot.plant.drives.refresh()
        else:
            self.robot.battery()


def _number(told: Mapping[str, Any], name: str, default: float, low: float, high: float) -> float:
    value = told.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise InputError(f"fault {told['kind']}: {name} is not between {low:g} and {high:g}")
    return float(value)
