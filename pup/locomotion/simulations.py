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
from pup.physics.fields import apply_fields
from pup.physics.limited import LimitedLaw
from pup.physics.model import FLOOR, compile_model, joint_inertia
from pup.physics.parameters import Candidates
from pup.physics.writer import RowWriter
from pup.robot import RobotDescription

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
T = TypeVar("T")

FASTEST = 1e3
"""No joint or torso moves faster, m/s or rad/s: a simulation beyond it has broken down."""

_WARNINGS = [
    int(mujoco.mjtWarning.mjWARN_BADQPOS),
    int(mujoco.mjtWarning.mjWARN_BADQVEL),
    int(mujoco.mjtWarning.mjWARN_BADQACC),
]
_COUNT = 1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND)


@dataclass(frozen=True)
class Motion:
    """What a control step left, a row per simulation.

    Attributes:
      position: of the joints, shape (n, n_joints), rad.
      velocity: of the joints, rad/s.
      torque: of the servos over the last sub-step, N m.
      root: the torso's place and orientation, shape (n, 7): m, and a quaternion (w, x, y, z).
      drift: velocity of the centre of mass, shape (n, 3), m/s; it and `touching` are of the state
        before the last sub-step.
      touching: whether anything touches but allowed bodies the floor, shape (n,).
      lost: whether the simulation broke down; the rest is then that of a robot at its origin.
    """

    position: Array
    velocity: Array
    torque: Array
    root: Array
    drift: Array
    touching: NDArray[np.bool_]
    lost: NDArray[np.bool_]


class Simulations:
    """n walking robots, each with parameters and a time step of its own.

    Each thread steps a batch of its own, so that the torques are computed on all cores too.

    Args:
      robot: has a free torso, a floor under it and a gait.
      nominal: the robot's parameters, for the torque law `actuator`; one row.
      actuator: `nn_pd` or `pd`.
      n: simulations.
      substeps: per control step.
      threads: batches; None for as many as there are cores.
    """

    def __init__(
        self,
        robot: RobotDescription,
        nominal: Candidates,
        actuator: str,
        n: int,
        substeps: int,
        threads: int | None = None,
    ) -> None:
        threads = min(n, threads or len(os.sched_getaffinity(0)))
        edges = np.linspace(0, n, threads + 1).astype(np.int64)
        self._edges = edges
        self._parts = [
            _Part(robot, nominal, actuator, int(b - a), substeps) for a, b in pairwise(edges)
        ]
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None

    def start(
        self, rows: Rows, candidates: Candidates, timestep: Array, qpos: Array, qvel: Array
    ) -> None:
        """Put some simulations into a state.

        Args:
          rows: which, ascending, shape (k,).
          candidates: their parameters, k rows.
          timestep: their sub-steps, shape (k,), s.
          qpos: their states, shape (k, nq).
          qvel: shape (k, nv).
        """
        at = np.searchsorted(rows, self._edges)

        def start(index: int) -> None:
            own = slice(at[index], at[index + 1])
            if own.start < own.stop:
                local = rows[own] - self._edges[index]
                values = Candidates(candidates.space, candidates.values[own])
                self._parts[index].start(local, values, timestep[own], qpos[own], qvel[own])

        self._each(start)

    def step(self, target: Array, running: NDArray[np.bool_]) -> Motion:
        """One control step of the running simulations.

        Args:
          target: of the joints, held for the step, shape (n, n_joints), rad.
          running: which of them step, shape (n,).
        """

        def advance(index: int) -> Motion:
            own = slice(self._edges[index], self._edges[index + 1])
            return self._parts[index].advance(target[own], running[own])

        motions = self._each(advance)
        if len(motions) == 1:
            return motions[0]
        joined = {
            field.name: np.concatenate([getattr(motion, field.name) for motion in motions])
            for field in fields(Motion)
        }
        return Motion(**joined)

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


