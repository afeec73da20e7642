"""mujoco.sysid on a suspended robot's PD problem, as its documentation says and tuned by hand.

In both a servo is MuJoCo's position actuator, told in each sub-step the mean of what our replay
tells it, and the residuals are the errors of joint positions at the ticks.
"""

import contextlib
import copy
import io
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import mujoco
import mujoco.rollout
import numpy as np
from mujoco import sysid
from numpy.typing import NDArray

from benchmarks.paired import Cost
from pup.physics.commands import Commands
from pup.physics.model import compile_model, starting_qpos
from pup.physics.simulator import Schedule, schedule
from pup.recording import Recording
from pup.robot import RobotDescription
from pup.sysid.problem import Problem

Array = NDArray[np.float64]
Residual = Callable[[Array, sysid.ParameterDict], tuple[list[Array], list[Any], list[Any]]]

DEFAULT = "its default optimiser"
OPTIMISERS: dict[str, tuple[str, dict[str, Any]]] = {
    DEFAULT: ("mujoco", {}),
    "its default optimiser, scaled": ("mujoco", {"x_scale": "jac"}),
    "scipy": ("scipy", {"x_scale": "jac"}),
    "scipy, parallel differences": ("scipy_parallel_fd", {"x_scale": "jac"}),
}


def _now() -> Cost:
    return Cost(time.perf_counter(), time.process_time())


@dataclass(frozen=True)
class Seen:
    """The best candidate of one call: when it was known, where, and its loss by its own model."""

    when: Cost
    point: Array
    loss: float


@dataclass
class Trace:
    """What a fit sees from its beginning on; points are of the unit cube.

    Attributes:
      seen: the best of each call.
      candidates: how many there were in all.
      begin: when it began.
    """

    seen: list[Seen] = field(default_factory=list)
    candidates: int = 0
    begin: Cost = field(default_factory=_now)

    def note(self, unit: Array, residuals: Array) -> None:
        """Residuals (n, n_residuals) of candidates (n, n_parameters), just computed."""
        losses = (residuals**2).sum(axis=1) / 2
        best = int(losses.argmin())
        self.candidates += len(unit)
        self.seen.append(Seen(self.so_far(), unit[best].copy(), float(losses[best])))

    def so_far(self) -> Cost:
        """What it took until now."""
        now = _now()
        return Cost(now.wall - self.begin.wall, now.processor - self.begin.processor)


@dataclass(frozen=True)
class Run:
    """One fit: where it ended, when, and what it had seen by then."""

    point: Array
    end: Cost
    trace: Trace


class Rival(Protocol):
    """One way to use mujoco.sysid."""

    title: str

    def parameters(self, start: Array) -> sysid.ParameterDict:
        """The free parameters, starting from a point on the unit cube."""
        ...

    def unit(self, x: Array) -> Array:
        """Values of those parameters (n, n_parameters) as points on the unit cube."""
        ...

    def residual(
        self, x: Array, parameters: sysid.ParameterDict
    ) -> tuple[list[Array], list[Any], list[Any]]:
        """What `sysid.optimize` takes; x is one candidate or (n_parameters, n)."""
        ...


def fit(rival: Rival, start: Array, optimiser: str) -> Run:
    """Fit by one of mujoco.sysid's optimisers."""
    name, settings = OPTIMISERS[optimiser]
    trace = Trace()

    def residual(x: Array, parameters: sysid.ParameterDict) -> tuple[list[Array], Any, Any]:
        told = rival.residual(x, parameters)
        trace.note(rival.unit(np.atleast_2d(x.T)), np.atleast_2d(np.concatenate(told[0]).T))
        return told

    with contextlib.redirect_stdout(io.StringIO()):
        found, _ = sysid.optimize(rival.parameters(start), residual, name, **settings)
    return Run(rival.unit(found.as_vector()[None])[0], trace.so_far(), trace)


