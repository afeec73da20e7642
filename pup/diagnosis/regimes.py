"""When a mismatch shows: the regimes of motion in which errors stand out."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.residuals import Measured
from pup.diagnosis.signals import command_at
from pup.physics.terms.scale import Scale

Array = NDArray[np.float64]

REVERSAL = 0.1
"""So long around a change of direction counts as reversal, s."""
LEAST = 20
"""Samples that a regime needs to be told of."""


@dataclass(frozen=True)
class Regime:
    """A condition of motion and the samples that meet it.

    Attributes:
      name: such as `low speed`.
      inside: shape (n_samples,).
    """

    name: str
    inside: NDArray[np.bool_]


@dataclass(frozen=True)
class Window:
    """A stretch of one recording, s since its start."""

    recording: str
    start: float
    end: float


def regimes(measured: Measured, simulated: Array, limits: Array, gains: Array) -> list[Regime]:
    """Regimes of all samples, by the simulated motion, which is free of noise.

    Args:
      measured: the samples.
      simulated: the nominal model's, shape (n_samples,), rad.
      limits: largest torque of each joint, N m.
      gains: stiffness of each joint, N m/rad.
    """
    joints = len(measured.robot.joints)
    speed, error = np.zeros(len(simulated)), np.zeros(len(simulated))
    age, reversal = np.full(len(simulated), np.inf), np.zeros(len(simulated), dtype=bool)
    torque, limit = np.zeros(len(simulated)), np.full(len(simulated), np.inf)
    for number, recording in enumerate(measured.recordings):
        for joint, name in enumerate(measured.robot.joint_names):
            run = np.flatnonzero((measured.recording == number) & (measured.channel == joint))
            if len(run) < 5:
                continue
            time = measured.time[run]
            speed[run] = np.gradient(simulated[run], time)
            command, age[run] = command_at(recording, name, time)
            error[run] = np.nan_to_num(command - simulated[run])
            torque[run], limit[run] = np.abs(gains[joint] * error[run]), limits[joint]
            turns = time[1:][np.diff(np.sign(speed[run])) != 0]
            if len(turns):
                near = turns[np.clip(np.searchsorted(turns, time), 0, len(turns) - 1)]
                before = turns[np.clip(np.searchsorted(turns, time) - 1, 0, len(turns) - 1)]
                gap = np.minimum(np.abs(time - near), np.abs(time - before))
                reversal[run] = gap < REVERSAL
    ours = measured.channel < joints
    fast = np.quantile(np.abs(speed[ours]), 0.85) if ours.any() else 0.0
    slow = max(0.02 * fast, 0.01 * Scale.of(measured.robot).angle)
    ground = np.array([r.support == "ground" for r in measured.recordings])[measured.recording]
    named = {
        "at reversals": ours & reversal & (np.abs(error) > 0),
        "at rest": ours & (np.abs(speed) < slow) & (age > 0.3),
        "at low speed": ours & (np.abs(speed) >= slow) & (np.abs(speed) < 0.3 * fast),
        "at high speed": ours & (np.abs(speed) > fast),
        "at the torque limit": ours & (torque > 0.95 * limit),
        "under high load": ours & (torque > 0.4 * limit) & (torque <= 0.95 * limit),
        "just after a command": ours & (age < 0.15),
        "late in the recording": measured.time > 0.7 * _duration(measured),
        "on the ground": ground,
    }
    return [Regime(n, m) for n, m in named.items() if LEAST <= m.sum() < len(simulated)]


def strongest(found: Sequence[Regime], gain: Array) -> str:
    """The regime in which a gain of squared errors is densest, `throughout` if none is."""
    total = float(gain.sum())
    best, density = "throughout", 1.5
    for regime in found:
        share = float(gain[regime.inside].sum()) / total if total > 0 else 0.0
        ratio = share / float(regime.inside.mean())
        if share > 0.3 and ratio > density:
            best, density = regime.name, ratio
    return best


def windows(measured: Measured, gain: Array, most: int = 5) -> list[Window]:
    """The stretches of half a second or more in which a gain is largest."""
    found: list[tuple[float, Window]] = []
    for number, recording in enumerate(measured.recordings):
        inside = measured.recording == number
        if not inside.any():
            continue
        edges = np.arange(0.0, float(measured.time[inside].max()) + 0.5, 0.5)
        sums = np.histogram(measured.time[inside], edges, weights=gain[inside])[0]
        high = sums > max(2 * float(np.mean(sums)), 0.0)
        for start, end in _stretches(high):
            window = Window(recording.id, float(edges[start]), float(edges[end]))
            found.append((float(sums[start:end].sum()), window))
    found.sort(key=lambda pair: -pair[0])
    return [window for _, window in found[:most]]


def _stretches(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.r_[False, flags, False].astype(int)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _duration(measured: Measured) -> Array:
    """Length of each sample's recording, s."""
    lengths = np.array([r.time[-1] - r.time[0] for r in measured.recordings])
    return np.asarray(lengths[measured.recording])
