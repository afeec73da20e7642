"""How much of an effect a refit of the nominal parameters leaves."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pup.blind.sensors import Noise, Seen, see
from pup.blind.simulate import simulate
from pup.blind.world import (
    STEP,
    Array,
    Engine,
    Indices,
    Nominal,
    Plan,
    World,
    nominal_names,
    steady,
)

NUDGE = 0.04  # relative change of a parameter for its sensitivity
COARSE = 10  # joints from which sensitivities take a coarser step
FURTHEST = (-0.8, 3.0)  # relative changes of parameters in a refit
STRIDE = 0.5  # largest relative change of a parameter in one step
LOUD = 2.0  # sigma, from which a reading counts as off
FAINT = 4.0  # least SNR at which an effect counts as there
MATERIAL = 0.3  # of sigma, the held-out gain from which an omission matters


@dataclass(frozen=True)
class Visibility:
    """What an effect does to the readings, training motions unless told otherwise.

    Attributes:
      raw: rms over the readings of the joint that shows most, before a refit, rad.
      left: the same after a refit.
      snr: matched-filter signal to noise of all readings after a refit.
      absorbed: share of the rms of all readings that a refit hides.
      held_out: as `left`, on the training or the test motions, whichever show more, in units of
        sigma: the engine may leave out any of the former, the scorer keeps the latter.
      held_out_all: the same over all joints.
      tested: rms over all joints of what a refit leaves of the test motions, rad; None where there
        are none.
      absorbed_by: relative change of each nominal parameter.
      when: spans of the recordings in which a refit leaves more than noise.
    """

    raw: float
    left: float
    snr: float
    absorbed: float
    held_out: float
    held_out_all: float
    tested: float | None
    absorbed_by: Mapping[str, float]
    when: Sequence[Mapping[str, Any]]

    @property
    def gain(self) -> float:
        """What a complete model wins on held-out motions in that joint, in units of sigma."""
        return float(np.hypot(1.0, self.held_out) - 1.0)

    def document(self) -> dict[str, Any]:
        """As in the key."""
        return {
            "raw_rms_rad": self.raw,
            "after_refit_rms_rad": self.left,
            "after_refit_test_rms_rad": self.tested,
            "snr": self.snr,
            "absorbed": self.absorbed,
            "held_out_gain_sigma": self.gain,
            "held_out_gain_sigma_all_joints": float(np.hypot(1.0, self.held_out_all) - 1.0),
            "material": bool(self.gain > MATERIAL),
            "absorbed_by": dict(self.absorbed_by),
            "when": list(self.when),
        }


def unrepeated(plans: Sequence[Plan]) -> list[Plan]:
    """The plans that repeat no other."""
    return [plan for plan in plans if plan.repeat_of is None]


def readings(world: World, plans: Sequence[Plan], nominals: Sequence[Nominal] = ()) -> list[Any]:
    """Noise-free readings of plans on any supports.

    Returns:
      For each parameter set, a dictionary of `Seen` by plan id.
    """
    count = max(1, len(nominals))
    found: list[dict[str, Seen]] = [{} for _ in range(count)]
    for support in sorted({plan.support for plan in plans}):
        group = [plan for plan in plans if plan.support == support]
        run = simulate(world, group, nominals)
        for variant in range(count):
            seen = see(world, group, run, variant)
            found[variant] |= {plan.id: one for plan, one in zip(group, seen, strict=True)}
    return found


@dataclass(frozen=True, eq=False)
class Reference:
    """The nominal readings of a case and how they change with the parameters.

    Attributes:
      world: without effects.
      plans: those that repeat no other.
      seen: by plan id.
      jacobian: by plan id, per unit of relative change, columns in the order of `values`.
      values: the nominal parameters by name.
    """

    world: World
    plans: tuple[Plan, ...]
    seen: Mapping[str, Seen]
    jacobian: Mapping[str, Array]
    values: Mapping[str, float]

    @classmethod
    def of(cls, world: World, plans: Sequence[Plan], values: Mapping[str, float]) -> "Reference":
        """Simulate it.

        Args:
          world: its effects, integrator and solver do not count.
          plans: of the case.
          values: the nominal parameters by name.
        """
        nominal = Nominal.of(world.robot, values)
        bare = replace(world, effects=(), engine=Engine(step=steady(nominal, STEP)))
        plans = unrepeated(plans)
        ground = any(plan.support == "ground" for plan in plans)
        names = nominal_names(world.robot, ground)
        sets = [nominal]
        sets += [Nominal.of(world.robot, {**values, n: values[n] * (1 + NUDGE)}) for n in names]
        many = len(world.robot.joints) >= COARSE
        coarse = replace(bare, engine=Engine(step=steady(nominal, 2 * STEP))) if many else bare
        found = readings(coarse, plans, sets)
        seen = readings(bare, plans)[0] if many else found[0]
        jacobian = {
            plan.id: np.stack(
                [(f[plan.id].stacked() - found[0][plan.id].stacked()) / NUDGE for f in found[1:]],
                axis=1,
            )
            for plan in plans
        }
        return cls(bare, tuple(plans), seen, jacobian, {name: values[name] for name in names})

    def visibility(
        self,
        seen: Mapping[str, Seen],
        noise: Noise,
        against: Mapping[str, Seen] | None = None,
        rounds: int = 0,
    ) -> Visibility:
        """Compare readings with the nominal ones, or with others.

        Args:
          seen: readings of the same plans.
          noise: of the sensors.
          against: what to compare with instead.
          rounds: how often the refitted model is simulated anew; 0 is linear theory alone.
        """
        train = [plan for plan in self.plans if not plan.test]
        test = [plan for plan in self.plans if plan.test]
        wanted = self._shifted(seen, against)
        change, model = self._refitted(wanted, noise, train, rounds)
        rest, _, columns = self._weighed(train, wanted, self._stacked(), noise)
        left = self._left(train, wanted, model, noise, train)
        norm, joints = float(np.linalg.norm(rest)), len(self.world.robot.joints)
        apart = [_rms(left, columns, joints)]
        tested = None
        if test:
            missed = self._left(train, wanted, model, noise, test)
            apart.append(_rms(missed, self._weighed(test, wanted, model, noise)[2], joints))
            tested = _root_mean_square(apart[-1]) * noise.sigma
        return Visibility(
            raw=float(_rms(rest, columns, joints).max()) * noise.sigma,
            left=float(apart[0].max()) * noise.sigma,
            snr=float(np.linalg.norm(left)),
            absorbed=1.0 - float(np.linalg.norm(left)) / norm if norm else 0.0,
            held_out=float(np.max(apart)),
            held_out_all=max(map(_root_mean_square, apart)),
            tested=tested,
            absorbed_by={n: float(c) for n, c in zip(self.values, change, strict=True)},
            when=self._spans(train, wanted, model, noise),
        )

    def _spans(
        self,
        train: Sequence[Plan],
        wanted: Mapping[str, Array],
        model: Mapping[str, Array],
        noise: Noise,
    ) -> list[dict[str, Any]]:
        """Where in the training motions a reading is off by more than noise."""
        spans = []
        for plan in train:
            left = self._left(train, wanted, model, noise, [plan])
            off = np.abs(left).reshape(len(plan.time), -1).max(axis=1) > LOUD
            edges = np.flatnonzero(np.diff(np.concatenate([[0], off * 1, [0]])))
            ends = np.append(plan.time, plan.time[-1])
            spans += [
                {"recording": plan.id, "start": float(ends[a]), "end": float(ends[b])}
                for a, b in zip(edges[::2], edges[1::2], strict=True)
            ]
        return spans

    def _stacked(self) -> dict[str, Array]:
        return {plan.id: self.seen[plan.id].stacked() for plan in self.plans}

    def _shifted(
        self, seen: Mapping[str, Seen], against: Mapping[str, Seen] | None
    ) -> dict[str, Array]:
        """The nominal readings plus what is to be explained."""
        base = against or self.seen
        return {
            name: nominal + seen[name].stacked() - base[name].stacked()
            for name, nominal in self._stacked().items()
        }

    def _refitted(
        self, wanted: Mapping[str, Array], noise: Noise, train: Sequence[Plan], rounds: int
    ) -> tuple[Array, dict[str, Array]]:
        """Gauss and Newton's steps, halved where they fail: relative changes and readings."""
        change: Array = np.zeros(len(self.values))
        model = self._stacked()
        rest, slopes, _ = self._weighed(train, wanted, model, noise)
        step = _solved(slopes, rest)
        for _ in range(rounds):
            trial = np.clip(change + step, *FURTHEST)
            tried = self._model(trial)
            then, _, _ = self._weighed(train, wanted, tried, noise)
            if np.linalg.norm(then) < np.linalg.norm(rest):
                change, model, rest = trial, tried, then
                step = _solved(slopes, rest)
            else:
                step = step / 2
        return change if rounds else step, model

    def _model(self, change: Array) -> dict[str, Array]:
        """Nominal readings under changed parameters."""
        values = {n: v * (1 + c) for (n, v), c in zip(self.values.items(), change, strict=True)}
        world = replace(self.world, nominal=Nominal.of(self.world.robot, values))
        return {name: seen.stacked() for name, seen in readings(world, self.plans)[0].items()}

    def _left(
        self,
        train: Sequence[Plan],
        wanted: Mapping[str, Array],
        model: Mapping[str, Array],
        noise: Noise,
        plans: Sequence[Plan],
    ) -> Array:
        """What the best linear step from a model, fitted to some plans, leaves of others."""
        rest, slopes, _ = self._weighed(train, wanted, model, noise)
        step = _solved(slopes, rest)
        other, other_slopes, _ = self._weighed(plans, wanted, model, noise)
        return np.asarray(other - other_slopes @ step)

    def _weighed(
        self,
        plans: Sequence[Plan],
        wanted: Mapping[str, Array],
        model: Mapping[str, Array],
        noise: Noise,
    ) -> tuple[Array, Array, Indices]:
        """Differences and sensitivities in units of the noise, and the column of each reading."""
        rest, slopes, columns = [], [], []
        for plan in plans:
            weight, column = _weights(self.seen[plan.id], noise)
            rest.append((wanted[plan.id] - model[plan.id]) * weight)
            slopes.append(self.jacobian[plan.id] * weight[:, None])
            columns.append(column)
        return np.concatenate(rest), np.concatenate(slopes), np.concatenate(columns)


def _solved(slopes: Array, rest: Array) -> Array:
    """The linear step that explains most, no longer than what linear theory is good for."""
    step = np.asarray(np.linalg.lstsq(slopes, rest, rcond=1e-6)[0], dtype=np.float64)
    return step * min(1.0, STRIDE / max(float(np.abs(step).max()), 1e-12))


def _weights(seen: Seen, noise: Noise) -> tuple[Array, Indices]:
    """One over the standard deviation of every reading in a row, and its column."""
    tilts = 0 if seen.tilt is None else seen.tilt.shape[1]
    ticks, joints = seen.position.shape
    weight = [1 / noise.sigma] * joints + [1 / noise.imu] * tilts
    columns = [*range(joints), *([-1] * tilts)]
    return np.tile(weight, ticks), np.tile(columns, ticks)


def _root_mean_square(rms: Array) -> float:
    """Root mean square over joints of as many readings each."""
    return float(np.sqrt(np.mean(rms**2)))


def _rms(values: Array, columns: Indices, joints: int) -> Array:
    """Root mean square per joint, shape (joints,)."""
    return np.array([np.sqrt(np.mean(values[columns == j] ** 2)) for j in range(joints)])
