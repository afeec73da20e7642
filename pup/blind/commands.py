"""What reaches the servos of what was sent."""

import zlib
from collections.abc import Sequence

import numpy as np

from pup.blind.world import Array, Effect, Plan, World

TAIL = 0.15  # s simulated past the last tick


def received(world: World, plans: Sequence[Plan], kicks: Array) -> tuple[Array, Array]:
    """Targets and power in the course of time, each the mean over a kick.

    Args:
      world: whose effects on the way of a command count.
      plans: what is sent.
      kicks: middle of each kick, s, evenly spaced, shape (n_kicks,).

    Returns:
      Targets of shape (n_kicks, n_plans, n_joints), rad, and power of shape
      (n_kicks, n_plans, 1), 0 to 1.
    """
    late = [effect for effect in world.effects if effect.name == "command_delay"]
    ramped = [effect for effect in world.effects if effect.name == "target_rate_limit"]
    targets = np.empty((len(kicks), len(plans), len(world.robot.joints)))
    power = np.ones((len(kicks), len(plans), 1))
    for p, plan in enumerate(plans):
        targets[:, p] = _held(plan.time, plan.target, kicks)
        for effect in late:
            joints = world.joints_at(effect.place)
            time, target = _arrivals(world, effect, plan)
            targets[:, p, joints] = _held(time, target[:, joints], kicks)
        if plan.enabled is not None:
            power[:, p, 0] = _held(plan.time, plan.enabled[:, None].astype(np.float64), kicks)[:, 0]
    for effect in ramped:
        joints = world.joints_at(effect.place)
        targets[..., joints] = _slewed(targets[..., joints], effect, kicks[1] - kicks[0])
    return targets, power


def _held(time: Array, values: Array, kicks: Array) -> Array:
    """A signal held from tick to tick, averaged over each kick, shape (n_kicks, n_columns)."""
    step = kicks[1] - kicks[0]
    edges = np.concatenate([kicks - step / 2, kicks[-1:] + step / 2])
    ends = np.concatenate([[min(edges[0], time[0]) - 1.0], time, [max(edges[-1], time[-1]) + 1.0]])
    first = np.concatenate([values[:1], values])
    area = np.concatenate(
        [np.zeros((1, values.shape[1])), np.cumsum(np.diff(ends)[:, None] * first, axis=0)]
    )
    at = np.stack([np.interp(edges, ends, column) for column in area.T], axis=1)
    return np.asarray(np.diff(at, axis=0) / step)


def _arrivals(world: World, effect: Effect, plan: Plan) -> tuple[Array, Array]:
    """When commands arrive, in order; a lost one never does."""
    rng = np.random.default_rng([world.seed, zlib.crc32(plan.id.encode())])
    waits = effect.size * (1 - effect.shape["jitter"]) + rng.exponential(
        effect.size * effect.shape["jitter"] + 1e-12, size=len(plan.time)
    )
    kept = rng.uniform(size=len(plan.time)) >= effect.shape["lost"] * effect.size
    kept[0] = True
    time: Array = np.maximum.accumulate((plan.time + waits)[kept])
    return time + 1e-7 * np.arange(len(time)), plan.target[kept]


def _slewed(targets: Array, effect: Effect, step: float) -> Array:
    """A firmware's ramp: limited rate, reached within the same way whatever the rate is."""
    out = targets.copy()
    rate = np.zeros_like(out[0])
    acceleration = effect.size**2 / (2 * effect.shape["run_up"])
    gain = acceleration * step
    for k in range(1, len(out)):
        ahead = targets[k] - out[k - 1]
        # The speed from which a stop at the goal is possible, and never past the goal in one step.
        stop = np.sqrt(2 * acceleration * np.abs(ahead))
        wanted = np.sign(ahead) * np.minimum(np.minimum(effect.size, stop), np.abs(ahead) / step)
        rate = np.clip(wanted, rate - gain, rate + gain)
        out[k] = out[k - 1] + rate * step
    return out
