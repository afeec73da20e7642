"""What an IMU on the torso measures: orientation, rates and specific force, late and noisy.

The fusion of a BNO055 runs at 100 Hz; what it says is some samples old.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hardware_agent.virtual.character import Character
from hardware_agent.virtual.skeleton import STEP

Array = NDArray[np.float64]

EVERY = round(0.01 / STEP)  # steps between samples
BLOCK = 256  # samples whose noise is drawn at once
GRAVITY = 9.81  # m/s2
FORCE_NOISE = 0.02  # m/s2


@dataclass(frozen=True, eq=False)
class Sample:
    """What was there to be measured at one time, of all lanes.

    Attributes:
      turn: of the torso, quaternions to the world, shape (n_lanes, 4).
      rate: about its axes, rad/s, shape (n_lanes, 3).
      force: specific force in the world, m/s2, shape (n_lanes, 3); upwards at rest.
      noise: standard normal numbers, shape (n_lanes, 9).
    """

    turn: Array
    rate: Array
    force: Array
    noise: Array


class Imus:
    """The IMUs of some robots.

    Args:
      characters: of the robots.
    """

    def __init__(self, characters: Sequence[Character]) -> None:
        self._kinds = [character.imu for character in characters]
        self._seeds = [(character.seed, 0x1A0) for character in characters]
        self._rngs = [np.random.default_rng(seed) for seed in self._seeds]
        self._mounts = [_turn(kind.mount) for kind in self._kinds]
        self._delay = [round(kind.delay / STEP / EVERY) for kind in self._kinds]
        self._past: deque[Sample] = deque(maxlen=max(self._delay) + 1)
        self._velocity = np.zeros((len(characters), 3))
        self._noise = self._draw()

    def rest(self, rows: NDArray[np.intp], qpos: Array, qvel: Array) -> None:
        """Robots were put down: nothing of their past is left."""
        self._velocity[rows] = qvel[rows, :3]
        now = self._measure(qpos, qvel)
        if not self._past:
            self._past.append(now)
        for sample in self._past:
            for kept, new in zip(vars(sample).values(), vars(now).values(), strict=True):
                kept[rows] = new[rows]

    def renew(self, number: int) -> None:
        """Forget the past; noise is drawn anew from a number beside the robots' seeds."""
        self._rngs = [np.random.default_rng((*seed, number)) for seed in self._seeds]
        self._past.clear()
        self._noise = self._draw()

    def sample(self, qpos: Array, qvel: Array) -> None:
        """Take a sample; to be called every EVERY steps."""
        self._past.append(self._measure(qpos, qvel))

    def read(self, lane: int) -> tuple[Array, Array, Array]:
        """What one robot's IMU says now, in the torso's axes as its mount should be.

        Returns:
          The quaternion to the world, rates in rad/s, specific force in m/s2.
        """
        late = min(self._delay[lane], len(self._past) - 1)
        sample = self._past[len(self._past) - 1 - late]
        kind, mount, noise = self._kinds[lane], self._mounts[lane], sample.noise[lane]
        turn = multiply(sample.turn[lane], multiply(mount, _turn(kind.noise * noise[:3])))
        rate = rotate(conjugate(mount), sample.rate[lane])
        force = rotate(conjugate(turn), sample.force[lane])
        return (
            turn,
            rate + kind.rate_bias + kind.rate_noise * noise[3:6],
            force + FORCE_NOISE * noise[6:],
        )

    def _measure(self, qpos: Array, qvel: Array) -> Sample:
        noise = next(self._noise, None)
        if noise is None:
            self._noise = self._draw()
            noise = next(self._noise)
        force = (qvel[:, :3] - self._velocity) / (EVERY * STEP)
        force[:, 2] += GRAVITY
        self._velocity = qvel[:, :3].copy()
        return Sample(qpos[:, 3:7].copy(), qvel[:, 3:6].copy(), force, noise)

    def _draw(self) -> Iterator[Array]:
        """Noise of the next samples."""
        return iter(np.stack([rng.standard_normal((BLOCK, 9)) for rng in self._rngs], axis=1))


def multiply(a: Array, b: Array) -> Array:
    """The product of two quaternions (w, x, y, z)."""
    w, x, y, z = a.tolist()
    s, i, j, k = b.tolist()
    return np.array(
        [
            w * s - x * i - y * j - z * k,
            w * i + x * s + y * k - z * j,
            w * j - x * k + y * s + z * i,
            w * k + x * j - y * i + z * s,
        ]
    )


def conjugate(turn: Array) -> Array:
    """The opposite turn."""
    return np.asarray(turn * np.array([1.0, -1.0, -1.0, -1.0]))


def roll_pitch_yaw(turn: Array) -> tuple[float, float, float]:
    """Turns about x, y and z (Z-Y-X Euler angles) of a quaternion, rad."""
    w, x, y, z = turn
    return (
        float(np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))),
        float(np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))),
        float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))),
    )


def rotate(turn: Array, vector: Array) -> Array:
    """A vector turned."""
    return multiply(multiply(turn, np.array([0.0, *vector])), conjugate(turn))[1:]


def _turn(angles: Array) -> Array:
    """The quaternion of a small turn about x, y, z, rad."""
    half = np.array([1.0, *(angles / 2)])
    return np.asarray(half / np.linalg.norm(half))
