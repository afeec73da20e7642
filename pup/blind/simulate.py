"""The truth in motion: all plans of a support at once, one lane each."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pup.blind.commands import TAIL, received
from pup.blind.mechanism import build
from pup.blind.scene import Scene
from pup.blind.world import SETTLING, SETTLING_ON_FEET, Array, Nominal, Plan, World
from pup.errors import InputError

LEAD = 0.1  # s kept before the first tick, for sensors that are late
KEPT = 0.001  # s between kept samples
SLOW = 2.0  # s longer to settle with an integrator
FAR = 50.0  # rad; no joint turns that far


@dataclass(frozen=True, eq=False)
class Run:
    """What happened.

    Attributes:
      time: s from the first tick, shape (n_samples,).
      position: what the servos' encoders see, rad, shape
        (n_parameter_sets, n_plans, n_samples, n_joints).
      attitude: of the torso, quaternions (w, x, y, z), shape
        (n_parameter_sets, n_plans, n_samples, 4); None on a fixed base.
    """

    time: Array
    position: Array
    attitude: Array | None


def simulate(world: World, plans: Sequence[Plan], nominals: Sequence[Nominal] = ()) -> Run:
    """Play plans of one support.

    Args:
      world: the concealed robot.
      plans: all on the same support.
      nominals: parameter sets to play them with; the world's own when none is given.

    Raises:
      InputError: the simulation breaks down.
    """
    support, nominals = plans[0].support, tuple(nominals) or (world.nominal,)
    step, ground = world.engine.step, support == "ground"
    mechanism = build(world, support, plans, nominals)
    settling = SETTLING_ON_FEET if ground else SETTLING
    if any(effect.name == "integral_action" for effect in world.effects):
        settling += SLOW
    end = max(float(plan.time[-1]) for plan in plans) + TAIL
    # Ticks at whole steps fall between two kicks: no kick sees two targets.
    kicks = step * (np.arange(-round(settling / step), np.ceil(end / step) + 1) + 0.5)
    targets, power = received(world, plans, kicks)
    scene = Scene(world, plans, nominals, mechanism)
    scene.place(ground)
    drive = scene.native if world.engine.native else scene.kick
    stride = max(1, round(KEPT / step))
    kept = np.flatnonzero(kicks >= -LEAD - 1e-9)[::stride]
    slots = {int(k): n for n, k in enumerate(kept)}
    position = np.empty((*scene.shape[:2], len(kept), scene.shape[2]))
    attitude = np.empty((*scene.shape[:2], len(kept), 4)) if ground else None
    for k, time in enumerate(kicks.tolist()):
        sensed = scene.sensed()
        if (slot := slots.get(k)) is not None:
            position[:, :, slot] = sensed
            if attitude is not None:
                attitude[:, :, slot] = scene.qpos[:, 3:7].reshape(attitude[:, :, slot].shape)
        drive(time, targets[k], power[k], sensed)
        mechanism.batch.step()
    if not np.isfinite(position).all() or np.abs(position).max() > FAR:
        raise InputError("the concealed robot's simulation breaks down; try another seed")
    return Run(kicks[kept], position, attitude)
