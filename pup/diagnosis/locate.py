"""Where a model lacks something: the torques that would have to be added to it, joint by joint.

The fitted model's errors are explained by an unknown torque at every joint and time, each joint's a
Gaussian process of a strength of its own, beside the noise and beside what the model's own
parameters can imitate. The strengths that the data ask for say where; the torques say when.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.banded import Chain, Factor
from pup.diagnosis.fit import Fit
from pup.diagnosis.impulses import BUDGET, Part, Responses, responses
from pup.diagnosis.replays import Replays
from pup.diagnosis.residuals import Noise

Array = NDArray[np.float64]

LENGTH = 0.15
"""Time over which a missing torque stays about the same, s."""
ROUNDS = 15
"""Updates of the strengths."""
NONE = 1e-3
"""Strength of a channel that lacks nothing, in the size of a push."""
START = 0.5
"""Strength of all channels to begin with, in the size of a push."""
WEAK = 0.02
"""A channel that falls below this is left out from then on."""
CHANGE = 50.0
"""A variance changes at most by this factor in one update."""
BAND = 1.645
"""Standard deviations of a 90 % interval."""


@dataclass(frozen=True, eq=False)
class MissingInput:
    """The torques that a model lacks.

    Attributes:
      channels: the joints, then the components of the wrench on the torso.
      units: of the channels.
      strength: standard deviation of each, (n_channels,), in its unit.
      evidence: how much more probable the data are with a channel than without it, natural
        logarithm, (n_channels,).
      noise: standard deviation of what is left, in that of the noise floor.
      time: of each recording's knots, s.
      mean: most probable torques of each recording, (n_knots, n_channels); 0 for channels that
        lack nothing.
      deviation: their standard deviation, same shape; BAND of them is half of a 90 % band.
      explained: what they add to the samples, whitened, shape (n_samples,).
    """

    channels: tuple[str, ...]
    units: tuple[str, ...]
    strength: Array
    evidence: Array
    noise: float
    time: tuple[Array, ...]
    mean: tuple[Array, ...]
    deviation: tuple[Array, ...]
    explained: Array

    def ranking(self) -> list[tuple[str, float]]:
        """Channels and their evidence, strongest first."""
        order = np.argsort(-self.evidence)
        return [(self.channels[i], float(self.evidence[i])) for i in order]


def missing_input(fit: Fit, replays: Replays, noise: Noise, budget: int = BUDGET) -> MissingInput:
    """Estimate the torques that a fitted model lacks.

    Args:
      fit: the model, with its Jacobian.
      replays: simulates the answers to pushes.
      noise: weighs the samples.
      budget: sub-steps of simulation to be spent.
    """
    return explained_by(responses(fit, replays, noise, budget), fit)


def explained_by(answers: Responses, fit: Fit) -> MissingInput:
    """The torques that explain a fit's residual, given the answers to pushes."""
    problem = _Problem(answers, fit)
    for _ in range(ROUNDS):
        problem.update()
    mean, deviation = problem.posterior()
    recordings = range(len(answers.measured.recordings))
    return MissingInput(
        answers.channels,
        answers.units,
        problem.strength * answers.size,
        problem.ratios(),
        float(np.sqrt(problem.variance)),
        tuple(answers.knots(i) for i in recordings),
        tuple(m * answers.size for m in mean),
        tuple(d * answers.size for d in deviation),
        problem.explained(),
    )