class Documented:
    """As the README of mujoco.sysid has it: each stage is its own.

    Modifiers write to the spec, `ModelSequences` holds the recordings, the residual compiles and
    rolls out, all columns of a Jacobian at once on all threads. The residual is taken as it is, not
    divided by each joint's root mean square, so that it is the same loss.
    """

    title = "mujoco.sysid as documented"

    def __init__(self, problem: Problem) -> None:
        robot, recordings = problem.robot, problem.recordings
        self.robot = robot
        self.space = problem.free_space
        spec = _spec(robot)
        model = spec.compile()
        plans = [schedule(r, robot.joint_names, robot.timestep) for r in recordings]
        states = zip(plans, recordings, strict=True)
        data = zip(plans, problem.loss.ticks, strict=True)
        sequences = sysid.ModelSequences(
            name=robot.name,
            spec=spec,
            sequence_name=[r.id for r in recordings],
            initial_state=[_state(robot, model, plan, r) for plan, r in states],
            control=[_control(plan, model) for plan in plans],
            sensordata=[
                # Sensors tell the state before a step, and count as of the time after it.
                sysid.TimeSeries.from_names(
                    plan.time + robot.timestep, problem.loss.position[part], model
                )
                for plan, part in data
            ],
        )
        self.residual = sysid.build_residual_fn(
            models_sequences=[sequences],
            modify_residual=sysid.SignalTransform(normalize=False).apply,
            n_threads=problem.threads,
        )

    def parameters(self, start: Array) -> sysid.ParameterDict:
        """See Rival: in physical units."""
        space = self.space
        parameters = sysid.ParameterDict()
        for name, value, lower, upper in zip(
            space.names, space.denormalise(start), space.lower, space.upper, strict=True
        ):
            modifier = self._modifier(*name.split("/"))
            parameters.add(sysid.Parameter(name, value, lower, upper, modifier=modifier))
        return parameters

    def unit(self, x: Array) -> Array:
        """See Rival."""
        return self.space.normalise(x)

    def _modifier(self, kind: str, group: str | None = None) -> sysid.parameter.ModifierFn:
        joints = [j.name for j in self.robot.joints if group in (None, j.group)]
        write = _WRITERS[kind]

        def modifier(spec: mujoco.MjSpec, parameter: sysid.Parameter) -> None:
            for joint in joints:
                write(spec, joint, parameter.value[0])

        return modifier


def _write_limit(spec: mujoco.MjSpec, joint: str, value: float) -> None:
    spec.actuator(joint).forcerange = [-value, value]


def _write_armature(spec: mujoco.MjSpec, joint: str, value: float) -> None:
    spec.joint(joint).armature = value


_WRITERS: dict[str, Callable[[mujoco.MjSpec, str, float], object]] = {
    "kp": sysid.apply_pgain,
    "kd": sysid.apply_dgain,
    "tau_max": _write_limit,
    "armature": _write_armature,
}


