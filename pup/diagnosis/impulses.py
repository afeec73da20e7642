"""How the samples answer to a torque that the model lacks, at every joint and at every time.

A closed-loop simulator that is pushed for a moment is back where it was within a few tenths of a
second. So pushes that are far enough apart share a simulation, and so do those on limbs that do not
feel each other: a few replays tell the answers to all of them.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from pup.diagnosis.fit import Fit
from pup.diagnosis.probing import coupled
from pup.diagnosis.replays import Replays
from pup.diagnosis.residuals import Measured, Noise
from pup.physics.actuators import per_joint
from pup.physics.model import compile_model
from pup.physics.push import WRENCH, Push

Array = NDArray[np.float64]
Limbs = Mapping[str, Sequence[tuple[int, ...]]]
"""Channels that feel each other, by what holds the robot."""

PERIOD = 0.04
"""Time between knots, s: that of the readings."""
MEMORY = 0.32
"""Time after which a push counts as forgotten, s."""
BUDGET = 3_000_000
"""Sub-steps of simulations to be spent; knots stand farther apart where more would be needed."""
SHARE = 0.03
"""A push is of this share of the servo's largest torque, or of the robot's weight."""
LEVER = 0.1
"""Of the force on a torso that a torque is compared with, m."""
WRENCH_NAMES = ("force x", "force y", "force z", "torque x", "torque y", "torque z")


@dataclass(frozen=True, eq=False)
class Part:
    """Answers within one recording of channels that feel each other.

    Attributes:
      recording: which one.
      channels: which channels are pushed.
      samples: which samples answer, among all, shape (n,).
      knots: how many there are.
      matrix: whitened answers per unit of push, shape (n, n_knots n_channels), knot by knot.
    """

    recording: int
    channels: tuple[int, ...]
    samples: NDArray[np.int64]
    knots: int
    matrix: sparse.csr_array


@dataclass(frozen=True, eq=False)
class Responses:
    """Answers of all samples to pushes at all knots.

    Attributes:
      measured: the samples.
      period: time between knots, s.
      memory: knots that a sample answers to at most, per channel.
      size: of a push on each channel that is small but not negligible, N m or N.
      parts: the answers.
    """

    measured: Measured
    period: float
    memory: int
    size: Array
    parts: tuple[Part, ...]

    @cached_property
    def channels(self) -> tuple[str, ...]:
        """The joints, then the components of the wrench on a free torso."""
        return (*self.measured.robot.joint_names, *WRENCH_NAMES)

    @cached_property
    def units(self) -> tuple[str, ...]:
        """Of the channels."""
        joints = len(self.measured.robot.joints)
        return (*("N m",) * joints, *("N",) * 3, *("N m",) * 3)

    def knots(self, recording: int) -> Array:
        """Times of the knots of a recording, s."""
        return np.asarray(self.period * np.arange(_knots(self.measured, recording, self.period)))


def responses(fit: Fit, replays: Replays, noise: Noise, budget: int = BUDGET) -> Responses:
    """Simulate pushes on the model as it was fitted.

    Args:
      fit: the model.
      replays: simulates.
      noise: weighs the samples.
      budget: sub-steps to be spent.
    """
    measured = replays.measured
    size = _sizes(fit, replays)
    together = coupled([*replays.space.names, *fit.values])
    supports = _supports(measured)
    apart = {support: _limbs(measured, support, together) for support in supports}
    period = _period(measured, apart, budget)
    memory = int(np.ceil(MEMORY / period))
    parts: list[Part] = []
    for support, members in supports.items():
        limbs = apart[support]
        answers = _simulated(fit, replays, noise, members, limbs, size, period)
        for recording in members:
            parts += _parts(measured, answers, recording, limbs, size, period)
    return Responses(measured, period, memory, size, tuple(parts))


def _supports(measured: Measured) -> dict[str, list[int]]:
    found: dict[str, list[int]] = {}
    for number, recording in enumerate(measured.recordings):
        found.setdefault(recording.support, []).append(number)
    return found


def _limbs(measured: Measured, support: str, together: bool) -> list[tuple[int, ...]]:
    """Channels that feel each other: a free torso joins all limbs, a sagging supply all joints."""
    robot = measured.robot
    model = compile_model(robot, support)
    joints = len(robot.joints)
    if model.floating:
        return [tuple(range(joints + WRENCH))]
    if together:
        return [tuple(range(joints))]
    trees: dict[int, list[int]] = {}
    for joint, name in enumerate(robot.joint_names):
        dof = int(model.compiled.joint(name).dofadr[0])
        trees.setdefault(int(model.compiled.dof_treeid[dof]), []).append(joint)
    return [tuple(members) for members in trees.values()]


def _period(measured: Measured, limbs: Limbs, budget: int) -> float:
    """Time between knots that the budget allows, s."""
    period = PERIOD
    while _cost(measured, limbs, period) > budget and period < MEMORY / 2:
        period += PERIOD / 2
    return period


def _cost(measured: Measured, limbs: Limbs, period: float) -> float:
    """Sub-steps of all simulations of pushes."""
    cost = 0.0
    for support, members in _supports(measured).items():
        rows = max(len(limb) for limb in limbs[support]) * np.ceil(MEMORY / period)
        times = (measured.recordings[i].time for i in members)
        cost += rows * sum(t[-1] - t[0] for t in times) / measured.robot.timestep
    return cost


def _sizes(fit: Fit, replays: Replays) -> Array:
    """Sizes of pushes, shape (n_joints + WRENCH,)."""
    robot = replays.measured.robot
    values = replays.space.at(fit.values).candidates()
    limits = SHARE * per_joint(robot, values, "tau_max")[0]
    supports = _supports(replays.measured)
    model = compile_model(robot, next(iter(supports))).compiled
    weight = SHARE * 9.81 * float(model.body_mass.sum())
    return np.asarray(np.r_[limits, np.full(3, weight), np.full(3, LEVER * weight)])


def _knots(measured: Measured, recording: int, period: float) -> int:
    time = measured.recordings[recording].time
    return int(np.ceil((time[-1] - time[0]) / period)) + 1


def _simulated(
    fit: Fit,
    replays: Replays,
    noise: Noise,
    members: Sequence[int],
    limbs: Sequence[tuple[int, ...]],
    size: Array,
    period: float,
) -> Array:
    """Whitened changes of all samples, shape (longest limb, memory, n_samples)."""
    measured = replays.measured
    memory = int(np.ceil(MEMORY / period))
    longest = max(len(limb) for limb in limbs)
    knots = max(_knots(measured, i, period) for i in members)
    values = np.zeros((longest, memory, len(members), knots, len(size)))
    for limb in limbs:
        for place, channel in enumerate(limb):
            for phase in range(memory):
                values[place, phase, :, phase::memory, channel] = size[channel]
    pushed = values.reshape(longest * memory, len(members), knots, len(size))
    still = np.zeros_like(pushed[:1])
    rows = [fit.row()] * (1 + len(pushed))
    told = replays(rows, members, Push(period, np.concatenate([still, pushed])))
    changes = np.zeros((len(pushed), len(measured.values)))
    changes[:, measured.only(members)] = told[1:] - told[0]
    white = measured.whiten(np.nan_to_num(changes), noise)
    return white.reshape(longest, memory, -1)


def _parts(
    measured: Measured,
    answers: Array,
    recording: int,
    limbs: Sequence[tuple[int, ...]],
    size: Array,
    period: float,
) -> Iterator[Part]:
    """Each sample's answer to the last push of each phase before it."""
    memory = answers.shape[1]
    joints = len(measured.robot.joints)
    knots = _knots(measured, recording, period)
    inside = measured.recording == recording
    for limb in limbs:
        free = limb[-1] >= joints
        seen = np.isin(measured.channel, limb) | (free & (measured.channel >= joints))
        samples = np.flatnonzero(inside & seen)
        latest = np.floor(measured.time[samples] / period).astype(np.int64) + 1
        phases = np.arange(memory)
        knot = latest[:, None] - (latest[:, None] - phases) % memory
        knot = np.where(knot >= knots, knot - memory, knot)
        owned = knot >= 0
        rows, columns, values = [], [], []
        for place, channel in enumerate(limb):
            answer = answers[place][:, samples].T / size[channel]
            rows.append(np.nonzero(owned)[0])
            columns.append(knot[owned] * len(limb) + place)
            values.append(answer[owned])
        entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
        shape = len(samples), knots * len(limb)
        yield Part(recording, limb, samples, knots, sparse.csr_array(entries, shape=shape))