class _Prior:
    """An Ornstein-Uhlenbeck process of unit variance on a chain of knots.

    Args:
      knots: how many, a multiple of `memory`.
      memory: knots in a block.
      period: time between knots, s.
    """

    def __init__(self, knots: int, memory: int, period: float) -> None:
        self.memory = memory
        self.knots = knots
        kept = float(np.exp(-period / LENGTH))
        self.near = -kept / (1 - kept**2)
        self.at = np.full(knots, (1 + kept**2) / (1 - kept**2))
        self.at[[0, -1]] = 1 / (1 - kept**2)
        self.logdet = -(knots - 1) * float(np.log(1 - kept**2))

    def chain(self, strength: Array) -> tuple[Array, Array]:
        """Precision of channels of some strengths: blocks on and beside the diagonal."""
        memory, blocks = self.memory, self.knots // self.memory
        inside = np.zeros((blocks, memory, memory))
        steps = np.arange(memory)
        inside[:, steps, steps] = self.at.reshape(blocks, memory)
        inside[:, steps[1:], steps[:-1]] = inside[:, steps[:-1], steps[1:]] = self.near
        across = np.zeros((memory, memory))
        across[-1, 0] = self.near
        scale = np.diag(strength**-2.0)
        blocked = np.stack([np.kron(block, scale) for block in inside])
        return blocked, np.asarray(np.kron(across, scale))

    def times(self, values: Array) -> Array:
        """The unit precision times values (n, n_knots, n_channels, k)."""
        out = self.at[:, None, None] * values
        out[:, 1:] += self.near * values[:, :-1]
        out[:, :-1] += self.near * values[:, 1:]
        return np.asarray(out)

    def trace(self, covariance: Chain, width: int) -> Array:
        """Of the unit precision times each channel's covariance, (n_channels,)."""
        n, blocks, _, _ = covariance.diagonal.shape
        shape = (self.memory, width, self.memory, width)
        own = covariance.diagonal.reshape(n, blocks, *shape)
        beside = covariance.beside.reshape(n, blocks - 1, *shape)
        at = self.at.reshape(blocks, self.memory)
        total = np.einsum("nbicic,bi->c", own, at)
        for i in range(self.memory - 1):
            total += 2 * self.near * np.einsum("nbcc->c", own[:, :, i, :, i + 1])
        return np.asarray(total + 2 * self.near * np.einsum("nbcc->c", beside[:, :, -1, :, 0]))


@dataclass(frozen=True, eq=False)
class _Told:
    """What one limb says, given strengths and noise.

    Attributes:
      factor: of its precision.
      solved: its precision's inverse times (errors, sensitivities), (n, n_blocks, m, 1 + n_free).
      quadratic: of errors and sensitivities in that inverse, (1 + n_free, 1 + n_free).
      logdet: of posterior less prior precision.
    """

    factor: Factor
    solved: Array
    quadratic: Array
    logdet: float


