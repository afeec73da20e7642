"""The replay protocol on MuJoCo's batches of simulations."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import mujoco
import mujoco.batch
import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.physics.actuators import LAWS, TorqueLaw
from pup.physics.fields import apply_fields, scaled
from pup.physics.model import Model, compile_model, starting_qpos
from pup.physics.parameters import Candidates
from pup.physics.simulator import Schedule, Trajectories, schedule, tick_slices
from pup.recording import Recording
from pup.robot import RobotDescription

Array = NDArray[np.float64]

SIMULATIONS = 512
"""Simulations in a batch: enough to hide NumPy's overhead, few enough to stay in cache."""

_BROKEN = [
    int(mujoco.mjtWarning.mjWARN_BADQPOS),
    int(mujoco.mjtWarning.mjWARN_BADQVEL),
    int(mujoco.mjtWarning.mjWARN_BADQACC),
]


@dataclass(frozen=True)
class _Event:
    """The ticks in one sub-step: of which recordings, where they are stored, how far in."""

    rows: NDArray[np.int64]
    ticks: NDArray[np.int64]
    fraction: Array


@dataclass(frozen=True)
class _Group:
    """Recordings of one support, longest first, so that those still running are the first ones.

    Attributes:
      model: the compiled model.
      setups: the setup knobs of each recording.
      start: starting qpos of each, shape (n_recordings, nq).
      start_velocity: starting joint velocities, shape (n_recordings, n_joints).
      target: mean targets per sub-step, shape (n_steps, n_recordings, n_joints).
      power: share of torque on, shape (n_steps, n_recordings).
      running: how many recordings still run in each sub-step.
      events: the ticks in each sub-step.
      always_on: whether torque is never off.
    """

    model: Model
    setups: tuple[dict[str, float], ...]
    start: Array
    start_velocity: Array
    target: Array
    power: Array
    running: NDArray[np.int64]
    events: tuple[_Event | None, ...]
    always_on: bool


