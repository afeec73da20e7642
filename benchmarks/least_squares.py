"""Our least squares against mujoco.sysid on one problem: the servos of a suspended robot.

Both fit stiffness, damping and torque limit per group and one armature to the suspended steps, from
the same start, between the same bounds, on the same residuals of positions at the ticks, in the
same engine at the same time step. For mujoco.sysid the servo is MuJoCo's position actuator. It gets
what it may: parameters scaled to the unit cube, all rollouts of a call at once on all threads
(its own residual takes the recordings one after another), models written to instead of recompiled,
and of its optimisers the one that gets lowest here, found in a first round.

Losses are evaluated by our replay alone: half the sum of squared position errors. "Same loss" means
within 1 % of where mujoco.sysid ends. Needs the `sysid` extra of MuJoCo.
"""

import contextlib
import copy
import io
import logging
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np
from mujoco import sysid

from benchmarks.paired import ROBOT, Cost, Report, parser, ratio, shipped
from pup.physics.model import compile_model, starting_qpos
from pup.physics.parameters import robot_space
from pup.physics.simulator import schedule
from pup.robot import RobotDescription
from pup.sysid.gauss_newton import Array, least_squares
from pup.sysid.problem import Problem

SAME = 1.01
FREE = ("kp", "kd", "tau_max", "armature")
OPTIMISERS: dict[str, tuple[str, dict[str, Any]]] = {
    "mujoco": ("mujoco", {}),
    "mujoco, scaled by its Jacobian": ("mujoco", {"x_scale": "jac"}),
    "scipy": ("scipy", {}),
    "scipy, parallel differences": ("scipy_parallel_fd", {"x_scale": "jac"}),
}


@dataclass(frozen=True)
class Run:
    """One fit: where it ended, and the lowest loss among the candidates seen by when."""

    point: Array
    end: Cost
    candidates: int
    trace: list[tuple[Cost, float]]

    def reaches(self, loss: float) -> Cost:
        """When it comes to a loss, never where it does not."""
        never = Cost(float("inf"), float("inf"))
        return next((when for when, lowest in self.trace if lowest <= loss), never)


def main() -> None:
    options = parser(__doc__, rounds=3)
    given = options.parse_args()
    if not hasattr(sysid, "optimize"):
        sys.exit("mujoco.sysid lacks its dependencies: pip install 'mujoco[sysid]==4.0.0'")
    logging.getLogger("absl").setLevel(logging.ERROR)
    report = Report("least_squares", given.json)
    problem = _problem(given.threads)
    start = problem.free_space.normalise(problem.free_space.nominal)
    rollouts = _Rollouts(problem)
    report.say(
        f"{len(problem.recordings)} recordings, {len(start)} parameters; "
        f"loss at the start {_loss(problem, start):.6f}"
    )
    difference = np.abs(rollouts.residuals(start[None]) - _errors(problem, start[None])).max()
    report.say(f"largest difference of the two models there: {difference:.1e} rad")

    first = {name: rollouts.fit(start, name) for name in OPTIMISERS}
    for name, run in first.items():
        report.say(f"  mujoco.sysid, {name}: {_told(problem, run)}")
    best = min(first, key=lambda name: _loss(problem, first[name].point))
    pairs = [(_ours(problem, start), rollouts.fit(start, best)) for _ in range(given.rounds)]
    for ours, theirs in pairs:
        report.say(f"  ours: {_told(problem, ours)}; mujoco.sysid: {_told(problem, theirs)}")
    goals = [SAME * _loss(problem, theirs.point) for _, theirs in pairs]
    reached = [
        (a.reaches(goal), b.reaches(goal)) for (a, b), goal in zip(pairs, goals, strict=True)
    ]
    ended = [(a.end, b.end) for a, b in pairs]
    losses = ratio(
        [_loss(problem, a.point) for a, _ in pairs], [_loss(problem, b.point) for _, b in pairs]
    )
    report.say("ours over mujoco.sysid, median (range) of pairs:")
    for key, costs in (("same_loss", reached), ("end", ended)):
        wall = ratio([a.wall for a, _ in costs], [b.wall for _, b in costs])
        processor = ratio([a.processor for a, _ in costs], [b.processor for _, b in costs])
        to = {"same_loss": "to the same loss (bar 0.33)", "end": "to the end of the fit"}[key]
        report.say(f"  time {to}: {wall} on the clock, {processor} of the processor")
        report.add(f"time_to_{key}", {"wall": asdict(wall), "processor": asdict(processor)})
    report.say(f"  loss at the end (bar 1.01): {losses}")
    report.add("optimiser", best)
    report.add("loss", asdict(losses))
    report.add("runs", [[_row(problem, run) for run in pair] for pair in pairs])
    report.finish()


def _problem(threads: int) -> Problem:
    robot = RobotDescription.load(ROBOT)
    space = robot_space(robot, "pd")
    free = tuple(name for name in space.names if name.split("/")[0] in FREE)
    return Problem(robot, shipped(robot, "suspended", "step"), "pd", space, free, threads=threads)


def _errors(problem: Problem, unit: Array) -> Array:
    """Position errors by our replay, shape (n, n_residuals)."""
    position, _ = problem.loss.errors(problem.replay(unit))
    return position.reshape(len(unit), -1)


def _loss(problem: Problem, point: Array) -> float:
    return float((_errors(problem, point[None]) ** 2).sum() / 2)


