"""Walks of a fleet by a policy: what the agent does in a trial, on many robots at once.

Every robot has its own eta. Sensing, policy and limits are the agent's, tick by tick; what is left
out are packets, the hand that puts a robot on its feet, and the journal.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hardware_agent.config import ControlSettings, SafetySettings
from hardware_agent.distance import AXES
from hardware_agent.rollout import columns
from hardware_agent.virtual.fleet import Fleet
from pup.policy.bundle import NumpyPolicy

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Walks:
    """How far robots came.

    Attributes:
      distance: in the policy's direction until the horizon or the fall, m, shape (n,).
      time: until then, s, shape (n,).
    """

    distance: Array
    time: Array


def walk(
    fleet: Fleet, policy: NumpyPolicy, eta: Array, horizon: float, period: float, draw: int = 0
) -> Walks:
    """Let a fleet walk, each robot from its start pose, with cold motors and a fresh battery.

    Args:
      fleet: the robots; one seed may come several times.
      policy: that moves all of them.
      eta: what it is conditioned on, shape (n, n_eta).
      horizon: the longest walk, s.
      period: of the control loop, s; of whole milliseconds, in which a virtual robot's time passes.
      draw: decides on the noise beside the robots' seeds: one seed has the same in all its walks.
    """
    card, gait, robot = policy.card, policy.card.gait, fleet.robot
    assert robot.gait is not None
    seen = columns(card.joints, card.observation)
    lower, upper = robot.limits
    reach, tilted = SafetySettings.speed * period, SafetySettings.fall_tilt or robot.gait.tilt_limit
    axis = np.array(AXES[card.direction])

    fleet.plant.renew(draw)
    fleet.reset()
    pose = policy.targets(0.0, np.full((1, card.shape.joints), (card.shape.bins - 1) / 2))
    goal = np.tile(pose, (len(fleet), 1))
    for _ in range(round(ControlSettings.settle / period)):
        fleet.command(goal, period)

    start = fleet.way
    distance, time = np.zeros(len(fleet)), np.full(len(fleet), horizon)
    up, before, actions = np.ones(len(fleet), dtype=bool), None, []
    for tick in range(round(horizon / period)):
        position, tilt = fleet.observe()
        fallen = up & (np.abs(tilt) > tilted).any(axis=1)
        distance[fallen] = ((fleet.way - start) @ axis)[fallen]
        time[fallen] = tick * period
        up &= ~fallen
        if not up.any():
            break
        now = np.concatenate([position, tilt - [0.0, gait.imu_pitch_offset]], axis=1)
        both = np.concatenate([now if before is None else before, now], axis=1)
        before, actions = now, [*actions, policy.act(both[:, seen], eta)][-card.smoothing :]
        target = np.clip(policy.targets(tick * period, np.array(actions)), lower, upper)
        goal = np.clip(target, goal - reach, goal + reach)
        fleet.command(goal, period)
    distance[up] = ((fleet.way - start) @ axis)[up]
    return Walks(distance, time)
