"""The refit of the nominal parameters that hides most of an effect.

Gauss and Newton's steps from several starts, each judged by what is simulated there. A torque limit
that no motion meets has no slope: what lies below it is found by starting there. More weight on a
joint is the same as less of all else, which slopes lead to only from near by.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from pup.blind.reference import Reference, sensitivities
from pup.blind.scene import gains
from pup.blind.sensors import Noise
from pup.blind.world import Array, Plan

FURTHEST = (-0.9, 4.0)  # relative changes of parameters in a refit
STRIDES = (0.5, 0.15, 0.04)  # largest relative changes in one step, tried at once
PULL = 1.0  # sigma that a parameter's change by its own size must gain, lest it drifts
LIMITS = (0.8, 0.5)  # of the torque from which motions are limited: where else to start
SCALES = (0.65, 0.8, 0.9, 1.25)  # of all parameters at once: where else to start
TINY = 1e-9  # way between bounds that meet
SETTLED = 0.04  # share of what is left squared, that another step must promise to be worth it
FAINTEST = 1.0  # sigma squared, that it must promise besides
PROMISE = 0.9  # of what is left, that another start must promise to be followed


@dataclass(frozen=True, eq=False)
class Fit:
    """Nominal parameters and what they leave of readings.

    Attributes:
      values: the parameters by name.
      model: what is simulated with them, by plan id.
      slopes: its change with the parameters, there or near, by plan id.
      sharp: whether those are of these very parameters.
      rest: how far the model is off on the training plans, in units of the noise, which is made
        white where it has a memory.
      steps: relative changes of the parameters that explain most, within bounds of each stride.
      left: how far it would be off after the longest step, by linear theory.
    """

    values: Mapping[str, float]
    model: Mapping[str, Array]
    slopes: Mapping[str, Array]
    sharp: bool
    rest: Array
    steps: tuple[Array, ...]
    left: float

    @property
    def off(self) -> float:
        """How far it is off, simulated."""
        return float(np.linalg.norm(self.rest))

    @property
    def settled(self) -> bool:
        """Whether another step is hardly worth it."""
        return self.off**2 - self.left**2 <= max(FAINTEST, SETTLED * self.off**2)


@dataclass(frozen=True, eq=False)
class Refit:
    """A search for nominal parameters.

    Attributes:
      origin: the nominal model that it begins with.
      wanted: readings to come near to, by plan id.
      noise: of the sensors.
    """

    origin: Reference
    wanted: Mapping[str, Array]
    noise: Noise

    def begun(self) -> Fit:
        """Where it begins."""
        origin = self.origin
        return self._fit(origin.values, origin.stacked(), origin.slopes, sharp=True)

    def still(self, values: Mapping[str, float], model: Mapping[str, Array]) -> Fit:
        """Parameters as they are, from which no step is taken."""
        count = len(values)
        slopes = {name: np.zeros((len(readings), count)) for name, readings in model.items()}
        rest, _ = self._white(model, slopes, self.origin.train)
        off = float(np.linalg.norm(rest))
        return Fit(values, model, slopes, False, rest, (np.zeros(count),), off)

    def best(self, rounds: int) -> Fit:
        """The best that is found.

        Args:
          rounds: how many steps at most from each start; 0 stays at the origin.
        """
        begun = self.begun()
        if not rounds or begun.off**2 <= FAINTEST:
            return begun
        steps, limits = _stepped(begun), _limits(self.origin)
        fits = self._tried([*steps, *limits, *_scaled(self.origin)], begun.slopes)
        ends = [self._descended(_nearest([begun, *fits[: len(steps)]]), rounds - 1)]
        limited, scaled = fits[len(steps) : -len(SCALES)], _nearest(fits[-len(SCALES) :])
        promising = min(limited, key=lambda fit: fit.left)
        if promising.left < PROMISE * ends[0].off:
            ends.append(self._descended(self._sharpened(promising), rounds))
        if scaled.off < begun.off:
            ends.append(self._descended(self._sharpened(scaled), rounds))
        return _nearest(ends)

    def missed(self, fit: Fit, plans: Sequence[Plan]) -> Array:
        """What a fit's longest step leaves of some plans, in units of the noise."""
        rest, slopes = self._weighed(fit.model, fit.slopes, plans)
        return np.asarray(rest - slopes @ fit.steps[0])

    def _descended(self, fit: Fit, rounds: int) -> Fit:
        """Steps, each with slopes of its own, for as long as they are worth it."""
        for _ in range(rounds):
            if fit.settled:
                break
            fit = self._sharpened(fit)
            nearer = _nearest(self._tried(_stepped(fit), fit.slopes))
            if nearer.off >= fit.off:
                break
            fit = nearer
        return fit

    def _sharpened(self, fit: Fit) -> Fit:
        """The same with slopes of its own."""
        if fit.sharp:
            return fit
        slopes = sensitivities(self.origin.world, self.origin.plans, fit.values)
        return self._fit(fit.values, fit.model, slopes, sharp=True)

    def _tried(
        self, trials: Sequence[Mapping[str, float]], slopes: Mapping[str, Array]
    ) -> list[Fit]:
        models = self.origin.tried(trials)
        return [
            self._fit(values, model, slopes, sharp=False)
            for values, model in zip(trials, models, strict=True)
        ]

    def _fit(
        self,
        values: Mapping[str, float],
        model: Mapping[str, Array],
        slopes: Mapping[str, Array],
        sharp: bool,
    ) -> Fit:
        rest, table = self._white(model, slopes, self.origin.train)
        steps = _solved(table, rest, _bounds(values, self.origin.values))
        left = float(np.linalg.norm(rest - table @ steps[0]))
        return Fit(values, model, slopes, sharp, rest, steps, left)

    def _white(
        self, model: Mapping[str, Array], slopes: Mapping[str, Array], plans: Sequence[Plan]
    ) -> tuple[Array, Array]:
        """Differences and slopes in units of the noise, as if each reading had its own.

        Noise with a memory hides what changes slowly, as it does itself.
        """
        rest, table = [], []
        for plan in plans:
            both = np.column_stack(self._weighed(model, slopes, [plan]))
            told = both.reshape(len(plan.time), -1, both.shape[1])
            memory, fresh = self.noise.memory, np.sqrt(1 - self.noise.memory**2)
            told = np.concatenate([told[:1], (told[1:] - memory * told[:-1]) / fresh])
            both = told.reshape(both.shape)
            rest.append(both[:, 0])
            table.append(both[:, 1:])
        return np.concatenate(rest), np.concatenate(table)

    def _weighed(
        self, model: Mapping[str, Array], slopes: Mapping[str, Array], plans: Sequence[Plan]
    ) -> tuple[Array, Array]:
        """Differences and slopes in units of the noise."""
        rest, table = [], []
        for plan in plans:
            weight, _ = self.origin.weights(plan, self.noise)
            rest.append((self.wanted[plan.id] - model[plan.id]) * weight)
            table.append(slopes[plan.id] * weight[:, None])
        return np.concatenate(rest), np.concatenate(table)