class MujocoSimulator:
    """Replays recordings with `mujoco.batch.Batch`.

    All recordings of one support and many candidates advance together; a torque law computes the
    torque of the whole batch at every sub-step. Positions between sub-steps are interpolated
    linearly. Each thread runs batches of its own, so that the torques are computed on all cores
    too; a simulation's result does not depend on the batch it is in.

    Args:
      robot: the robot.
      recordings: what is replayed, each for exactly this robot.
      actuator: the torque law, `pd` or `nn_pd`.
      threads: batches that run at once, one core each.
    """

    def __init__(
        self,
        robot: RobotDescription,
        recordings: Sequence[Recording],
        actuator: str = "nn_pd",
        threads: int = 1,
    ) -> None:
        if actuator not in LAWS:
            raise InputError(f"actuator {actuator!r} is unknown; known: {', '.join(LAWS)}")
        for recording in recordings:
            recording.validate(robot)
        self.robot = robot
        self.recordings = tuple(recordings)
        self.law = LAWS[actuator]
        self.threads = threads
        self.ticks = tick_slices(self.recordings)
        supports = sorted({r.support for r in self.recordings})
        self.groups = tuple(self._group(support) for support in supports)

    @property
    def steps(self) -> int:
        """Sub-steps that one candidate costs."""
        return int(sum(group.running.sum() for group in self.groups))

    def replay(self, candidates: Candidates) -> Trajectories:
        """See Simulator."""
        n, ticks = len(candidates), self.ticks[-1].stop if self.ticks else 0
        out = Trajectories(
            self.ticks,
            np.full((n, ticks, len(self.robot.joints)), np.nan),
            np.full((n, ticks, 2), np.nan),
            np.full((n, ticks, len(self.robot.feet), 3), np.nan),
        )
        jobs = [(group, part) for group in self.groups for part in self._parts(group, n)]

        def run(job: tuple[_Group, slice]) -> None:
            group, part = job
            _Run(self.robot, group, candidates.rows(part), self.law).into(out, part)

        if self.threads == 1:
            for job in jobs:
                run(job)
        else:
            with ThreadPoolExecutor(self.threads) as pool:
                list(pool.map(run, jobs))
        return out

    def _parts(self, group: _Group, candidates: int) -> list[slice]:
        """The candidates in parts of one batch each, at least one part per thread."""
        most = max(1, SIMULATIONS // len(group.setups))
        parts = min(candidates, max(self.threads, -(-candidates // most)))
        edges = np.linspace(0, candidates, parts + 1).astype(int)
        return [slice(int(a), int(b)) for a, b in pairwise(edges)]

    def _group(self, support: str) -> _Group:
        members = [i for i, r in enumerate(self.recordings) if r.support == support]
        model = compile_model(self.robot, support)
        plans = {
            i: schedule(self.recordings[i], self.robot.joint_names, self.robot.timestep)
            for i in members
        }
        members.sort(key=lambda i: -plans[i].steps)
        ordered = [plans[i] for i in members]
        steps = ordered[0].steps
        target = np.stack([_extended(p.target, steps) for p in ordered], axis=1)
        power = np.stack([_extended(p.power, steps) for p in ordered], axis=1)
        start = [
            starting_qpos(self.robot, model, plans[i].start, self.recordings[i]) for i in members
        ]
        return _Group(
            model=model,
            setups=tuple(self.robot.setup(self.recordings[i].setup) for i in members),
            start=np.stack(start),
            start_velocity=np.stack([p.start_velocity for p in ordered]),
            target=np.ascontiguousarray(target),
            power=np.ascontiguousarray(power),
            running=np.sum([np.arange(steps) < p.steps for p in ordered], axis=0),
            events=_events(ordered, [self.ticks[i].start for i in members], steps),
            always_on=bool((power == 1).all()),
        )


def _extended(values: Array, steps: int) -> Array:
    """Repeat the last row up to a number of sub-steps."""
    return np.concatenate([values, np.repeat(values[-1:], steps - len(values), axis=0)])


def _events(
    plans: Sequence[Schedule], first_tick: Sequence[int], steps: int
) -> tuple[_Event | None, ...]:
    rows = np.concatenate([np.full(len(p.tick_step), i) for i, p in enumerate(plans)])
    ticks = np.concatenate(
        [f + np.arange(len(p.tick_step)) for f, p in zip(first_tick, plans, strict=True)]
    )
    step = np.concatenate([p.tick_step for p in plans])
    fraction = np.concatenate([p.tick_fraction for p in plans])
    order = np.argsort(step, kind="stable")
    edges = np.searchsorted(step[order], np.arange(steps + 1))
    return tuple(
        _Event(rows[order[a:b]], ticks[order[a:b]], fraction[order[a:b]]) if b > a else None
        for a, b in pairwise(edges)
    )


class _Run:
    """One batch: the simulations stand recording by recording, candidate by candidate."""

    def __init__(
        self,
        robot: RobotDescription,
        group: _Group,
        candidates: Candidates,
        law: Callable[[RobotDescription, Candidates], TorqueLaw],
    ) -> None:
        self.group = group
        self.recordings, self.candidates = len(group.setups), len(candidates)
        nsim = self.recordings * self.candidates
        per_simulation = scaled(robot, candidates, group.setups)
        self.batch = mujoco.batch.Batch(group.model.compiled, nsim, 1)
        self.law = law(robot, per_simulation)
        self.viscous = apply_fields(
            self.batch, robot, group.model, per_simulation, group.setups, self.law.armature
        )
        self.viscous += self.law.passive
        self.qpos, self.qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self.qpos[:] = np.repeat(group.start, self.candidates, axis=0)
        self.qvel[:, group.model.dofs] = np.repeat(group.start_velocity, self.candidates, axis=0)
        self.force = self.batch.bind("qfrc_applied")
        self.damping = self.batch.expand("dof_damping")
        self.feet = [group.model.compiled.body(foot).id for foot in robot.feet]
        if group.model.floating:
            self.places = self.batch.bind("xpos")
            self.sensor = _sensor_quaternion(robot, group.model)
        self.delay: tuple[NDArray[np.int64], Array] | None = None
        if "command_delay" in candidates:
            delay = (per_simulation["command_delay"] / robot.timestep).reshape(-1, self.candidates)
            whole = np.floor(delay).astype(np.int64)
            self.delay = whole, (delay - whole)[:, :, None]
        self.ids = np.arange(nsim, dtype=np.int32)
        self.broken = np.zeros(nsim, dtype=bool)

    def into(self, out: Trajectories, part: slice) -> None:
        """Run to the end and write the candidates' part of the trajectories."""
        qpos, dofs = self.group.model.qpos, self.group.model.dofs
        for step, (running, event) in enumerate(
            zip(self.group.running, self.group.events, strict=True)
        ):
            n = int(running) * self.candidates
            error = self._error(step, int(running), self.qpos[:n, qpos])
            torque, damping = self.law.torque(error, self.qvel[:n, dofs])
            if not self.group.always_on:
                on = np.repeat(self.group.power[step, :running], self.candidates)[:, None]
                torque *= on
                damping *= on
            damping += self.viscous[:n]
            self.force[:n, dofs] = torque
            self.damping[:n, dofs] = damping
            if event is None:
                self._advance(n)
            else:
                self._observed(event, n, out, part)

    def _error(self, step: int, running: int, position: Array) -> Array:
        """Target minus position of the running simulations, shape (n, n_joints)."""
        by_recording = position.reshape(running, self.candidates, -1)
        return (self._target(step, running) - by_recording).reshape(position.shape)

    def _target(self, step: int, running: int) -> Array:
        """Targets of the running recordings, shape (running, n_candidates or 1, n_joints)."""
        if self.delay is None:
            return self.group.target[step, :running, None]
        whole, share = (of[:running] for of in self.delay)
        row = np.arange(running)[:, None]
        newer = self.group.target[np.maximum(step - whole, 0), row]
        older = self.group.target[np.maximum(step - whole - 1, 0), row]
        return np.asarray((1 - share) * newer + share * older)

    def _advance(self, n: int) -> None:
        try:
            self.batch.step(ids=None if n == len(self.ids) else self.ids[:n])
        except mujoco.batch.SimulationError as error:
            self.broken[error.ids] = True
            self.batch.reset(ids=error.ids)

    def _observed(self, event: _Event, n: int, out: Trajectories, part: slice) -> None:
        """Advance one sub-step and write the ticks in it."""
        rows = (event.rows[:, None] * self.candidates + np.arange(self.candidates)).ravel()
        if self.group.model.floating:
            tilt = _roll_pitch(self.qpos[rows, 3:7], self.sensor)
        before = self.qpos[rows][:, self.group.model.qpos]
        self._advance(n)
        after = self.qpos[rows][:, self.group.model.qpos]
        fraction = np.repeat(event.fraction, self.candidates)[:, None]
        lost = self.broken[rows] | (self.batch.warning[rows, :, 1][:, _BROKEN] > 0).any(axis=1)
        self._store(out.position, part, event, before + fraction * (after - before), lost)
        if self.group.model.floating:
            self._store(out.tilt, part, event, tilt, lost)
            # Derived positions describe the state before the sub-step: the tick's own, to 2 ms.
            self._store(out.feet, part, event, self.places[rows][:, self.feet], lost)

    def _store(
        self, to: Array, part: slice, event: _Event, values: Array, lost: NDArray[np.bool_]
    ) -> None:
        values[lost] = np.nan
        shaped = values.reshape(len(event.rows), self.candidates, *values.shape[1:])
        to[part, event.ticks] = shaped.swapaxes(0, 1)


def _sensor_quaternion(robot: RobotDescription, model: Model) -> Array:
    """The IMU's orientation in the torso."""
    if robot.imu_site is None:
        return np.array([1.0, 0, 0, 0])
    return np.array(model.compiled.site(robot.imu_site).quat)


def _roll_pitch(torso: Array, sensor: Array) -> Array:
    """Roll and pitch (Z-Y-X) of a sensor fixed in the torso, shape (n, 2), rad."""
    w, x, y, z = torso.T
    a, b, c, d = sensor
    w, x, y, z = (
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    )
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    return np.stack([roll, pitch], axis=1)