class _Part:
    """One batch."""

    def __init__(
        self,
        robot: RobotDescription,
        nominal: Candidates,
        actuator: str,
        n: int,
        substeps: int,
    ) -> None:
        self.robot = robot
        self.substeps = substeps
        self.model = compile_model(robot, "ground", _sense)
        self.batch = mujoco.batch.Batch(self.model.compiled, n, 1)
        self.make = LAWS[actuator]
        values = np.repeat(nominal.values, n, axis=0)
        law = self.make(robot, nominal.space.candidates(values))
        shape = n, len(robot.joints)
        inertia = joint_inertia(self.model, law.armature, shape).copy()
        timestep = np.full((n, 1), robot.timestep)
        self.limited = LimitedLaw(law, inertia, np.zeros(shape), timestep)
        self.setups = (robot.setup({}),)
        self.qpos, self.qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self.force, self.damping = self.batch.bind("qfrc_applied"), self.batch.expand("dof_damping")
        self.sensed, self.contacts = self.batch.bind("sensordata"), self.batch.bind("ncon")

    def start(
        self, rows: Rows, candidates: Candidates, timestep: Array, qpos: Array, qvel: Array
    ) -> None:
        """See Simulations.start."""
        limited, ids = self.limited, rows.astype(np.int32)
        fresh = self.make(self.robot, candidates)
        limited.law.renew(rows, fresh)
        shape = len(rows), len(self.robot.joints)
        limited.inertia[rows] = joint_inertia(self.model, fresh.armature, shape)
        self.batch.reset(ids=ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        writer = RowWriter(self.batch, self.model.compiled, ids)
        limited.viscous[rows] = fresh.passive + apply_fields(
            writer, self.robot, self.model, candidates, self.setups, fresh.armature
        )
        limited.timestep[rows] = timestep[:, None]
        writer.field("opt.timestep")[:] = timestep
        writer.done()
        self.qpos[rows], self.qvel[rows] = qpos, qvel
        limited.derive()
        limited.forget(rows, qvel[:, self.model.dofs])

    def advance(self, target: Array, running: NDArray[np.bool_]) -> Motion:
        """See Simulations.step."""
        position = self.qpos[:, self.model.qpos]
        velocity = self.qvel[:, self.model.dofs]
        ids = None if running.all() else np.flatnonzero(running).astype(np.int32)
        told = self.batch.warning[:, _WARNINGS, 1].sum(axis=1)
        broken = np.zeros(len(target), dtype=bool)
        if ids is None or len(ids):
            with np.errstate(invalid="ignore", over="ignore"):  # of those that break down
                for _ in range(self.substeps):
                    position = self.qpos[:, self.model.qpos]
                    velocity = self.qvel[:, self.model.dofs]
                    answer = self.limited.torque(target - position, velocity)
                    self.force[:, self.model.dofs], self.damping[:, self.model.dofs] = answer
                    try:
                        self.batch.step(ids=ids)
                    except mujoco.batch.SimulationError as error:
                        broken[error.ids] = True
                        self.batch.reset(ids=error.ids)
        told = self.batch.warning[:, _WARNINGS, 1].sum(axis=1) - told
        lost = broken | (told > 0) | ~(np.abs(self.qvel).max(axis=1) < FASTEST)
        if lost.any():
            self.batch.reset(ids=np.flatnonzero(lost).astype(np.int32))
        velocity = self.qvel[:, self.model.dofs].copy()
        allowed = self.sensed[:, 3:].sum(axis=1)
        return Motion(
            position=self.qpos[:, self.model.qpos].copy(),
            velocity=velocity,
            torque=self.limited.acted(velocity),
            root=self.qpos[:, :7].copy(),
            drift=self.sensed[:, :3].copy(),
            touching=self.contacts > allowed,
            lost=lost,
        )

    def state(self) -> dict[str, Array]:
        """See Simulations.state."""
        return {"physics": self.batch.state.copy(), **self.limited.state()}

    def restore(self, state: dict[str, Array]) -> None:
        """See Simulations.restore."""
        self.batch.state[:] = state["physics"]
        self.limited.restore(state)


def _sense(robot: RobotDescription, spec: mujoco.MjSpec) -> None:
    """Sensors for the centre of mass's velocity, then for the contacts of each allowed body."""
    assert robot.gait is not None and robot.torso is not None
    spec.add_sensor(
        type=mujoco.mjtSensor.mjSENS_SUBTREELINVEL,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        objname=robot.torso,
    )
    for body in robot.gait.ground_bodies:
        spec.add_sensor(
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            objname=body,
            reftype=mujoco.mjtObj.mjOBJ_GEOM,
            refname=FLOOR,
            intprm=[_COUNT, 0, 1],
        )
