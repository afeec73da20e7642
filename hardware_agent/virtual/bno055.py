"""A BNO055 behind its UART: register protocol and the registers that a robot reads.

Bosch BST-BNO055-DS000, sections 3.6 (fusion output), 4 (registers) and 4.7 (UART protocol). The
chip lies on the torso as in the paper's authors' robot, x to the right, y forward, z up: where the
torso leans one way alone, what it calls -roll and, by Android's convention, pitch are the torso's.
"""

import numpy as np
from numpy.typing import NDArray

from hardware_agent.virtual.imu import conjugate, multiply, roll_pitch_yaw
from hardware_agent.virtual.plant import Plant

Array = NDArray[np.float64]

START, WRITE, READ = 0xAA, 0x00, 0x01
DATA, STATUS = 0xBB, 0xEE
SUCCESS, READ_FAIL, WRITE_FAIL = 0x01, 0x02, 0x03
BAD_ADDRESS, WRITE_DISABLED, WRONG_START, TOO_LONG = 0x04, 0x05, 0x06, 0x08
LONGEST = 128  # bytes of a read or write
SIZE = 0x6B  # registers of page 0
CONFIG, FUSION = 0x00, (0x08, 0x09, 0x0A, 0x0B, 0x0C)
CHIP, ACCELEROMETER, MAGNETOMETER, GYROSCOPE = 0xA0, 0xFB, 0x32, 0x0F
PAGE_ID, GYRO, EULER, QUATERNION = 0x07, 0x14, 0x1A, 0x20
FORCE, LINEAR, GRAVITY, TEMPERATURE = 0x08, 0x28, 0x2E, 0x34
CALIBRATION, SELF_TEST, SYSTEM, UNITS, MODE = 0x35, 0x36, 0x39, 0x3B, 0x3D
POWER, TRIGGER, AXES, SIGNS = 0x3E, 0x3F, 0x41, 0x42
WRITABLE = frozenset((PAGE_ID, UNITS, MODE, POWER, TRIGGER, 0x40, AXES, SIGNS, *range(0x43, SIZE)))
RESET = 0x20  # bit of the trigger register
RADIANS_PER_S, RADIANS, ANDROID = 1 << 1, 1 << 2, 1 << 7  # bits of the unit register
DEGREES, MILLIRADIANS = 16 * 180 / np.pi, 900.0  # counts per rad or rad/s in either unit
UNIT = 1 << 14  # counts of a quaternion
LYING = np.array([np.sqrt(0.5), 0.0, 0.0, -np.sqrt(0.5)])
"""The chip in the torso: its x is the torso's -y, its y the torso's x."""


