"""The replay protocol on MuJoCo's batches of simulations."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import mujoco
import mujoco.batch
import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.physics.actuators import LAWS, TorqueLaw
from pup.physics.encoders import Event, History
from pup.physics.fields import scaled
from pup.physics.groups import Group, group_of
from pup.physics.loop import Loop
from pup.physics.model import mount, standing_qpos
from pup.physics.one_joint import OneJoint
from pup.physics.outfit import as_the_imu_tells, fit_out, longest
from pup.physics.parameters import Candidates
from pup.physics.push import Push, Pushing
from pup.physics.rotations import multiply, roll_pitch
from pup.physics.servo import Servos
from pup.physics.simulator import Trajectories, tick_slices
from pup.physics.sinking import sink
from pup.physics.terms import Drivetrain
from pup.physics.writer import FieldWriter
from pup.recording import Recording
from pup.robot import RobotDescription

Array = NDArray[np.float64]

SIMULATIONS = 512
"""Simulations in a batch: enough to hide what calls cost, few enough to stay in cache."""

KEPT = 4_000_000
"""Sub-steps of a batch whose readings are kept, all simulations together: 32 MB."""

_BROKEN = slice(mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQACC + 1)
"""Warnings of broken positions, velocities and accelerations."""


class MujocoSimulator:
    """Replays recordings with `mujoco.batch.Batch`.

    All recordings of one support and many candidates advance together; a torque law, with the terms
    that the candidates' columns name, computes the torques of the whole batch at every sub-step.
    Positions between sub-steps are interpolated linearly. Each thread runs batches of its own, so
    that the torques are computed on all cores too; a simulation's result does not depend on the
    batch it is in.

    Args:
      robot: the robot.
      recordings: what is replayed, each for exactly this robot.
      actuator: the torque law, `pd` or `nn_pd`.
      threads: batches that run at once, one core each.
      lead: time of each recording before clocks drift and motors warm, s.
    """

    def __init__(
        self,
        robot: RobotDescription,
        recordings: Sequence[Recording],
        actuator: str = "nn_pd",
        threads: int = 1,
        lead: float = 0.0,
    ) -> None:
        if actuator not in LAWS:
            raise InputError(f"actuator {actuator!r} is unknown; known: {', '.join(LAWS)}")
        for recording in recordings:
            recording.validate(robot)
        self.robot = robot
        self.recordings = tuple(recordings)
        self.law = LAWS[actuator]
        self.threads = threads
        self.lead = lead
        self.ticks = tick_slices(self.recordings)
        supports = sorted({r.support for r in self.recordings})
        self.groups = tuple(
            group_of(robot, self.recordings, support, self.ticks) for support in supports
        )

    @property
    def steps(self) -> int:
        """Sub-steps that one candidate costs."""
        return int(sum(group.running.sum() for group in self.groups))

    def replay(self, candidates: Candidates, push: Push | None = None) -> Trajectories:
        """See Simulator; `push` adds torques from outside."""
        n, ticks = len(candidates), self.ticks[-1].stop if self.ticks else 0
        out = Trajectories(
            self.ticks,
            np.full((n, ticks, len(self.robot.joints)), np.nan),
            np.full((n, ticks, 2), np.nan),
            np.full((n, ticks, len(self.robot.feet), 3), np.nan),
        )
        jobs = [(group, part) for group in self.groups for part in self._parts(group, n)]

        def run(job: tuple[Group, slice]) -> None:
            group, part = job
            pushed = None if push is None else push.of(part, group.members)
            self._run(group, candidates.rows(part), pushed).into(out, part)

        if self.threads == 1:
            for job in jobs:
                run(job)
        else:
            with ThreadPoolExecutor(self.threads) as pool:
                list(pool.map(run, jobs))
        return out

    def _run(self, group: Group, candidates: Candidates, push: Push | None) -> "Run":
        return Run(self.robot, group, candidates, self.law, push, self.lead)

    def _parts(self, group: Group, candidates: int) -> list[slice]:
        """The candidates in parts of one batch each, equally many parts for every thread."""
        together = SIMULATIONS
        if len(self.robot.joints) == 1:  # whose every sub-step is kept, see `loop`
            together = min(together, KEPT // len(group.running))
        most = max(1, together // len(group.setups))
        each = -(-candidates // (most * self.threads))
        parts = min(candidates, each * self.threads)
        edges = np.linspace(0, candidates, parts + 1).astype(int)
        return [slice(int(a), int(b)) for a, b in pairwise(edges)]


class Run:
    """One batch: the simulations stand recording by recording, candidate by candidate."""

    def __init__(
        self,
        robot: RobotDescription,
        group: Group,
        candidates: Candidates,
        law: Callable[[RobotDescription, Candidates], TorqueLaw],
        push: Push | None = None,
        lead: float = 0.0,
    ) -> None:
        self.robot = robot
        self.group = group
        self.candidates = len(candidates)
        nsim = len(group.setups) * self.candidates
        each = scaled(robot, candidates, group.setups)
        self.batch = mujoco.batch.Batch(group.model.compiled, nsim, 1)
        writer = FieldWriter(self.batch, group.model.compiled)
        bound = law(robot, each)
        outfit = fit_out(robot, group.model, bound, each, group.setups, writer, robot.timestep)
        writer.done()
        self.terms = outfit.terms
        delay = each["command_delay"] if "command_delay" in candidates else None
        self.servos = Servos(outfit, group.commands, group.power, delay, self.candidates, lead)
        self.push = None if push is None else Pushing(push, group.model, robot.timestep)
        self.ids = np.arange(nsim, dtype=np.int32)
        self.broken = np.zeros(nsim, dtype=bool)
        self.warned = self.batch.warning[:, _BROKEN, 1]
        self._start(nsim)
        self.joints = History(nsim, len(robot.joints), self._age("delay"))
        self.feet = [group.model.compiled.body(foot).id for foot in robot.feet]
        if group.model.floating:
            self.places = self.batch.bind("xpos")
            self.mount = mount(robot, group.model)
            self.torso = History(nsim, 4, self._age("tilt_delay"))

    def _age(self, hook: str) -> Array | None:
        """How old readings are, sub-steps; none is of long before the start, nor kept for it."""
        ages = longest(self.terms, hook)
        most = len(self.group.running)
        return None if ages is None else np.minimum(ages / self.robot.timestep, most)

    def _start(self, nsim: int) -> None:
        """Put the simulations where the recordings start."""
        self.qpos, self.qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self.qpos[:] = self._starting_qpos()
        velocity = np.repeat(self.group.start_velocity, self.candidates, axis=0)
        self.qvel[:, self.group.model.dofs] = velocity
        self.force, self.damping = self.batch.bind("qfrc_applied"), self.batch.expand("dof_damping")
        pushing = [term for term in self.terms if term.answers("push")]
        if pushing:
            wrenches = self.batch.bind("xfrc_applied")
            for term in pushing:
                term.push(wrenches)
        self.engine = OneJoint.of(self.batch) or self.batch
        self.acceleration = self.batch.bind("qacc")
        self.bias = self.batch.bind("qfrc_bias")
        sensed = self._begun(nsim)
        trains = [term for term in self.terms if isinstance(term, Drivetrain)]
        for train in trains:
            self._bend(train)
            sensed = self._begun(nsim, train.rows)
        if self.group.model.floating:
            resting = self.ids[np.repeat(self.group.rests, self.candidates)]
            if len(resting):
                sink(self.batch, resting)
        # Velocities stand half a sub-step before positions, see `simulator`.
        behind = self.batch.model.opt.timestep / 2 * self.acceleration
        for train in trains:
            behind[train.rows] = self._tried(train, sensed)
        self.qvel -= behind
        load = self._load(trains)
        for term in self.terms:
            term.prepare()
        holding = [term for term in self.terms if term.answers("held")]
        if not self.group.model.floating:  # on the floor, contacts hold too
            for term in holding:
                load = term.held(load, self._gravity())

    def _begun(self, nsim: int, rows: NDArray[np.int32] | None = None) -> tuple[Array, Array]:
        """What encoders tell at the start, with the first torques; accelerations of some rows."""
        model = self.group.model
        for term in self.terms:
            term.prepare()  # by the scene that the terms' model fields have changed
        sensed = self.servos.sense(self.qpos[:, model.qpos], self.qvel[:, model.dofs])
        self._drive(0, nsim, sensed)
        self.servos.begin()
        self.batch.forward(ids=rows)
        return sensed

    def _gravity(self) -> Array:
        """What joints need of torque that is on, N m."""
        on = np.repeat(self.group.power[0], self.candidates)[:, None]
        return np.asarray(on * self.bias[:, self.group.model.dofs])

    def _bend(self, train: Drivetrain) -> None:
        """Start motors that reach links through play or give where they hold these.

        Where contacts hold too, it is known of robots that rest: their servos tell it.
        """
        model = self.group.model
        rests = np.repeat(self.group.rests, self.candidates)[:, None]
        torque = np.where(rests, train.driven, 0.0) if model.floating else self._gravity()
        seen = train.bend(torque)
        position = self.qpos[:, model.qpos] - seen
        if not model.floating:
            self.qpos[:, model.qpos] = position
            return
        for row in np.flatnonzero(seen.any(axis=1)):
            self.qpos[row] = standing_qpos(self.robot, model, position[row], self.qpos[row, 3:7])

    def _load(self, trains: Sequence[Drivetrain]) -> Array:
        """What joints at rest need beside all torques told, N m; see Term.held."""
        dofs = self.group.model.dofs
        load = np.asarray(self.bias[:, dofs] - self.force[:, dofs])
        for train in trains:
            load -= train.short()
        return load

    def _tried(self, train: Drivetrain, sensed: tuple[Array, Array]) -> Array:
        """Half of the velocity that links gain in a first sub-step, which is then undone.

        What a motor that reaches its link through play or give does at once depends on both.
        """
        model, rows = self.group.model, train.rows
        position, velocity = self.qpos.copy(), self.qvel.copy()
        self._drive(0, len(self.ids), sensed, still=True)
        self.servos.begin()
        self._advance(rows)
        train.tried(self.qpos[:, model.qpos], self.qvel[:, model.dofs], velocity[:, model.dofs])
        gained = np.asarray((self.qvel - velocity)[rows] / 2)
        self.qpos[:], self.qvel[:] = position, velocity
        return gained

    def _starting_qpos(self) -> Array:
        """Where the simulations start; terms may say that it was not as it was read."""
        group, model = self.group, self.group.model
        qpos = np.repeat(group.start, self.candidates, axis=0)
        position = qpos[:, model.qpos].copy()
        torso = np.repeat(group.torso, self.candidates, axis=0)
        read = np.hstack([position, torso])
        for term in reversed(self.terms):
            term.start(position, torso)
        if not model.floating:
            qpos[:, model.qpos] = position
            return qpos
        was = np.hstack([position, torso])
        for row in np.flatnonzero(((was != read) & ~np.isnan(was)).any(axis=1)):
            qpos[row] = standing_qpos(self.robot, model, position[row], torso[row])
        return qpos

    def into(self, out: Trajectories, part: slice) -> None:
        """Run to the end and write the candidates' part of the trajectories."""
        alone = self.push is None
        loop = Loop.of(self.servos, self.engine, self.terms, self.group.running) if alone else None
        if loop is None:
            self._step_by_step(out, part)
        else:
            self._at_once(loop, out, part)

    def _at_once(self, loop: Loop, out: Trajectories, part: slice) -> None:
        """The same by a compiled loop, which leaves to MuJoCo what is beyond a joint's range."""
        n, steps = len(self.ids), len(self.group.running)
        sensed = self._sensed(n)
        loop.told[0] = sensed[0][:, 0]
        self._substep(0, n, sensed)
        lost = np.where(self._lost(), 0, steps)
        step = loop.move(1)
        while step < steps:
            active = self.ids[: int(self.group.running[step]) * self.candidates]
            self._advance(active[loop.engine.left[: len(active), 0]])
            lost = np.where(self._lost(), np.minimum(lost, step), lost)
            step = loop.move(step + 1)
        ticks = self.group.readings
        lanes = ticks.rows[:, None] * self.candidates + self.ids[: self.candidates]
        values = loop.read(ticks, lanes, self.joints.age)
        values[lost[lanes] <= ticks.step[:, None]] = np.nan
        out.position[part, ticks.ticks, 0] = values.T

    def _step_by_step(self, out: Trajectories, part: slice) -> None:
        observed: Event | None = None
        n = len(self.ids)
        for step, (running, event) in enumerate(
            zip(self.group.running, self.group.events, strict=True)
        ):
            sensed = self._sensed(n)
            if observed is not None:
                self._store(observed, out, part)
            n = int(running) * self.candidates
            self._substep(step, n, (sensed[0][:n], sensed[1][:n]))
            observed = event
            if event is not None and self.group.model.floating:
                self._store_feet(event, out, part)
        self._sensed(n)
        if observed is not None:
            self._store(observed, out, part)

    def _substep(self, step: int, n: int, sensed: tuple[Array, Array]) -> None:
        """Move the first simulations on by one sub-step."""
        self._drive(step, n, sensed)
        self._advance(None if n == len(self.ids) else self.ids[:n])

    def _sensed(self, n: int) -> tuple[Array, Array]:
        """What the first simulations' encoders tell at a sub-step, kept for the ticks around it."""
        model = self.group.model
        sensed = self.servos.sense(self.qpos[:n, model.qpos], self.qvel[:n, model.dofs])
        self.joints.push(sensed[0])
        if model.floating:
            self.torso.push(self.qpos[:n, 3:7])
        return sensed

    def _drive(self, step: int, n: int, sensed: tuple[Array, Array], still: bool = False) -> None:
        """Apply what reaches the links in one sub-step; see Servos.torque."""
        qpos, dofs = self.group.model.qpos, self.group.model.dofs
        link = self.qpos[:n, qpos], self.qvel[:n, dofs]
        told = self.servos.torque(step, link, sensed, still)
        self.force[:n, dofs], self.damping[:n, dofs] = told
        if self.push is not None:
            self.push.add(self.force, step, n)

    def _advance(self, ids: NDArray[np.int32] | None) -> None:
        try:
            self.engine.step(ids=ids)
        except mujoco.batch.SimulationError as error:
            self.broken[error.ids] = True
            self.batch.reset(ids=error.ids)

    def _store(self, event: Event, out: Trajectories, part: slice) -> None:
        """Write the ticks between the last two sub-steps."""
        rows, fraction = self._rows(event)
        _write(out.position, part, event, self._sound(rows, self.joints.read(rows, fraction)))
        if self.group.model.floating:
            torso = as_the_imu_tells(self.terms, self.torso.read(rows, fraction), rows)
            tilt = roll_pitch(multiply(torso, self.mount))
            _write(out.tilt, part, event, self._sound(rows, tilt))

    def _store_feet(self, event: Event, out: Trajectories, part: slice) -> None:
        """Write the feet's places: derived ones describe the state before a sub-step."""
        rows, _ = self._rows(event)
        _write(out.feet, part, event, self._sound(rows, self.places[rows][:, self.feet]))

    def _rows(self, event: Event) -> tuple[NDArray[np.int64], Array]:
        rows = (event.rows[:, None] * self.candidates + self.ids[: self.candidates]).ravel()
        return rows, event.fraction.repeat(self.candidates)[:, None]

    def _sound(self, rows: NDArray[np.int64], values: Array) -> Array:
        """The values, NaN for simulations that have broken down."""
        values[self._lost(rows)] = np.nan
        return values

    def _lost(self, rows: NDArray[np.int64] | slice = slice(None)) -> NDArray[np.bool_]:
        """Which of some simulations have broken down, or of all."""
        return np.asarray(self.broken[rows] | (self.warned[rows] > 0).any(axis=1))


def _write(to: Array, part: slice, event: Event, values: Array) -> None:
    rows = len(event.rows)
    shaped = values.reshape(rows, len(values) // rows, *values.shape[1:])  # of no feet too
    to[part, event.ticks] = shaped.swapaxes(0, 1)
