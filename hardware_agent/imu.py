"""The torso's orientation: a BNO055 with its own fusion, or what the CM-740 has.

A question is sent before the servos are read and its answer taken after, so that a tick does not
wait for it: 38 bytes take 3.3 ms at the BNO055's 115,200 baud.
"""

import math
import select
import time
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import serial
from numpy.typing import NDArray

from hardware_agent.config import ImuSettings
from hardware_agent.port import FAILURES, BusError, device_error
from hardware_agent.registers import board_senses
from pup.errors import InputError

Array = NDArray[np.float64]

CHIP, CHIP_ID = 0x00, 0xA0
UNITS, MODE = 0x3B, 0x3D
ANDROID = 0x80  # m/s², degrees/s and, as after power-on, the Euler angles by Android's convention
CONFIG_MODE, IMU_MODE = 0x00, 0x08
FIRST, LENGTH = 0x08, 32
"""Accelerometer, magnetometer, gyroscope, Euler angles and quaternion, in one stretch."""
TRIES = 3  # to configure it
SWITCH = 0.03  # s that a change of the mode takes at most (datasheet, table 3-6)
ACCEL, RATE, TURN = 0.01, 1 / 16, 2.0**-14  # m/s², degrees/s, and of a quaternion, per count
LENGTH_ERROR = 0.02  # of a quaternion; the chip's are of length 1 but for rounding
I2C_ADDRESS = 0x28


@dataclass(frozen=True, eq=False)
class Orientation:
    """One sample of the IMU, of the torso: x forward, y left, z up.

    Attributes:
      roll: Z-Y-X Euler angles, rad.
      pitch: leaning forward is positive.
      yaw: from wherever it was switched on.
      gyro: rad/s, shape (3,).
      accel: m/s², shape (3,); upwards at rest.
    """

    roll: float
    pitch: float
    yaw: float
    gyro: Array
    accel: Array

    def same(self, other: "Orientation") -> bool:
        """Whether every number is that of the other sample, as in a chip that hangs."""
        return bool((self.gyro == other.gyro).all() and (self.accel == other.accel).all())


class Imu(Protocol):
    """What a tick needs of an IMU."""

    def open(self) -> None:
        """Find and configure it; BusError when it does not answer."""

    def ask(self) -> None:
        """Send the question."""

    def take(self, board: bytes | None, now: float) -> Orientation | None:
        """The answer; None when there is none in time.

        Args:
          board: what the CM-740 told with the servos.
          now: of the tick, s.
        """

    def close(self) -> None:
        """Give the port up."""


def imu_of(settings: ImuSettings) -> Imu | None:
    """The IMU that the settings name."""
    if settings.kind == "bno055-uart":
        return Bno055(settings, Uart(settings))
    if settings.kind == "bno055-i2c":
        return Bno055(settings, I2c(settings))
    return Board() if settings.kind == "cm740" else None


class Uart:
    """The BNO055's registers over its UART (datasheet, section 4.7).

    Args:
      settings: of the port.
    """

    def __init__(self, settings: ImuSettings) -> None:
        self._settings = settings
        self._port: Any = None

    def open(self) -> None:
        """Open the port."""
        self._port = serial.Serial(self._settings.port, 115_200, timeout=0)

    def close(self) -> None:
        """Close it."""
        if self._port is not None:
            self._port.close()

    def write(self, register: int, value: int) -> bool:
        """Set a register; False when it was not taken."""
        self._send(bytes([0xAA, 0x00, register, 1, value]))
        return self._receive(2) == b"\xee\x01"

    def ask(self, register: int, length: int) -> None:
        """Send the question for some registers."""
        self._send(bytes([0xAA, 0x01, register, length]))

    def take(self, length: int) -> bytes | None:
        """Its answer; None for a refusal, which a busy chip gives now and then, or silence."""
        answer = self._receive(length + 2)
        whole = len(answer) == length + 2 and answer[:2] == bytes([0xBB, length])
        return answer[2:] if whole else None

    def _send(self, data: bytes) -> None:
        self._port.reset_input_buffer()
        self._port.write(data)
        self._sent = time.monotonic()

    def _receive(self, length: int) -> bytes:
        deadline = self._sent + (length + 5) * 10 / 115_200 + self._settings.timeout
        read: bytes = self._port.read(length)
        while len(read) < length and not (read[:1] == b"\xee" and len(read) >= 2):
            left = deadline - time.monotonic()
            if left <= 0:
                break
            select.select([self._port.fileno()], [], [], left)
            read += self._port.read(length - len(read))
        return read


class I2c:
    """The BNO055's registers over I2C, by smbus2.

    Args:
      settings: `port` is the number of the bus.
    """

    def __init__(self, settings: ImuSettings) -> None:
        self._settings = settings
        self._bus: Any = None
        self._asked = (CHIP, 1)

    def open(self) -> None:
        """Open the bus."""
        try:
            from smbus2 import SMBus
        except ImportError as error:
            raise InputError('imu.kind "bno055-i2c" needs smbus2; pip install smbus2') from error
        try:
            self._bus = SMBus(int(self._settings.port))
        except ValueError as error:
            raise InputError(f"imu.port: {self._settings.port!r} is no I2C bus number") from error

    def close(self) -> None:
        """Close it."""
        if self._bus is not None:
            self._bus.close()

    def write(self, register: int, value: int) -> bool:
        """Set a register."""
        self._bus.write_byte_data(I2C_ADDRESS, register, value)
        return True

    def ask(self, register: int, length: int) -> None:
        """Note what is wanted: the bus has no questions without answers."""
        self._asked = register, length

    def take(self, length: int) -> bytes | None:
        """Read it; None when the chip does not acknowledge."""
        try:
            return bytes(self._bus.read_i2c_block_data(I2C_ADDRESS, *self._asked))
        except OSError:
            return None