class _Trace:
    """Residuals that write down how low they came, and by when."""

    def __init__(self, residuals: Callable[[Array], Array]) -> None:
        self.residuals = residuals
        self.begin = _now()
        self.lowest = np.inf
        self.candidates = 0
        self.points: list[tuple[Cost, float]] = []

    def __call__(self, unit: Array) -> Array:
        values = self.residuals(unit)
        self.candidates += len(unit)
        self.lowest = min(self.lowest, float((values**2).sum(axis=1).min() / 2))
        self.points.append((self._so_far(), self.lowest))
        return values

    def run(self, point: Array) -> Run:
        """The fit that ended at a point just now."""
        return Run(point, self._so_far(), self.candidates, self.points)

    def _so_far(self) -> Cost:
        now = _now()
        return Cost(now.wall - self.begin.wall, now.processor - self.begin.processor)


def _now() -> Cost:
    return Cost(time.perf_counter(), time.process_time())


def _ours(problem: Problem, start: Array) -> Run:
    trace = _Trace(lambda unit: _errors(problem, unit))
    return trace.run(least_squares(trace, start).best)


class _Rollouts:
    """The problem as mujoco.sysid takes it: position actuators and open-loop rollouts."""

    def __init__(self, problem: Problem) -> None:
        robot, recordings = problem.robot, problem.recordings
        self.problem = problem
        self.base = _with_servos(robot)
        names = {name: i for i, name in enumerate(problem.free)}
        self.kp, self.kd, self.limit = (
            np.array([names[f"{kind}/{robot.groups[g]}"] for g in robot.group_index])
            for kind in FREE[:3]
        )
        self.armature = names["armature"]
        plans = [schedule(r, robot.joint_names, robot.timestep) for r in recordings]
        longest = max(plan.steps for plan in plans)
        grid = np.arange(longest) * robot.timestep
        held = [np.searchsorted(plan.time, grid, "right") - 1 for plan in plans]
        self.control = np.stack([p.held[rows] for p, rows in zip(plans, held, strict=True)])
        model = compile_model(robot, "suspended")
        self.start = np.stack(
            [
                sysid.create_initial_state(self.base, starting_qpos(robot, model, plan.start, r))
                for plan, r in zip(plans, recordings, strict=True)
            ]
        )
        self.run = np.repeat(np.arange(len(plans)), [len(p.tick_step) for p in plans])
        self.step = np.concatenate([p.tick_step for p in plans])
        self.share = np.concatenate([p.tick_fraction for p in plans])[:, None]
        self.measured = problem.loss.position
        self.scratch = [mujoco.MjData(self.base) for _ in range(problem.threads)]
        self.pool = mujoco.rollout.Rollout(nthread=problem.threads)

    def fit(self, start: Array, optimiser: str) -> Run:
        """Fit by one of mujoco.sysid's optimisers."""
        trace = _Trace(self.residuals)
        parameters = sysid.ParameterDict()
        for name, value in zip(self.problem.free, start, strict=True):
            parameters.add(sysid.Parameter(name, value, 0.0, 1.0))

        def residual(unit: Array, _: object) -> tuple[list[Array], list[Any], list[Any]]:
            values = trace(np.atleast_2d(unit.T)).T
            return [values if unit.ndim == 2 else values[:, 0]], [], []

        name, settings = OPTIMISERS[optimiser]
        with contextlib.redirect_stdout(io.StringIO()):
            found, _ = sysid.optimize(parameters, residual, name, verbose=False, **settings)
        return trace.run(found.as_vector())

    def residuals(self, unit: Array) -> Array:
        """Position errors of candidates (n, n_parameters), shape (n, n_residuals)."""
        runs = len(self.control)
        models = [self._model(v) for v in self.problem.free_space.denormalise(unit)]
        start = np.tile(self.start, (len(unit), 1))
        states, _ = self.pool.rollout(
            [model for model in models for _ in range(runs)],
            self.scratch,
            start,
            np.tile(self.control, (len(unit), 1, 1)),
        )
        q = np.concatenate([start[:, None], states], axis=1)[..., 1 : 1 + self.base.nq]
        q = q.reshape(len(unit), runs, *q.shape[1:])
        before, after = q[:, self.run, self.step], q[:, self.run, self.step + 1]
        error = before + self.share * (after - before) - self.measured
        return np.asarray(np.nan_to_num(error).reshape(len(unit), -1))

    def _model(self, values: Array) -> mujoco.MjModel:
        model = copy.copy(self.base)
        model.actuator_gainprm[:, 0] = values[self.kp]
        model.actuator_biasprm[:, 1] = -values[self.kp]
        model.actuator_biasprm[:, 2] = -values[self.kd]
        model.actuator_forcerange[:] = values[self.limit][:, None] * (-1, 1)
        model.dof_armature[:] = values[self.armature]
        return model


def _with_servos(robot: RobotDescription) -> mujoco.MjModel:
    """The robot, suspended as in `compile_model`, with a position actuator in every joint."""
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
    return spec.compile()


def _row(problem: Problem, run: Run) -> dict[str, object]:
    return {
        "loss": _loss(problem, run.point),
        "end": asdict(run.end),
        "candidates": run.candidates,
        "trace": [(when.wall, when.processor, loss) for when, loss in run.trace],
    }


def _told(problem: Problem, run: Run) -> str:
    return f"{_loss(problem, run.point):.6f} in {run.end.wall:.1f} s, {run.candidates} candidates"


if __name__ == "__main__":
    main()
