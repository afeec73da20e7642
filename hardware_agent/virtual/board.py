"""The CM-740: switch of the servos' power, gyroscope, accelerometer, voltage and buttons."""

import numpy as np

from hardware_agent.virtual.device import Device
from hardware_agent.virtual.plant import Plant
from hardware_agent.virtual.servo import Servo
from hardware_agent.virtual.tables import CM740, Register

RATE = np.radians(500.0)  # rad/s of half the scale
FORCE = 4 * 9.81  # m/s2 of half the scale
HALF, LARGEST = 512, 1023
AXES = {"x": 0, "y": 1, "z": 2}


class Board(Device):
    """The board that the servos hang on.

    Args:
      plant: where the robot moves.
      servos: that it feeds.
      lane: which robot.
    """

    def __init__(self, plant: Plant, servos: list[Servo], lane: int = 0) -> None:
        super().__init__(CM740)
        self.plant, self.servos, self.lane = plant, servos, lane
        self.button = 0

    def written(self, register: Register, value: int) -> None:
        """Switch the servos' power."""
        if register.name == "dxl_power":
            for servo in self.servos:
                servo.supply(bool(value))

    def refresh(self, registers: list[Register]) -> None:
        """Read the sensors."""
        for register in registers:
            kind, _, axis = register.name.partition("_")
            if register.name == "present_voltage":
                volts = self.plant.drives.volts[self.lane, 0]
                self.memory.put(register.name, round(float(volts) * 10))
            elif register.name == "button":
                self.memory.put("button", self.button)
            elif kind in ("gyro", "acc") and self.plant.imus is not None:
                _, rate, force = self.plant.imus.read(self.lane)
                share = rate / RATE if kind == "gyro" else force / FORCE
                value = HALF + round(float(share[AXES[axis]]) * HALF)
                self.memory.put(register.name, min(max(value, 0), LARGEST))
