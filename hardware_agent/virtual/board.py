"""The CM-740: switch of the servos' power, gyroscope, accelerometer, voltage and buttons."""

import numpy as np

from hardware_agent.virtual.device import Device
from hardware_agent.virtual.plant import Plant
from hardware_agent.virtual.servo import Servo
from hardware_agent.virtual.tables import CM740, Register

RATE = np.radians(500.0)  # rad/s of half the scale
FORCE = 4 * 9.81  # m/s2 of half the scale
HALF, LARGEST = 512, 1023
AXES = {
    **{"gyro_x": (-1, 0), "gyro_y": (-1, 1), "gyro_z": (1, 2)},
    **{"acc_x": (-1, 1), "acc_y": (1, 0), "acc_z": (1, 2)},
}
"""Sign and axis of the torso that a register tells, after ROBOTIS' framework: its balance in
walking and its detection of falls need them so."""


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
            if register.name == "present_voltage":
                volts = self.plant.drives.volts[self.lane, 0]
                self.memory.put(register.name, round(float(volts) * 10))
            elif register.name == "button":
                self.memory.put("button", self.button)
            elif register.name in AXES and self.plant.imus is not None:
                sign, axis = AXES[register.name]
                _, rate, force = self.plant.imus.read(self.lane)
                share = rate / RATE if register.name.startswith("gyro") else force / FORCE
                value = HALF + sign * round(float(share[axis]) * HALF)
                self.memory.put(register.name, min(max(value, 0), LARGEST))