class Bno055:
    """A BNO055 in its relative mode: a magnetometer among twenty motors tells nothing.

    Its quaternion is read, from its own axes to a world with z up. Its Euler angles are of no use:
    a bit of the unit register turns the pitch's sign, they are not the torso's Z-Y-X angles, and
    firmware 0x0311 distorts them beyond 20 degrees.

    Args:
      settings: how it is mounted.
      wire: its registers.
    """

    def __init__(self, settings: ImuSettings, wire: Uart | I2c) -> None:
        self._settings = settings
        self._wire = wire
        self._signs = np.array([-1.0 if axis[0] == "-" else 1.0 for axis in settings.axes])
        self._order = ["xyz".index(axis[-1]) for axis in settings.axes]
        self._ahead = _euler(self._of_torso(np.eye(3)))[2]

    def open(self) -> None:
        """Find it and start its fusion."""
        place = f"{self._settings.kind} at {self._settings.port}"
        try:
            self._wire.open()
            for _ in range(10):  # it may be in the middle of something, or booting: 0.65 s
                self._wire.ask(CHIP, 1)
                if self._wire.take(1) == bytes([CHIP_ID]):
                    break
                time.sleep(0.1)
            else:
                raise BusError(f"{place}: no BNO055 answers")
        except FAILURES as error:
            raise BusError(f"{place}: {device_error(error)}") from error
        if not self.configure():
            raise BusError(f"{place}: cannot be configured")

    def configure(self) -> bool:
        """Start its fusion; False where it does not take that.

        Raises:
          BusError: the port is gone.
        """
        try:
            for register, value in ((MODE, CONFIG_MODE), (UNITS, ANDROID), (MODE, IMU_MODE)):
                if not any(self._wire.write(register, value) for _ in range(TRIES)):
                    return False
                time.sleep(SWITCH)
        except FAILURES as error:
            raise BusError(f"{self._settings.port}: {device_error(error)}") from error
        return True

    def close(self) -> None:
        """Give the port up."""
        self._wire.close()

    def ask(self) -> None:
        """Send the question."""
        try:
            self._wire.ask(FIRST, LENGTH)
        except FAILURES as error:
            raise BusError(f"{self._settings.port}: {device_error(error)}") from error

    def take(self, board: bytes | None, now: float) -> Orientation | None:
        """The answer; asked for again where it is refused, which is quick, or did not come."""
        try:
            end = time.monotonic() + 1.5 * self._settings.timeout
            while (data := self._wire.take(LENGTH)) is None:
                if time.monotonic() > end:
                    return None
                self._wire.ask(FIRST, LENGTH)
        except FAILURES as error:
            raise BusError(f"{self._settings.port}: {device_error(error)}") from error
        return self._read(data)

    def _read(self, data: bytes) -> Orientation | None:
        """What the registers say; None where their quaternion is none.

        A chip that was reset, by a supply that broke down, tells zeros until it is configured:
        upright and quiet, whatever the robot does.
        """
        counts = np.frombuffer(data, "<i2").astype(np.float64)
        turn = counts[12:16] * TURN
        if abs(np.linalg.norm(turn) - 1) > LENGTH_ERROR:
            return None
        roll, pitch, yaw = _euler(self._of_torso(_matrix(turn)))
        return Orientation(
            roll,
            pitch,
            math.remainder(yaw - self._ahead, 2 * math.pi),
            self._of_torso(np.radians(counts[6:9] * RATE)),
            self._of_torso(counts[0:3] * ACCEL),
        )

    def _of_torso(self, values: Array) -> Array:
        """Values along the chip's axes, in the last dimension, along the torso's."""
        return np.asarray(self._signs * values[..., self._order])


class Board:
    """The CM-740's gyroscope and accelerometer through a complementary filter.

    The paper's reason for the BNO055: these come at the rate of the control loop only.
    """

    TIME = 1.0
    """s, below which the gyroscope is believed and above which the accelerometer."""

    def __init__(self) -> None:
        self._time = math.nan
        self._tilt = np.zeros(3)

    def open(self) -> None:
        """Forget what was."""
        self._time = math.nan

    def configure(self) -> bool:
        """Nothing: the board has no modes."""
        return True

    def ask(self) -> None:
        """Nothing: it is asked with the servos."""

    def close(self) -> None:
        """Nothing: the bus has the port."""

    def take(self, board: bytes | None, now: float) -> Orientation | None:
        """What the board told with the servos, filtered."""
        if board is None:
            return None
        gyro, accel, _ = board_senses(board)
        x, y, z = accel
        felt = np.array([math.atan2(y, z), math.atan2(-x, math.hypot(y, z)), self._tilt[2]])
        step = now - self._time
        if not 0 <= step < 0.5:
            self._tilt = felt
        else:
            turned = self._tilt + np.array(gyro) * step
            self._tilt = turned + (felt - turned) * min(1.0, step / self.TIME)
            self._tilt[2] = turned[2]
        self._time = now
        roll, pitch, yaw = map(float, self._tilt)
        return Orientation(roll, pitch, yaw, np.array(gyro), np.array(accel))


def _matrix(turn: Array) -> Array:
    """The rotation matrix of a quaternion w, x, y, z; its length need not be quite 1."""
    w, x, y, z = turn / np.linalg.norm(turn)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _euler(turn: Array) -> tuple[float, float, float]:
    """Roll, pitch and yaw (Z-Y-X Euler angles) of a rotation matrix to the world, rad."""
    return (
        math.atan2(turn[2, 1], turn[2, 2]),
        math.asin(min(1.0, max(-1.0, -turn[2, 0]))),
        math.atan2(turn[1, 0], turn[0, 0]),
    )
