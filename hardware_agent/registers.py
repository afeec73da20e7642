"""Control tables of the MX-28 and the CM-740, as far as the agent uses them, and their units.

ROBOTIS e-manual, MX-28 (Protocol 1.0), MX-28 (2.0), OP2 sub-controller.
"""

import math
from dataclasses import dataclass

from hardware_agent.mounting import Mounting

RPM = 2 * math.pi / 60  # rad/s
POSITION = 3  # operating mode of Protocol 2.0 in which goals are angles within one turn

Span = tuple[int, int]
"""Address and length."""


@dataclass(frozen=True)
class Status:
    """What a servo tells of its joint; None for what was not asked.

    Attributes:
      position: rad.
      velocity: rad/s.
      load: of full scale; inferred by the firmware from its output, not a torque measurement.
      voltage: V.
      temperature: °C.
      alarm: what it complains of, in words; empty for nothing.
    """

    position: float
    velocity: float | None = None
    load: float | None = None
    voltage: float | None = None
    temperature: float | None = None
    alarm: str = ""


@dataclass(frozen=True)
class Registers:
    """A servo's control table for one protocol.

    Attributes:
      protocol: 1 or 2.
      model: number that its servos answer.
      mode: EEPROM; POSITION holds angles; None where the limits tell the mode.
      limits: EEPROM; least and largest goal, ticks.
      return_delay: EEPROM; 0 answers at once.
      status_level: which instructions are answered.
      torque_enable: 1 holds, 0 is limp.
      gains: of P, I and D.
      speed: of the goal's motion; 0 for no limit.
      acceleration: likewise; old firmware for 1.0 has none.
      goal: position, ticks.
      paper: P, I and D of the paper, Kp 4 and Kd 0.064, in the units of this firmware.
      power_limit: largest duty.
      own_power: EEPROM; the largest value of it that the servo allows itself.
      full_power: value of both that limits nothing.
      bus_watchdog: 20 ms without an instruction after which the servo stops; None without one.
      hardware_error: bits of what shut the servo down; None where the status packet tells them.
      position: of the encoder.
      orders: from the first to the last of what a servo is told before it holds.
      block: everything a tick wants to know, position included.
    """

    protocol: int
    model: int
    mode: Span | None
    limits: tuple[Span, Span]
    return_delay: Span
    status_level: Span
    torque_enable: Span
    gains: tuple[Span, Span, Span]
    paper: tuple[int, ...]
    speed: Span
    acceleration: Span
    goal: Span
    power_limit: Span
    own_power: Span
    full_power: int
    bus_watchdog: Span | None
    hardware_error: Span | None
    position: Span
    orders: Span
    block: Span

    def status(self, data: bytes, error: int, detailed: bool, mounting: Mounting) -> Status:
        """What a servo's answer says.

        Args:
          data: of `block`, or of `position`.
          error: byte of the status packet.
          detailed: which of them it is.
          mounting: of the servo.
        """
        alarm = _alarm(self.protocol, error)
        if not detailed:
            position = int.from_bytes(data, "little", signed=self.protocol == 2)
            return Status(mounting.angle(position), alarm=alarm)
        sign = mounting.sign
        if self.protocol == 1:
            return Status(
                mounting.angle(_word(data, 0)),
                sign * _signed(_word(data, 2)) * 0.114 * RPM,
                sign * _signed(_word(data, 4)) / 1023,
                data[6] / 10,
                float(data[7]),
                alarm,
            )
        return Status(
            mounting.angle(int.from_bytes(data[6:10], "little", signed=True)),
            sign * int.from_bytes(data[2:6], "little", signed=True) * 0.229 * RPM,
            sign * int.from_bytes(data[0:2], "little", signed=True) / 1000,
            _word(data, 18) / 10,
            float(data[20]),
            alarm,
        )


REGISTERS = {
    1: Registers(
        protocol=1,
        model=29,
        mode=None,
        limits=((6, 2), (8, 2)),
        return_delay=(5, 1),
        status_level=(16, 1),
        torque_enable=(24, 1),
        gains=((28, 1), (27, 1), (26, 1)),
        paper=(32, 0, 16),
        speed=(32, 2),
        acceleration=(73, 1),
        goal=(30, 2),
        power_limit=(34, 2),
        own_power=(14, 2),
        full_power=1023,
        bus_watchdog=None,
        hardware_error=None,
        position=(36, 2),
        orders=(26, 10),
        block=(36, 8),
    ),
    2: Registers(
        protocol=2,
        model=30,
        mode=(11, 1),
        limits=((52, 4), (48, 4)),
        return_delay=(9, 1),
        status_level=(68, 1),
        torque_enable=(64, 1),
        gains=((84, 2), (82, 2), (80, 2)),
        paper=(512, 0, 1),
        speed=(112, 4),
        acceleration=(108, 4),
        goal=(116, 4),
        power_limit=(100, 2),
        own_power=(36, 2),
        full_power=885,
        bus_watchdog=(98, 1),
        hardware_error=(70, 1),
        position=(132, 4),
        orders=(80, 40),
        block=(126, 21),
    ),
}
"""By protocol."""

BOARD_POWER: Span = (24, 1)
"""CM-740: 1 gives the servos current."""
BOARD_SENSES: Span = (38, 13)
"""CM-740: gyro z, y, x, accelerometer x, y, z, and voltage."""
GYRO_FULL = math.radians(500)  # rad/s at 512 from the centre
ACCEL_FULL = 4 * 9.80665  # m/s² likewise

ALARMS = {0x01: "input voltage", 0x04: "overheating", 0x20: "overload"}
"""Bits of Protocol 1.0 that tell of the servo; the others tell of a packet."""
HARDWARE = {0x01: "input voltage", 0x04: "overheating", 0x10: "electrical shock", 0x20: "overload"}
"""Bits of the register of Protocol 2.0; 0x08, the motor's encoder, is added by newer servos."""


def hardware_alarm(bits: int) -> str:
    """What `hardware_error` says, in words."""
    return _words(HARDWARE, bits)


def board_senses(
    data: bytes,
) -> tuple[tuple[float, float, float], tuple[float, float, float], float]:
    """Gyro in rad/s and accelerometer in m/s², along the torso's axes, and voltage.

    As ROBOTIS' framework reads them: the accelerometer's x points to the right and its y forward
    (y below 390 is a fall forward); the gyro's x and y turn against the torso's roll and pitch, or
    the gyro's part in the framework's walk would push the robot over.

    Args:
      data: of BOARD_SENSES.
    """
    z, y, x, right, ahead, up = ((_word(data, 2 * i) - 512) / 512 for i in range(6))
    gyro = -GYRO_FULL * x, -GYRO_FULL * y, GYRO_FULL * z
    return gyro, (ACCEL_FULL * ahead, -ACCEL_FULL * right, ACCEL_FULL * up), data[12] / 10


def _alarm(protocol: int, error: int) -> str:
    if protocol == 1:
        return _words(ALARMS, error)
    return "hardware error" if error & 0x80 else ""


def _words(names: dict[int, str], bits: int) -> str:
    return ", ".join(name for bit, name in names.items() if bits & bit)


def _word(data: bytes, at: int) -> int:
    return data[at] | data[at + 1] << 8


def _signed(word: int) -> int:
    """Ten bits of size and one of direction, of which 1 is clockwise: negative."""
    size = word & 0x3FF
    return -size if word & 0x400 else size
