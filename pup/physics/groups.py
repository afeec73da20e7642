"""Recordings as a batch of simulations replays them: one model, one grid of sub-steps."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pup.physics.commands import Commands
from pup.physics.encoders import Event, Readings
from pup.physics.model import Model, compile_model, first_tilt, named_units, standing_qpos
from pup.physics.rest import ticks_at_rest
from pup.physics.simulator import Schedule, schedule
from pup.recording import Recording
from pup.robot import RobotDescription

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Group:
    """Recordings of one support, longest first, so that those still running are the first ones.

    Attributes:
      members: which recordings.
      model: the compiled model.
      setups: the setup knobs of each recording.
      start: starting qpos of each, shape (n_recordings, nq).
      torso: first orientations by the IMU, shape (n_recordings, 4); NaN where there is none.
      start_velocity: starting joint velocities, shape (n_recordings, n_joints).
      commands: their targets.
      power: share of torque on, shape (n_steps, n_recordings).
      running: how many recordings still run in each sub-step.
      readings: their ticks.
      events: the same in each sub-step.
      rests: which recordings begin at rest on the ground, shape (n_recordings,).
    """

    members: tuple[int, ...]
    model: Model
    setups: tuple[dict[str, float], ...]
    start: Array
    torso: Array
    start_velocity: Array
    commands: Commands
    power: Array
    running: NDArray[np.int64]
    readings: Readings
    events: tuple[Event | None, ...]
    rests: NDArray[np.bool_]


def group_of(
    robot: RobotDescription, recordings: Sequence[Recording], support: str, ticks: Sequence[slice]
) -> Group:
    """The recordings of one support, to be replayed together.

    Args:
      robot: the robot.
      recordings: all of them.
      support: which one.
      ticks: of each recording, among all.
    """
    members = [i for i, r in enumerate(recordings) if r.support == support]
    model = compile_model(robot, support)
    units = named_units(robot)
    plans = {i: schedule(recordings[i], robot.joint_names, robot.timestep, units) for i in members}
    members.sort(key=lambda i: -plans[i].steps)
    ordered = [plans[i] for i in members]
    steps = ordered[0].steps
    power = np.stack([_extended(p.power, steps) for p in ordered], axis=1)
    torso = [first_tilt(robot, model, recordings[i]) for i in members]
    start = [
        standing_qpos(robot, model, plans[i].start, tilt)
        for i, tilt in zip(members, torso, strict=True)
    ]
    readings = _readings(ordered, [ticks[i].start for i in members])
    return Group(
        members=tuple(members),
        model=model,
        setups=tuple(robot.setup(recordings[i].setup) for i in members),
        start=np.stack(start),
        torso=np.stack(torso),
        start_velocity=np.stack([p.start_velocity for p in ordered]),
        commands=Commands(ordered, robot.timestep),
        power=np.ascontiguousarray(power),
        running=np.sum([np.arange(steps) < p.steps for p in ordered], axis=0),
        readings=readings,
        events=readings.events(steps),
        rests=np.array([ticks_at_rest(recordings[i], units) > 1 for i in members]),
    )


def _extended(values: Array, steps: int) -> Array:
    """Repeat the last row up to a number of sub-steps."""
    return np.concatenate([values, np.repeat(values[-1:], steps - len(values), axis=0)])


def _readings(plans: Sequence[Schedule], first_tick: Sequence[int]) -> Readings:
    rows = np.concatenate([np.full(len(p.tick_step), i) for i, p in enumerate(plans)])
    ticks = np.concatenate(
        [f + np.arange(len(p.tick_step)) for f, p in zip(first_tick, plans, strict=True)]
    )
    step = np.concatenate([p.tick_step for p in plans])
    fraction = np.concatenate([p.tick_fraction for p in plans])
    order = np.argsort(step, kind="stable")
    return Readings(step[order], rows[order], ticks[order], fraction[order])
