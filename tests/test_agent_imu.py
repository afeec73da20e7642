"""What the agent makes of an IMU's registers: the torso's roll and pitch as training has them."""

import itertools
import math
from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from hardware_agent.config import ImuSettings
from hardware_agent.imu import MODE, UNITS, Bno055, Board, Orientation
from pup.physics.rotations import heading, multiply, roll_pitch, rotation

pytest.importorskip("mujoco")

from hardware_agent.virtual import bno055, board
from hardware_agent.virtual.imu import conjugate, rotate

Array = NDArray[np.float64]

UPWARDS = np.array([0.0, 0.0, 9.81])
FINE = 0.002  # rad, of 16384 counts at a pitch of up to 1.4 rad
TURNS = st.tuples(st.floats(-3, 3), st.floats(-1.4, 1.4), st.floats(-3, 3)).map(
    lambda angles: turned(*angles)
)


def turned(roll: float, pitch: float, yaw: float) -> Array:
    """The quaternion of Z-Y-X Euler angles."""
    about_x, about_y, about_z = rotation(np.diag([roll, pitch, yaw]))
    return multiply(about_z, multiply(about_y, about_x))


def robot(turn: Array, rate: Array | None = None) -> SimpleNamespace:
    """A plant whose torso is turned so, at rest but for its rates."""
    force = rotate(conjugate(turn), UPWARDS)
    told = turn, np.zeros(3) if rate is None else rate, force
    return SimpleNamespace(imus=SimpleNamespace(read=lambda lane: told))


class Wire:
    """The emulated chip's registers.

    Args:
      chip: the emulator.
    """

    def __init__(self, chip: bno055.Bno055) -> None:
        self.chip = chip
        self._asked = (0, 0)

    @classmethod
    def at(cls, turn: Array, rate: Array | None = None) -> "Wire":
        """Of a torso that is turned so and turns by so many rad/s."""
        return cls(bno055.Bno055(robot(turn, rate)))

    def write(self, register: int, value: int) -> bool:
        return self.chip.feed(bytes([0xAA, 0x00, register, 1, value])) == [b"\xee\x01"]

    def ask(self, register: int, length: int) -> None:
        self._asked = register, length

    def take(self, length: int) -> bytes:
        (answer,) = self.chip.feed(bytes([0xAA, 0x01, *self._asked]))
        return answer[2:]


class Registers(Wire):
    """Registers that hold a quaternion, told without an emulator."""

    def __init__(self, turn: Array) -> None:
        self._turn = turn

    def take(self, length: int) -> bytes:
        return bytes(24) + np.rint(self._turn * 2**14).astype("<i2").tobytes()


def asked(wire: Wire, axes: tuple[str, ...] = ImuSettings.axes) -> Orientation | None:
    imu = Bno055(ImuSettings(axes=axes), wire)
    imu.ask()
    return imu.take(None, 0.0)


@pytest.fixture(autouse=True)
def hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hardware_agent.imu.SWITCH", 0.0)


def started(wire: Wire, units: int | None = None) -> None:
    """The agent's own configuration, perhaps with other units."""
    assert Bno055(ImuSettings(), wire).configure()
    if units is not None:
        mode = wire.chip._registers[MODE]
        assert all(wire.write(*pair) for pair in ((MODE, 0), (UNITS, units), (MODE, mode)))


@given(TURNS, st.sampled_from([None, 0x00, 0x80]))
def test_a_bno055_tells_the_torsos_roll_and_pitch(turn: Array, units: int | None) -> None:
    """Together, at any lean, and whichever convention the chip has for its Euler angles."""
    wire = Wire.at(turn)
    started(wire, units)
    told = asked(wire)
    assert told is not None
    assert (told.roll, told.pitch) == pytest.approx(roll_pitch(turn), abs=FINE)
    assert told.accel == pytest.approx(rotate(conjugate(turn), UPWARDS), abs=0.01)


def test_rates_and_heading_are_the_torsos() -> None:
    rate = np.array([0.3, -0.2, 0.1])
    wire = Wire.at(turned(0.0, 0.0, 0.4), rate)
    started(wire)
    told = asked(wire)
    assert told is not None and told.gyro == pytest.approx(rate, abs=0.001)
    straight = Wire.at(turned(0.0, 0.0, 0.0))
    started(straight)
    before = asked(straight)
    assert before is not None and told.yaw - before.yaw == pytest.approx(0.4, abs=FINE)


