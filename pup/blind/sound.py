"""Whether what a case conceals is physics, and not an artefact of how it is simulated."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pup.blind.drafts import Draft
from pup.blind.reference import Reference, readings
from pup.blind.sensors import Noise, Seen
from pup.blind.world import Array, Effect, Plan, World
from pup.errors import InputError

SLIGHT, SHARE = 0.001, 0.2  # of a size, and the most it may make of the change
FINER, WRONG = 2, 0.1  # steps for one, and the share of the change that they may add
UNSEEN = 0.05  # of sigma; a change by less counts as none


def check(draft: Draft, reference: Reference, seen: Mapping[str, Seen]) -> None:
    """Look at every effect on the training motion that shows most.

    Args:
      draft: with its final sizes.
      reference: the nominal readings.
      seen: those with what is concealed.

    Raises:
      InputError: an effect does not shrink with its size, or changes with the time step.
    """
    train = [plan for plan in reference.plans if not plan.test]
    plan = max(train, key=lambda p: float(np.linalg.norm(_apart(seen[p.id], reference.seen[p.id]))))
    world, nominal = draft.world, reference.seen[plan.id]
    for effect in draft.effects:
        alone = draft.full().effects == (effect,)
        change = _apart(seen[plan.id], nominal) if alone else _change(world, plan, effect, nominal)
        if not shrinks(world, plan, effect, nominal, change, draft.noise):
            raise InputError(f"{effect.name}: it does not shrink with its size")
        if not converged(world, plan, effect, change, draft.noise):
            raise InputError(f"{effect.name}: it depends on the time step")


def shrinks(
    world: World, plan: Plan, effect: Effect, nominal: Seen, change: Array, noise: Noise
) -> bool:
    """Whether hardly any of an effect makes hardly any of its change.

    A stop does not count: its size is an angle.
    """
    if effect.name == "joint_stop":
        return True
    left = _rms(_change(world, plan, effect.scaled(SLIGHT), nominal))
    return left <= max(SHARE * _rms(change), UNSEEN * noise.sigma)


def converged(world: World, plan: Plan, effect: Effect, change: Array, noise: Noise) -> bool:
    """Whether smaller steps make the same of an effect."""
    fine = replace(world, engine=replace(world.engine, step=world.engine.step / FINER))
    nominal = readings(replace(fine, effects=()), [plan])[0][plan.id]
    error = _rms(_change(fine, plan, effect, nominal) - change)
    return error <= max(WRONG * _rms(change), UNSEEN * noise.sigma)


def _change(world: World, plan: Plan, effect: Effect, nominal: Seen) -> Array:
    """What one effect alone changes, rad."""
    seen = readings(replace(world, effects=(effect,)), [plan])[0][plan.id]
    return _apart(seen, nominal)


def _apart(one: Seen, other: Seen) -> Array:
    return np.asarray(one.stacked() - other.stacked())


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