class Bno055:
    """The chip.

    Args:
      plant: where the robot moves.
      lane: which robot.
    """

    BAUD = 115_200

    def __init__(self, plant: Plant, lane: int = 0) -> None:
        self.plant, self.lane = plant, lane
        self.alive = True
        self.frozen = False
        self._left = bytearray()
        self._registers = bytearray(SIZE)
        self._reset()

    def clear(self) -> None:
        """Forget an unfinished message, as the chip does after a silence."""
        self._left.clear()

    def feed(self, data: bytes) -> list[bytes]:
        """Bytes from the host; returns the answers."""
        self._left += data
        answers = []
        while self._left:
            taken, answer = self._first()
            if taken == 0:
                break
            del self._left[:taken]
            if answer:
                answers.append(answer)
        return answers if self.alive else []

    def _first(self) -> tuple[int, bytes]:
        """Bytes to take off, 0 to wait for more, and what they are answered with."""
        left = self._left
        if left[0] != START:
            return len(left), bytes([STATUS, WRONG_START])
        if len(left) < 4:
            return 0, b""
        _, kind, register, length = left[:4]
        if kind not in (READ, WRITE):
            return len(left), bytes([STATUS, WRONG_START])
        if not 0 < length <= LONGEST:
            return len(left), bytes([STATUS, TOO_LONG])
        if kind == READ:
            return 4, self._read(register, length)
        if len(left) < 4 + length:
            return 0, b""
        return 4 + length, self._write(register, bytes(left[4 : 4 + length]))

    def _read(self, register: int, length: int) -> bytes:
        if register + length > SIZE:
            return bytes([STATUS, BAD_ADDRESS])
        if not self.frozen:
            self._measure()
        return bytes([DATA, length]) + self._registers[register : register + length]

    def _write(self, register: int, data: bytes) -> bytes:
        places = range(register, register + len(data))
        if register + len(data) > SIZE:
            return bytes([STATUS, BAD_ADDRESS])
        if not WRITABLE.issuperset(places):
            return bytes([STATUS, WRITE_DISABLED])
        if any(place in (UNITS, AXES, SIGNS) for place in places) and self._registers[MODE]:
            return bytes([STATUS, WRITE_FAIL])  # only in the configuration mode
        self._registers[register : register + len(data)] = data
        if TRIGGER in places:
            if self._registers[TRIGGER] & RESET:
                self._reset()
                return b""  # it has restarted before it could answer
            self._registers[TRIGGER] = 0
        self._registers[MODE] &= 0x0F
        return bytes([STATUS, SUCCESS])

    def _reset(self) -> None:
        """Power has come back: configuration mode, degrees, Android's convention."""
        self._registers[:] = bytes(SIZE)
        self._registers[0:8] = (CHIP, ACCELEROMETER, MAGNETOMETER, GYROSCOPE, 0x11, 0x03, 0x15, 0)
        self._registers[UNITS], self._registers[AXES] = ANDROID, 0x24
        self._registers[SELF_TEST] = 0x0F

    def _measure(self) -> None:
        """Bring the output registers up to date; without fusion there are none."""
        registers, fused = self._registers, self._registers[MODE] in FUSION
        registers[SYSTEM] = 5 if fused else 0
        if not fused or self.plant.imus is None:
            registers[FORCE:CALIBRATION] = bytes(CALIBRATION - FORCE)
            return
        turn, rate, force = self.plant.imus.read(self.lane)
        turn = multiply(turn, LYING)
        rate, force = _lying(rate), _lying(force)
        down = 9.81 * _upright(turn)
        unit = registers[UNITS]
        angle = MILLIRADIANS if unit & RADIANS else DEGREES
        speed = MILLIRADIANS if unit & RADIANS_PER_S else DEGREES
        self._put(FORCE, force * 100)
        self._put(GYRO, rate * speed)
        self._put(EULER, angles(turn, bool(unit & ANDROID)) * angle)
        self._put(QUATERNION, turn * UNIT)
        self._put(LINEAR, (force - down) * 100)
        self._put(GRAVITY, down * 100)
        registers[TEMPERATURE], registers[CALIBRATION] = 30, 0x3F

    def _put(self, register: int, values: Array) -> None:
        raw = np.clip(np.rint(values), -32768, 32767).astype("<i2").tobytes()
        self._registers[register : register + len(raw)] = raw


def angles(turn: Array, android: bool) -> Array:
    """Heading, roll and pitch of the chip as it tells them, rad.

    Heading, roll and Android's pitch turn left-handed about z, y and x, Windows' pitch
    right-handed. Table 3-13 has the conventions differ in the pitch but does not say from where its
    "clockwise" is seen: the authors' signs do, which were read by Android's convention.

    Args:
      turn: from the chip to the world, a quaternion.
      android: whether the unit register says Android, not Windows.
    """
    about_x, about_y, about_z = roll_pitch_yaw(turn)
    pitch = -about_x if android else about_x
    return np.array([-about_z % (2 * np.pi), -about_y, pitch])


def lean(turn: Array) -> tuple[float, float]:
    """Roll and pitch of the torso (Z-Y-X), rad, as the quaternion's registers tell them.

    Args:
      turn: from the torso to the world, a quaternion.
    """
    told = multiply(np.rint(multiply(turn, LYING) * UNIT), conjugate(LYING))
    roll, pitch, _ = roll_pitch_yaw(told / np.linalg.norm(told))
    return roll, pitch


def _lying(vector: Array) -> Array:
    """A vector of the torso in the axes of the chip."""
    return np.array([-vector[1], vector[0], vector[2]])


def _upright(turn: Array) -> Array:
    """The world's upward direction in the axes of the chip."""
    w, x, y, z = turn
    return np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