def mountings() -> Iterator[tuple[str, ...]]:
    """All the ways in which a chip can lie along the torso's axes."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1, -1), repeat=3):
            rows = np.eye(3)[list(order)] * np.array(signs)[:, None]
            if np.linalg.det(rows) > 0:
                yield tuple(
                    ("-" if s < 0 else "") + "xyz"[o] for s, o in zip(signs, order, strict=True)
                )


def lying(axes: tuple[str, ...]) -> Array:
    """The quaternion from the chip to the torso, found among all turns by right angles."""
    along = [(-1.0 if axis[0] == "-" else 1.0) * np.eye(3)["xyz".index(axis[-1])] for axis in axes]
    for values in itertools.product((0.0, 1.0, -1.0), repeat=4):
        turn = np.array(values) / max(1.0, math.hypot(*values))
        if np.allclose([rotate(turn, axis) for axis in along], np.eye(3)):
            return turn
    raise AssertionError(axes)


@pytest.mark.parametrize("axes", list(mountings()), ids="".join)
def test_however_the_chip_is_mounted_its_axes_are_all_it_takes(axes: tuple[str, ...]) -> None:
    rng = np.random.default_rng(0)
    turns = [turned(*angles) for angles in rng.uniform(-1.3, 1.3, (20, 3))]
    yaws = []
    for turn in turns:
        told = asked(Registers(multiply(turn, lying(axes))), axes)
        assert told is not None
        assert (told.roll, told.pitch) == pytest.approx(roll_pitch(turn), abs=FINE)
        yaws.append(math.remainder(told.yaw - heading(turn), 2 * math.pi))
    assert np.abs(np.exp(1j * np.array(yaws)) - np.exp(1j * yaws[0])).max() < 2 * FINE


@pytest.mark.parametrize("turn", [[0, 0, 0, 0], [0.9, 0, 0, 0], [1.0, 0.3, 0, 0], [-1.9, 0, 0, 0]])
def test_what_is_no_quaternion_is_no_reading(turn: list[float]) -> None:
    """All zeros are those of a chip that has just got its power; others, a garbled answer."""
    assert asked(Registers(np.array(turn))) is None
    assert asked(Registers(np.array([-1.0, 0, 0, 0]))) is not None


@given(TURNS.filter(lambda turn: np.abs(roll_pitch(turn)).max() < 1.2))
def test_the_cm740_tells_the_torsos_roll_and_pitch(turn: Array) -> None:
    """The emulated board's registers, through the filter at rest."""
    emulated = board.Board(robot(turn), [])
    emulated.plant.drives = SimpleNamespace(volts=np.full((1, 1), 12.0))
    told = Board().take(emulated.read(38, 13), 0.0)
    assert told is not None
    # A count is 8 mrad, and the roll of a torso that leans far forward is told by few of them.
    assert (told.roll, told.pitch) == pytest.approx(roll_pitch(turn), abs=0.03)


@pytest.mark.parametrize(
    ("x", "y", "roll", "pitch"),
    [(512, 390, 0, 1), (512, 580, 0, -1), (412, 512, 1, 0), (612, 512, -1, 0)],
)
def test_the_cm740s_falls_are_those_of_robotis(x: int, y: int, roll: int, pitch: int) -> None:
    """The framework's limits: y for forward and backward, x for right and left."""
    values = [512, 512, 512, x, y, 512 + 40]
    data = b"".join(value.to_bytes(2, "little") for value in values) + bytes([118])
    told = Board().take(data, 0.0)
    assert told is not None
    assert (told.roll > 0.9, told.roll < -0.9) == (roll > 0, roll < 0)
    assert (told.pitch > 0.9, told.pitch < -0.9) == (pitch > 0, pitch < 0)


def test_the_cm740s_rates_go_with_its_tilt() -> None:
    """A torso that tips over forward, to the right and to the left hand."""
    rate = np.array([0.5, 0.7, 0.9])
    emulated = board.Board(robot(turned(0.0, 0.0, 0.0), rate), [])
    emulated.plant.drives = SimpleNamespace(volts=np.full((1, 1), 12.0))
    z, y, x = (int.from_bytes(emulated.read(at, 2), "little") - 512 for at in (38, 40, 42))
    assert x < 0 and y < 0 and z > 0
    told = Board().take(emulated.read(38, 13), 0.0)
    assert told is not None and told.gyro == pytest.approx(rate, abs=0.02)
