"""Walking robots in MuJoCo batches: servos, floor and contacts, one control step at a time."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import TypeVar

import mujoco
import mujoco.batch
import numpy as np
from numpy.typing import NDArray

from pup.physics.actuators import LAWS
from pup.physics.limited import LimitedLaw
from pup.physics.live import LiveServos, has_terms, paced
from pup.physics.model import FLOOR, Model, compile_model, joint_inertia, lowest_point
from pup.physics.outfit import Outfit, fit_out
from pup.physics.parameters import Candidates
from pup.physics.writer import RowWriter
from pup.robot import RobotDescription

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
T = TypeVar("T")
P = TypeVar("P", bound="Pose")

FASTEST = 1e3
"""No joint or torso moves faster, m/s or rad/s: a simulation beyond it has broken down."""

_WARNINGS = [
    int(mujoco.mjtWarning.mjWARN_BADQPOS),
    int(mujoco.mjtWarning.mjWARN_BADQVEL),
    int(mujoco.mjtWarning.mjWARN_BADQACC),
]
_COUNT = 1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND)


@dataclass(frozen=True)
class Pose:
    """Where robots stand and what they read of it, a row per simulation.

    Attributes:
      root: the torso's place and orientation, shape (n, 7): m, and a quaternion (w, x, y, z).
      encoders: positions of the joints as they are read, shape (n, n_joints), rad.
      imu: orientation of the torso as it is read, less what the IMU's site adds, shape (n, 4).
    """

    root: Array
    encoders: Array
    imu: Array


@dataclass(frozen=True)
class Motion(Pose):
    """What a control step left, a row per simulation.

    Attributes:
      position: of the joints, shape (n, n_joints), rad.
      velocity: of the joints, rad/s.
      torque: of the servos over the last sub-step, N m.
      drift: velocity of the centre of mass, shape (n, 3), m/s; it and `touching` are of the state
        before the last sub-step.
      touching: whether anything touches but allowed bodies the floor, shape (n,).
      lost: whether the simulation broke down; the rest is then that of a robot at its origin.
    """

    position: Array
    velocity: Array
    torque: Array
    drift: Array
    touching: NDArray[np.bool_]
    lost: NDArray[np.bool_]


class Simulations:
    """n walking robots, each with parameters and a time step of its own.

    Terms among the parameters act as in a replay; a clock that commands come by acts on the
    time step.

    Each thread steps a batch of its own, so that the torques are computed on all cores too.

    Args:
      robot: has a free torso, a floor under it and a gait.
      largest: the robot's parameters, for the torque law `actuator`, one row: none that will come
        is larger.
      actuator: `nn_pd` or `pd`.
      n: simulations.
      substeps: per control step.
      period: shortest of a control step, s.
      threads: batches; None for as many as there are cores.
    """

    def __init__(
        self,
        robot: RobotDescription,
        largest: Candidates,
        actuator: str,
        n: int,
        substeps: int,
        period: float,
        threads: int | None = None,
    ) -> None:
        threads = min(n, threads or len(os.sched_getaffinity(0)))
        edges = np.linspace(0, n, threads + 1).astype(np.int64)
        self._edges = edges
        self._parts = [
            Part(robot, largest, actuator, int(b - a), substeps, period) for a, b in pairwise(edges)
        ]
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None

    def start(
        self, rows: Rows, candidates: Candidates, timestep: Array, qpos: Array, qvel: Array
    ) -> Pose:
        """Put some simulations into a state.

        Args:
          rows: which, ascending, shape (k,).
          candidates: their parameters, k rows.
          timestep: their sub-steps, shape (k,), s.
          qpos: their states by their encoders, shape (k, nq).
          qvel: shape (k, nv).

        Returns:
          How they stand, k rows.
        """
        at = np.searchsorted(rows, self._edges)

        def start(index: int) -> Pose:
            own = slice(at[index], at[index + 1])
            local = rows[own] - self._edges[index]
            values = Candidates(candidates.space, candidates.values[own])
            return self._parts[index].start(local, values, timestep[own], qpos[own], qvel[own])

        return _joined(self._each(start))

    def step(self, target: Array, running: NDArray[np.bool_]) -> Motion:
        """One control step of the running simulations.

        Args:
          target: of the joints, held for the step, shape (n, n_joints), rad.
          running: which of them step, shape (n,).
        """

        def advance(index: int) -> Motion:
            own = slice(self._edges[index], self._edges[index + 1])
            return self._parts[index].advance(target[own], running[own])

        return _joined(self._each(advance))

    def _each(self, act: Callable[[int], T]) -> list[T]:
        if self._pool is None:
            return [act(0)]
        return list(self._pool.map(act, range(len(self._parts))))

    def state(self) -> dict[str, Array]:
        """All that a simulation's future depends on beside its parameters."""
        states = [part.state() for part in self._parts]
        return {name: np.concatenate([state[name] for state in states]) for name in states[0]}

    def restore(self, state: dict[str, Array]) -> None:
        """Take up a state, after `start` has given all simulations their parameters."""
        for part, (a, b) in zip(self._parts, pairwise(self._edges), strict=True):
            part.restore({name: values[a:b] for name, values in state.items()})