class Tuned:
    """Its optimisers on residuals of our own making, which leave nothing undone twice.

    Parameters are scaled to the unit cube, models are written to instead of compiled, and all
    recordings of all candidates of a call roll out at once on all threads; its own residual takes
    one recording after another.
    """

    title = "mujoco.sysid's optimisers on tuned rollouts"

    def __init__(self, problem: Problem) -> None:
        robot, recordings = problem.robot, problem.recordings
        self.names = problem.free
        self.space = problem.free_space
        self.model = _spec(robot).compile()
        columns = {name: i for i, name in enumerate(problem.free)}
        self.kp, self.kd, self.limit = (
            np.array([columns[f"{kind}/{robot.groups[g]}"] for g in robot.group_index])
            for kind in ("kp", "kd", "tau_max")
        )
        self.armature = columns["armature"]
        plans = [schedule(r, robot.joint_names, robot.timestep) for r in recordings]
        longest = max(plan.steps for plan in plans)
        self.control = np.stack([_commands(plan, robot.timestep, longest) for plan in plans])
        self.start = np.stack(
            [_state(robot, self.model, p, r) for p, r in zip(plans, recordings, strict=True)]
        )
        self.run = np.repeat(np.arange(len(plans)), [len(p.tick_step) for p in plans])
        self.step = np.concatenate([p.tick_step for p in plans])
        self.share = np.concatenate([p.tick_fraction for p in plans])[:, None]
        self.measured = problem.loss.position
        self.scratch = [mujoco.MjData(self.model) for _ in range(problem.threads)]
        self.pool = mujoco.rollout.Rollout(nthread=problem.threads)

    def parameters(self, start: Array) -> sysid.ParameterDict:
        """See Rival."""
        parameters = sysid.ParameterDict()
        for name, value in zip(self.names, start, strict=True):
            parameters.add(sysid.Parameter(name, value, 0.0, 1.0))
        return parameters

    def unit(self, x: Array) -> Array:
        """See Rival."""
        return x

    def residual(
        self, x: Array, parameters: sysid.ParameterDict
    ) -> tuple[list[Array], list[Any], list[Any]]:
        """See Rival."""
        values = self._errors(np.atleast_2d(x.T)).T
        return [values if x.ndim == 2 else values[:, 0]], [], []

    def _errors(self, unit: Array) -> Array:
        """Position errors of candidates (n, n_parameters), shape (n, n_residuals)."""
        runs = len(self.control)
        models = [self._with(v) for v in self.space.denormalise(unit)]
        start = np.tile(self.start, (len(unit), 1))
        states, _ = self.pool.rollout(
            [model for model in models for _ in range(runs)],
            self.scratch,
            start,
            np.tile(self.control, (len(unit), 1, 1)),
        )
        q = np.concatenate([start[:, None], states], axis=1)[..., 1 : 1 + self.model.nq]
        q = q.reshape(len(unit), runs, *q.shape[1:])
        before, after = q[:, self.run, self.step], q[:, self.run, self.step + 1]
        error = before + self.share * (after - before) - self.measured
        return np.asarray(np.nan_to_num(error).reshape(len(unit), -1))

    def _with(self, values: Array) -> mujoco.MjModel:
        model = copy.copy(self.model)
        model.actuator_gainprm[:, 0] = values[self.kp]
        model.actuator_biasprm[:, 1] = -values[self.kp]
        model.actuator_biasprm[:, 2] = -values[self.kd]
        model.actuator_forcerange[:] = values[self.limit][:, None] * (-1, 1)
        model.dof_armature[:] = values[self.armature]
        return model


def _spec(robot: RobotDescription) -> mujoco.MjSpec:
    """The robot, suspended as in `compile_model`, with a servo and a position sensor per joint."""
    spec = mujoco.MjSpec.from_file(str(robot.model_path))
    for joint in [j for j in spec.joints if j.type == mujoco.mjtJoint.mjJNT_FREE]:
        spec.delete(joint)
    spec.option.timestep = robot.timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    for name in robot.joint_names:
        servo = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_position(kp=1.0, kv=1.0)
        servo.forcelimited, servo.forcerange = True, [-1.0, 1.0]
        spec.add_sensor(
            name=f"{name}_pos",
            type=mujoco.mjtSensor.mjSENS_JOINTPOS,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=name,
        )
    return spec


def _state(
    robot: RobotDescription, model: mujoco.MjModel, plan: Schedule, recording: Recording
) -> Array:
    """Where a recording starts."""
    position = starting_qpos(robot, compile_model(robot, "suspended"), plan.start, recording)
    return sysid.create_initial_state(model, position, plan.start_velocity)


def _control(plan: Schedule, model: mujoco.MjModel) -> sysid.TimeSeries:
    """Commands on the grid of sub-steps; one more for what sensors tell, and one not simulated."""
    timestep = model.opt.timestep
    commands = _commands(plan, timestep, plan.steps + 2)
    return sysid.TimeSeries.from_control_names(np.arange(len(commands)) * timestep, commands, model)


def _commands(plan: Schedule, timestep: float, steps: int) -> Array:
    """Mean target of each sub-step, the last ones repeated, shape (steps, n_joints)."""
    commands = Commands([plan], timestep)
    rows = []
    for step in range(plan.steps):
        target = commands.on_time(step, 1)
        before = target.now if target.before is None else target.before
        rows.append((target.share * target.now + (1 - target.share) * before).ravel())
    return np.stack(rows + rows[-1:] * (steps - plan.steps))
