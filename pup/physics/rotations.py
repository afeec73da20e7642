"""Quaternions (w, x, y, z) of many simulations at once."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])


def multiply(left: Array, right: Array) -> Array:
    """Products of quaternions, (..., 4), broadcast against each other."""
    w, x, y, z = np.moveaxis(left, -1, 0)
    a, b, c, d = np.moveaxis(right, -1, 0)
    return np.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ],
        axis=-1,
    )


def rotation(vector: Array) -> Array:
    """Rotation vectors (n, 3), rad, to quaternions (n, 4); a zero vector gives exactly no turn."""
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    half = 0.5 * np.sinc(angle / (2 * np.pi))
    return np.concatenate([np.cos(angle / 2), half * vector], axis=-1)


def heading(quaternion: Array) -> Array:
    """Yaw (Z-Y-X Euler angles), (...,), rad."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    return np.asarray(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def roll_pitch(quaternion: Array) -> Array:
    """Roll and pitch (Z-Y-X Euler angles), (..., 2), rad."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    return np.stack([roll, pitch], axis=-1)