def _joined(parts: list[P]) -> P:
    """Rows of all parts."""
    if len(parts) == 1:
        return parts[0]
    names = [field.name for field in fields(parts[0])]
    return type(parts[0])(
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    )


class Part:
    """One batch."""

    def __init__(
        self,
        robot: RobotDescription,
        largest: Candidates,
        actuator: str,
        n: int,
        substeps: int,
        period: float,
    ) -> None:
        self.robot = robot
        self.substeps = substeps
        self.model = compile_model(robot, "ground", _sense)
        self.batch = mujoco.batch.Batch(self.model.compiled, n, 1)
        self.make = LAWS[actuator]
        candidates = Candidates(largest.space, np.repeat(largest.values, n, axis=0))
        law = self.make(robot, candidates)
        self.live: LiveServos | None = None
        if has_terms(largest.space):
            self.live = LiveServos(robot, self.model, law, candidates, period, substeps)
            self.limited = self.live.servos.limited
        else:
            inertia = joint_inertia(self.model, law.armature, (n, len(robot.joints)))
            self.limited = LimitedLaw(law, inertia, np.zeros_like(inertia), period / substeps)
        self.setups = (robot.setup({}),)
        self.qpos, self.qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self.force, self.damping = self.batch.bind("qfrc_applied"), self.batch.expand("dof_damping")
        self.sensed, self.contacts = self.batch.bind("sensordata"), self.batch.bind("ncon")
        self.wrenches = None
        if self.live is not None and any(term.answers("push") for term in self.live.terms):
            self.wrenches = self.batch.bind("xfrc_applied")

    def start(
        self, rows: Rows, candidates: Candidates, timestep: Array, qpos: Array, qvel: Array
    ) -> Pose:
        """See Simulations.start."""
        if not len(rows):
            return self._pose(rows)
        ids, model = rows.astype(np.int32), self.model
        self.batch.reset(ids=ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        writer = RowWriter(self.batch, model.compiled, ids)
        law = self.make(self.robot, candidates)
        outfit = fit_out(
            self.robot, model, law, candidates, self.setups, writer, timestep[:, None].copy(), True
        )
        paced(outfit.terms, outfit.scene)
        writer.field("opt.timestep")[:] = np.asarray(outfit.scene.timestep)[:, 0]
        writer.done()
        qpos = self._as_it_stands(ids, outfit, qpos)
        self.qpos[rows], self.qvel[rows] = qpos, qvel
        if self.live is None:
            scene = outfit.scene
            self.limited.renew(rows, law, scene.inertia, outfit.viscous, scene.timestep)
            self.limited.forget(rows, qvel[:, model.dofs])
        else:
            link = qpos[:, model.qpos], qvel[:, model.dofs]
            self._push(ids, outfit)
            self.live.start(rows, outfit, candidates, link, qpos[:, 3:7])
        return self._pose(rows)

    def _as_it_stands(self, ids: NDArray[np.int32], outfit: Outfit, qpos: Array) -> Array:
        """States where encoders read the given ones; the torso is set on the floor again."""
        model = self.model
        position, unread = qpos[:, model.qpos].copy(), np.full((len(qpos), 4), np.nan)
        for term in reversed(outfit.terms):
            term.start(position, unread)
        off = np.flatnonzero((position != qpos[:, model.qpos]).any(axis=1))
        if not len(off):
            return qpos
        qpos, ids = qpos.copy(), ids[off]
        qpos[:, model.qpos] = position
        self.qpos[ids] = qpos[off]
        self.batch.forward(ids=ids, stage=mujoco.mjtStage.mjSTAGE_POS)
        places, axes = self.batch.bind("geom_xpos"), self.batch.bind("geom_xmat")
        qpos[off, 2] -= lowest_point(model.compiled, places[ids], axes[ids])
        return qpos

    def _push(self, ids: NDArray[np.int32], outfit: Outfit) -> None:
        """Apply the terms' wrenches."""
        if self.wrenches is not None:
            wrenches = np.zeros_like(self.wrenches[ids])
            for term in outfit.terms:
                if term.answers("push"):
                    term.push(wrenches)
            self.wrenches[ids] = wrenches

    def _pose(self, rows: Rows) -> Pose:
        root = self.qpos[rows, :7]
        if self.live is None:
            return Pose(root, self.qpos[rows][:, self.model.qpos], root[:, 3:])
        return Pose(root, self.live.encoders(rows), self.live.imu(root[:, 3:], rows))

    def _answer(self, target: Array) -> tuple[Array, Array]:
        """Torques and viscous coefficients of one sub-step."""
        link = self.qpos[:, self.model.qpos], self.qvel[:, self.model.dofs]
        if self.live is None:
            return self.limited.torque(target - link[0], link[1])
        return self.live.torque(link)

    def advance(self, target: Array, running: NDArray[np.bool_]) -> Motion:
        """See Simulations.step."""
        dofs, live = self.model.dofs, self.live
        ids = None if running.all() else np.flatnonzero(running).astype(np.int32)
        told = self.batch.warning[:, _WARNINGS, 1].sum(axis=1)
        broken = np.zeros(len(target), dtype=bool)
        if ids is None or len(ids):
            with np.errstate(invalid="ignore", over="ignore"):  # of those that break down
                if live is not None:
                    live.tell(target)
                for _ in range(self.substeps):
                    self.force[:, dofs], self.damping[:, dofs] = self._answer(target)
                    try:
                        self.batch.step(ids=ids)
                    except mujoco.batch.SimulationError as error:
                        broken[error.ids] = True
                        self.batch.reset(ids=error.ids)
                    if live is not None:
                        link = self.qpos[:, self.model.qpos], self.qvel[:, dofs]
                        live.moved(link, self.qpos[:, 3:7])
        told = self.batch.warning[:, _WARNINGS, 1].sum(axis=1) - told
        lost = broken | (told > 0) | ~(np.abs(self.qvel).max(axis=1) < FASTEST)
        if lost.any():
            self.batch.reset(ids=np.flatnonzero(lost).astype(np.int32))
        position, velocity = self.qpos[:, self.model.qpos].copy(), self.qvel[:, dofs].copy()
        pose = Pose(root := self.qpos[:, :7].copy(), position, root[:, 3:])
        if live is not None:
            pose = self._pose(np.arange(len(target)))
        allowed = self.sensed[:, 3:].sum(axis=1)
        return Motion(
            root=pose.root,
            encoders=pose.encoders,
            imu=pose.imu,
            position=position,
            velocity=velocity,
            torque=self.limited.acted(velocity if live is None else live.velocity),
            drift=self.sensed[:, :3].copy(),
            touching=self.contacts > allowed,
            lost=lost,
        )

    def state(self) -> dict[str, Array]:
        """See Simulations.state."""
        state = {"physics": self.batch.state.copy(), **self.limited.state()}
        if self.live is not None:
            state |= self.live.state()
        return state

    def restore(self, state: dict[str, Array]) -> None:
        """See Simulations.restore."""
        self.batch.state[:] = state["physics"]
        self.limited.restore(state)
        if self.live is not None:
            self.live.restore(state)


def _sense(robot: RobotDescription, spec: mujoco.MjSpec) -> None:
    """Sensors for the centre of mass's velocity, then for the contacts of each allowed body."""
    sense_drift(robot, spec)
    assert robot.gait is not None
    for body in robot.gait.ground_bodies:
        spec.add_sensor(
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            objname=body,
            reftype=mujoco.mjtObj.mjOBJ_GEOM,
            refname=FLOOR,
            intprm=[_COUNT, 0, 1],
        )


def may_touch(robot: RobotDescription, model: Model) -> NDArray[np.bool_]:
    """Which geoms may touch which, shape (n_geoms, n_geoms): the floor and allowed bodies'."""
    assert robot.gait is not None
    compiled = model.compiled
    bodies = [compiled.body(name).id for name in robot.gait.ground_bodies]
    floor = np.arange(compiled.ngeom) == compiled.geom(FLOOR).id
    pairs = np.outer(np.isin(compiled.geom_bodyid, bodies), floor)
    return np.asarray(pairs | pairs.T)


def sense_drift(robot: RobotDescription, spec: mujoco.MjSpec) -> None:
    """Extend a model by a sensor for the velocity of the centre of mass."""
    spec.add_sensor(
        type=mujoco.mjtSensor.mjSENS_SUBTREELINVEL,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        objname=robot.torso,
    )