class _Limb:
    """Channels that feel each other: a chain of knots for each recording.

    Args:
      parts: the limb's answers, one for each recording.
      fit: the model.
      answers: all answers.
    """

    def __init__(self, parts: Sequence[Part], fit: Fit, answers: Responses) -> None:
        assert fit.residual is not None and fit.jacobian is not None
        self.channels = np.array(parts[0].channels)
        self.parts = parts
        self.width = len(self.channels)
        memory = answers.memory
        m = memory * self.width
        blocks = -(-max(part.knots for part in parts) // memory)
        self.prior = _Prior(blocks * memory, memory, answers.period)
        self.diagonal = np.zeros((len(parts), blocks, m, m))
        self.beside = np.zeros((len(parts), blocks - 1, m, m))
        self.right = np.zeros((len(parts), blocks, m, 1 + fit.jacobian.shape[1]))
        scale = answers.size[self.channels]
        self.matrices = [part.matrix * np.tile(scale, part.knots) for part in parts]
        for i, (part, matrix) in enumerate(zip(parts, self.matrices, strict=True)):
            told = np.column_stack([fit.residual, fit.jacobian])[part.samples]
            padded = np.zeros((blocks * m, told.shape[1]))
            padded[: matrix.shape[1]] = matrix.T @ told
            self.right[i] = padded.reshape(blocks, m, -1)
            normal = (matrix.T @ matrix).tocsr()
            normal.resize(blocks * m, blocks * m)
            for b in range(blocks):
                rows = normal[b * m : (b + 1) * m]
                self.diagonal[i, b] = rows[:, b * m : (b + 1) * m].toarray()
                if b + 1 < blocks:
                    self.beside[i, b] = rows[:, (b + 1) * m : (b + 2) * m].toarray()

    def told(self, strength: Array, variance: float) -> _Told:
        """What it says under strengths of all channels."""
        own = strength[self.channels]
        inside, across = self.prior.chain(own)
        factor = Chain(self.diagonal / variance + inside, self.beside / variance + across).factor()
        solved = factor.solve(self.right / variance)
        n = len(self.parts)
        before = self.width * self.prior.logdet - 2 * self.prior.knots * float(np.log(own).sum())
        return _Told(
            factor,
            solved,
            np.einsum("nbmi,nbmj->ij", self.right / variance, solved),
            float(factor.logdet().sum()) - n * before,
        )

    def keep(self, strong: NDArray[np.bool_]) -> None:
        """Leave out channels, given which of all are kept."""
        kept = strong[self.channels]
        if kept.all():
            return
        inside = np.flatnonzero(np.tile(kept, self.prior.memory))
        self.diagonal = self.diagonal[:, :, inside][:, :, :, inside]
        self.beside = self.beside[:, :, inside][:, :, :, inside]
        self.right = self.right[:, :, inside]
        self.matrices = [
            matrix[:, np.flatnonzero(np.tile(kept, part.knots))]
            for matrix, part in zip(self.matrices, self.parts, strict=True)
        ]
        self.channels = self.channels[kept]
        self.width = len(self.channels)

    def shaped(self, values: Array) -> Array:
        """Values (n, n_blocks, m, k) as (n, n_knots, n_channels, k)."""
        return values.reshape(len(values), -1, self.width, values.shape[-1])


class _Problem:
    """The estimate under way; strengths are in sizes of pushes.

    Args:
      answers: the answers to pushes.
      fit: the model whose residual is explained.
    """

    def __init__(self, answers: Responses, fit: Fit) -> None:
        assert fit.residual is not None and fit.jacobian is not None
        by_limb: dict[tuple[int, ...], list[Part]] = {}
        for part in answers.parts:
            by_limb.setdefault(part.channels, []).append(part)
        self.limbs = [_Limb(parts, fit, answers) for parts in by_limb.values()]
        self.residual, self.jacobian = fit.residual, fit.jacobian
        both = np.column_stack([fit.residual, fit.jacobian])
        self.gram = both.T @ both
        span = np.array([c.upper - c.lower for c in fit.coordinates])
        self.loose = np.diag(12 / span**2)
        acting = np.unique(np.concatenate([limb.channels for limb in self.limbs]))
        self.strength = np.full(len(answers.channels), NONE)
        self.strength[acting] = START
        self.acting = acting
        self.variance = 1.0
        recordings = range(len(answers.measured.recordings))
        self.blank = [np.zeros((len(answers.knots(i)), len(self.strength))) for i in recordings]

    def update(self) -> None:
        """Move strengths and noise towards those under which the data are most probable."""
        told = [limb.told(self.strength, self.variance) for limb in self.limbs]
        shift, spread = self._shift(told)
        power = np.zeros(len(self.strength))
        seen = np.zeros(len(self.strength))
        for limb, part in zip(self.limbs, told, strict=True):
            mean, moved = self._mean(limb, part, shift)
            traced = limb.prior.trace(part.factor.inverse(), limb.width)
            traced += np.einsum("nkci,ij,nkcj->c", limb.prior.times(moved), spread, moved)
            count = len(limb.parts) * limb.prior.knots
            seen[limb.channels] += count - traced / self.strength[limb.channels] ** 2
            power[limb.channels] += np.einsum("nkci,nkci->c", limb.prior.times(mean), mean)
        left = self.residual - self.jacobian @ shift - self._told_by(told, shift)
        acting = self.acting
        now = self.strength[acting] ** 2
        asked = power[acting] / np.maximum(seen[acting], 1e-3)
        asked = np.sqrt(np.clip(asked, now / CHANGE, now * CHANGE))
        self.strength[acting] = np.where(asked > WEAK, asked, NONE)
        strong = self.strength > NONE
        self.acting = np.flatnonzero(strong)
        for limb in self.limbs:
            limb.keep(strong)
        self.limbs = [limb for limb in self.limbs if limb.width]
        freedom = len(left) - float(seen.sum()) - len(shift)
        self.variance = float(np.clip(left @ left / max(freedom, 1.0), 0.1, 10.0))

    def posterior(self) -> tuple[list[Array], list[Array]]:
        """Means and standard deviations by recording, each (n_knots, n_channels)."""
        told = [limb.told(self.strength, self.variance) for limb in self.limbs]
        shift, spread = self._shift(told)
        means = [blank.copy() for blank in self.blank]
        deviations = [blank.copy() for blank in self.blank]
        for limb, part in zip(self.limbs, told, strict=True):
            mean, moved = self._mean(limb, part, shift)
            own = np.diagonal(part.factor.inverse().diagonal, axis1=2, axis2=3)
            variance = limb.shaped(own[..., None])[..., 0]
            variance = variance + np.einsum("nkci,ij,nkcj->nkc", moved, spread, moved)
            for i, one in enumerate(limb.parts):
                means[one.recording][:, limb.channels] = mean[i, : one.knots, :, 0]
                spread_of = np.sqrt(variance[i, : one.knots])
                deviations[one.recording][:, limb.channels] = spread_of
        return means, deviations

    def explained(self) -> Array:
        """What the mean torques add to the samples, whitened, (n_samples,)."""
        told = [limb.told(self.strength, self.variance) for limb in self.limbs]
        return self._told_by(told, self._shift(told)[0])

    def _told_by(self, told: Sequence[_Told], shift: Array) -> Array:
        out = np.zeros_like(self.residual)
        for limb, part in zip(self.limbs, told, strict=True):
            mean, _ = self._mean(limb, part, shift)
            for i, (one, matrix) in enumerate(zip(limb.parts, limb.matrices, strict=True)):
                out[one.samples] += matrix @ mean[i].ravel()[: matrix.shape[1]]
        return out

    def ratios(self) -> Array:
        """Logarithm of how much more probable the data are with each channel, (n_channels,)."""
        told = [limb.told(self.strength, self.variance) for limb in self.limbs]
        whole = self._evidence(told)
        ratios = np.zeros(len(self.strength))
        for channel in self.acting:
            less = self.strength.copy()
            less[channel] = NONE
            without = [
                limb.told(less, self.variance) if channel in limb.channels else part
                for limb, part in zip(self.limbs, told, strict=True)
            ]
            ratios[channel] = whole - self._evidence(without)
        return ratios

    def _system(self, told: Sequence[_Told]) -> tuple[Array, Array, float]:
        """Precision of the parameters' shift, its right side, and the errors' square."""
        left = self.gram / self.variance - sum(part.quadratic for part in told)
        return left[1:, 1:] + self.loose, left[1:, 0], float(left[0, 0])

    def _shift(self, told: Sequence[_Told]) -> tuple[Array, Array]:
        """How far the model's own parameters move, and the covariance of that."""
        precision, right, _ = self._system(told)
        spread = np.asarray(np.linalg.inv(precision))
        return np.asarray(spread @ right), spread

    def _mean(self, limb: _Limb, told: _Told, shift: Array) -> tuple[Array, Array]:
        """Mean torques, (n, n_knots, n_channels, 1), and by how much each shift moves them."""
        mean: Array = told.solved[..., :1] - told.solved[..., 1:] @ shift[:, None]
        return limb.shaped(mean), limb.shaped(told.solved[..., 1:])

    def _evidence(self, told: Sequence[_Told]) -> float:
        """Logarithm of the data's probability, up to a constant."""
        precision, right, square = self._system(told)
        cost = len(self.residual) * float(np.log(self.variance)) + square
        cost += sum(part.logdet for part in told) + float(np.linalg.slogdet(precision)[1])
        return -0.5 * (cost - float(right @ np.linalg.solve(precision, right)))
