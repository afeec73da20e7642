"""What an IMU on the torso measures: orientation, rates and specific force, late and noisy.

The fusion of a BNO055 runs at 100 Hz; what it says is some samples old.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hardware_agent.virtual.character import Character
from hardware_agent.virtual.skeleton import STEP

Array = NDArray[np.float64]

EVERY = round(0.01 / STEP)  # steps between samples
GRAVITY = 9.81  # m/s2


@dataclass(frozen=True, eq=False)
class Sample:
    """One sample of all lanes, in the frame of the torso as the mount believes it to be.

    Attributes:
      turn: quaternions to the world, shape (n_lanes, 4).
      rate: rad/s, shape (n_lanes, 3).
      force: specific force, m/s2, shape (n_lanes, 3); upwards at rest.
    """

    turn: Array
    rate: Array
    force: Array


class Imus:
    """The IMUs of some robots.

    Args:
      characters: of the robots.
    """

    def __init__(self, characters: Sequence[Character]) -> None:
        self._kinds = [character.imu for character in characters]
        self._rngs = [np.random.default_rng((character.seed, 0x1A0)) for character in characters]
        self._mount = np.array([_turn(kind.mount) for kind in self._kinds])
        self._delay = [round(kind.delay / STEP / EVERY) for kind in self._kinds]
        self._past: deque[Sample] = deque(maxlen=max(self._delay) + 1)
        self._velocity = np.zeros((len(characters), 3))

    def rest(self, rows: NDArray[np.intp], qpos: Array, qvel: Array) -> None:
        """Robots were put down: nothing of their past is left."""
        self._velocity[rows] = qvel[rows, :3]
        now = self._measure(qpos, qvel)
        if not self._past:
            self._past.append(now)
        for sample in self._past:
            for kept, new in zip(vars(sample).values(), vars(now).values(), strict=True):
                kept[rows] = new[rows]

    def sample(self, steps: int, qpos: Array, qvel: Array) -> None:
        """Take a sample if its time has come."""
        if steps % EVERY == 0:
            self._past.append(self._measure(qpos, qvel))

    def read(self, lane: int) -> tuple[Array, Array, Array]:
        """What one robot's IMU says now: quaternion, rate and specific force; see Sample."""
        late = min(self._delay[lane], len(self._past) - 1)
        sample = self._past[len(self._past) - 1 - late]
        return sample.turn[lane], sample.rate[lane], sample.force[lane]

    def _measure(self, qpos: Array, qvel: Array) -> Sample:
        noise = np.stack([rng.standard_normal(9) for rng in self._rngs])
        off = np.array([[kind.noise] for kind in self._kinds]) * noise[:, :3]
        shaken = multiply(self._mount, np.array([_turn(angles) for angles in off]))
        turn = multiply(qpos[:, 3:7], shaken)
        change = (qvel[:, :3] - self._velocity) / (EVERY * STEP)
        self._velocity = qvel[:, :3].copy()
        change[:, 2] += GRAVITY
        rate = rotate(conjugate(self._mount), qvel[:, 3:6])
        rate += np.array([kind.rate_bias for kind in self._kinds])
        rate += np.array([[kind.rate_noise] for kind in self._kinds]) * noise[:, 3:6]
        force = rotate(conjugate(turn), change) + 0.02 * noise[:, 6:]
        return Sample(turn, rate, force)


def multiply(a: Array, b: Array) -> Array:
    """Products of quaternions (w, x, y, z), row by row."""
    w, v = a[..., :1], a[..., 1:]
    x, u = b[..., :1], b[..., 1:]
    scalar = w * x - (v * u).sum(axis=-1, keepdims=True)
    return np.concatenate([scalar, w * u + x * v + np.cross(v, u)], axis=-1)


def conjugate(turn: Array) -> Array:
    """The opposite turns."""
    return turn * np.array([1.0, -1.0, -1.0, -1.0])


def rotate(turn: Array, vector: Array) -> Array:
    """Vectors turned, row by row."""
    pure = np.concatenate([np.zeros((*vector.shape[:-1], 1)), vector], axis=-1)
    return multiply(multiply(turn, pure), conjugate(turn))[..., 1:]


def _turn(angles: Array) -> Array:
    """The quaternion of a small turn about x, y, z, rad."""
    half = np.concatenate([[1.0], np.asarray(angles) / 2])
    return np.asarray(half / np.linalg.norm(half))