def _nearest(fits: Sequence[Fit]) -> Fit:
    return min(fits, key=lambda fit: fit.off)


def _stepped(fit: Fit) -> list[dict[str, float]]:
    """Parameters after a step of each stride."""
    return [
        {
            name: value * (1 + float(c))
            for (name, value), c in zip(fit.values.items(), step, strict=True)
        }
        for step in fit.steps
    ]


def _bounds(values: Mapping[str, float], origin: Mapping[str, float]) -> list[tuple[Array, Array]]:
    """Lowest and highest relative change of each parameter, for each stride."""
    ratio = np.array([origin[name] / value for name, value in values.items()])
    low, high = (np.array((1 + furthest) * ratio - 1) for furthest in FURTHEST)
    return [(np.clip(low, -s, -TINY), np.clip(high, TINY, s)) for s in STRIDES]


def _solved(slopes: Array, rest: Array, bounds: Sequence[tuple[Array, Array]]) -> tuple[Array, ...]:
    """The linear steps within bounds that explain most."""
    base, triangle = np.linalg.qr(slopes)
    count = slopes.shape[1]
    rows = np.concatenate([triangle, PULL * np.eye(count)])
    goal = np.concatenate([base.T @ rest, np.zeros(count)])
    return tuple(np.asarray(lsq_linear(rows, goal, some).x, dtype=np.float64) for some in bounds)


def _limits(origin: Reference) -> list[dict[str, float]]:
    """Parameters with the torque limit of one group where it begins to bind, or below."""
    joints = origin.world.robot.joints
    every = gains(origin.world, origin.train, [origin.world.nominal])
    pulls = []
    for plan, stiffness, damping, limit in zip(origin.train, *(g[0] for g in every), strict=True):
        position = origin.seen[plan.id].position
        speed = np.gradient(position, plan.time, axis=0)
        torque = stiffness * (plan.target - position) - damping * speed
        pulls.append(np.abs(torque / limit).max(axis=0))
    share = np.minimum(np.max(pulls, axis=0), 1.0)
    found = []
    for group in dict.fromkeys(joint.group for joint in joints):
        name = f"tau_max/{group}"
        binding = max(s for s, joint in zip(share, joints, strict=True) if joint.group == group)
        for part in LIMITS:
            lower = max(part * float(binding), 1 + FURTHEST[0])
            found.append({**origin.values, name: origin.values[name] * lower})
    return found


def _scaled(origin: Reference) -> list[dict[str, float]]:
    """All parameters so many times as large."""
    return [{name: scale * v for name, v in origin.values.items()} for scale in SCALES]
