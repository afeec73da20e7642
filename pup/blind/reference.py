"""The nominal readings of a case, and how they change with the nominal parameters."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
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

NUDGE = 0.01  # relative change of a parameter for its sensitivity
COARSE = 2 * STEP  # s, of sensitivities, which are differences


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


def bare(world: World, nominals: Sequence[Nominal], step: float = STEP) -> World:
    """The first nominal model without effects, in steps that are steady under all of them."""
    engine = Engine(step=min(steady(nominal, step) for nominal in nominals))
    return replace(world, nominal=nominals[0], effects=(), engine=engine)


def sensitivities(
    world: World, plans: Sequence[Plan], values: Mapping[str, float]
) -> dict[str, Array]:
    """How nominal readings change with the parameters, by plan id.

    Args:
      world: its effects and engine do not count.
      plans: whose readings.
      values: the parameters by name.

    Returns:
      Per unit of relative change, a column for each parameter.
    """
    nudged = [{**values, name: value * (1 + NUDGE)} for name, value in values.items()]
    nominals = [Nominal.of(world.robot, some) for some in (values, *nudged)]
    found = readings(bare(world, nominals, COARSE), plans, nominals)
    return {
        plan.id: np.stack(
            [(f[plan.id].stacked() - found[0][plan.id].stacked()) / NUDGE for f in found[1:]],
            axis=1,
        )
        for plan in plans
    }


@dataclass(frozen=True, eq=False)
class Reference:
    """The nominal readings of a case and how they change with the parameters.

    Attributes:
      world: without effects.
      plans: those that repeat no other.
      seen: by plan id.
      values: the nominal parameters by name.
    """

    world: World
    plans: tuple[Plan, ...]
    seen: Mapping[str, Seen]
    values: Mapping[str, float]

    @classmethod
    def of(cls, world: World, plans: Sequence[Plan], values: Mapping[str, float]) -> "Reference":
        """Simulate it.

        Args:
          world: its effects, integrator and solver do not count.
          plans: of the case.
          values: the nominal parameters by name.
        """
        plans = tuple(unrepeated(plans))
        names = nominal_names(world.robot, any(plan.support == "ground" for plan in plans))
        values = {name: values[name] for name in names}
        plain = bare(world, [Nominal.of(world.robot, values)])
        return cls(plain, plans, readings(plain, plans)[0], values)

    @cached_property
    def slopes(self) -> dict[str, Array]:
        """Sensitivities to the parameters, in the order of `values`, by plan id."""
        return sensitivities(self.world, self.plans, self.values)

    @property
    def train(self) -> list[Plan]:
        """Plans that the engine is given."""
        return [plan for plan in self.plans if not plan.test]

    @property
    def test(self) -> list[Plan]:
        """Plans that the engine is not given."""
        return [plan for plan in self.plans if plan.test]

    def stacked(self) -> dict[str, Array]:
        """All nominal readings of a plan in a row, by plan id."""
        return {plan.id: self.seen[plan.id].stacked() for plan in self.plans}

    def tried(self, trials: Sequence[Mapping[str, float]]) -> list[dict[str, Array]]:
        """The same under other parameters, for each set of them.

        Changes are added to the nominal readings, so that a finer step, which some parameters need,
        does not count as one.
        """
        nominals = [Nominal.of(self.world.robot, values) for values in trials]
        nominals = [self.world.nominal, *nominals]
        own, *others = readings(bare(self.world, nominals), self.plans, nominals)
        return [
            {n: old + one[n].stacked() - own[n].stacked() for n, old in self.stacked().items()}
            for one in others
        ]

    def weights(self, plan: Plan, noise: Noise) -> tuple[Array, Indices]:
        """One over the standard deviation of every reading in a row, and its channel.

        Channels are joints, then roll and pitch.
        """
        seen = self.seen[plan.id]
        tilts = 0 if seen.tilt is None else seen.tilt.shape[1]
        ticks, joints = seen.position.shape
        weight = [1 / noise.sigma] * joints + [1 / noise.imu] * tilts
        columns = np.arange(joints + tilts)
        return np.tile(weight, ticks), np.tile(columns, ticks)
