"""Our least squares against mujoco.sysid on one problem: the servos of a suspended robot.

Both fit stiffness, damping and torque limit per group and one armature to the suspended steps, from
the same start, between the same bounds, on the same residuals of positions at the ticks, in the
same engine at the same time step.

mujoco.sysid is used twice: as its documentation says, which the bar is about, and, harder, with its
optimisers on rollouts that we tuned (`sysid_rivals`). In a first round each of its optimisers is
tried; its default one, and the one that comes soonest near the lowest loss, then run in turn with
ours.

Losses are evaluated by our replay alone, afterwards, for all alike: half the sum of squared
position errors, of the best candidate of each call until then. "Same loss" means within 1 % of
where mujoco.sysid ends. Install what it needs by `pip install -c constraints.txt -e '.[bench]'`.
"""

import logging
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from mujoco import sysid

from benchmarks.paired import ROBOT, Cost, Report, parser, ratio, shipped
from pup.physics.parameters import robot_space
from pup.robot import RobotDescription
from pup.sysid.gauss_newton import Array, least_squares
from pup.sysid.problem import Problem

if not hasattr(sysid, "optimize"):
    sys.exit("mujoco.sysid lacks its dependencies: pip install -c constraints.txt -e '.[bench]'")

from benchmarks.sysid_rivals import DEFAULT, OPTIMISERS, Documented, Rival, Run, Trace, Tuned, fit

SAME = 1.01
FREE = ("kp", "kd", "tau_max", "armature")


@dataclass(frozen=True)
class Judged:
    """A fit by our replay: the loss where it ended, and the lowest one until each of its calls."""

    run: Run
    loss: float
    lowest: Array

    def reaches(self, loss: float) -> Cost:
        """When it comes to a loss, never where it does not."""
        calls = np.flatnonzero(self.lowest <= loss)
        never = Cost(float("inf"), float("inf"))
        return self.run.trace.seen[calls[0]].when if len(calls) else never

    def row(self) -> dict[str, object]:
        """What the report keeps of it."""
        seen = self.run.trace.seen
        return {
            "loss": self.loss,
            "end": asdict(self.run.end),
            "candidates": self.run.trace.candidates,
            "trace": [
                (s.when.wall, s.when.processor, low)
                for s, low in zip(seen, self.lowest.tolist(), strict=True)
            ],
        }

    def __str__(self) -> str:
        trace = self.run.trace
        return (
            f"{self.loss:.6f} in {self.run.end.wall:.1f} s ({self.run.end.processor:.1f} s of the "
            f"processor), {trace.candidates} candidates in {len(trace.seen)} calls"
        )


def main() -> None:
    given = parser(__doc__, rounds=3).parse_args()
    logging.getLogger("absl").setLevel(logging.ERROR)
    report = Report("least_squares", given.json)
    problem = _problem(given.threads)
    start = problem.free_space.normalise(problem.free_space.nominal)
    report.say(
        f"{len(problem.recordings)} recordings, {len(start)} parameters; "
        f"loss at the start {_losses(problem, start[None])[0]:.6f}"
    )
    for rival in (Documented(problem), Tuned(problem)):
        _compare(report, problem, rival, start, given.rounds)
    report.finish()


def _problem(threads: int) -> Problem:
    robot = RobotDescription.load(ROBOT)
    space = robot_space(robot, "pd")
    free = tuple(name for name in space.names if name.split("/")[0] in FREE)
    return Problem(robot, shipped(robot, "suspended", "step"), "pd", space, free, threads=threads)


def _compare(report: Report, problem: Problem, rival: Rival, start: Array, rounds: int) -> None:
    report.say(f"{rival.title}, a first round:")
    first = {name: _judge(problem, fit(rival, start, name)) for name in OPTIMISERS}
    for name, judged in first.items():
        report.say(f"  {name}: {judged}")
    begin = first[DEFAULT].run.trace.seen[0].loss
    report.say(f"  its own model's loss at the start: {begin:.6f}")
    near = SAME * min(judged.loss for judged in first.values())
    best = min(first, key=lambda name: first[name].reaches(near).wall)
    for name in dict.fromkeys((DEFAULT, best)):
        pairs = [
            (_judge(problem, _ours(problem, start)), _judge(problem, fit(rival, start, name)))
            for _ in range(rounds)
        ]
        report.say(f"ours over {rival.title}, {name}; median (range) of pairs:")
        _tell(report, f"{rival.title}, {name}", pairs)


def _tell(report: Report, key: str, pairs: Sequence[tuple[Judged, Judged]]) -> None:
    for ours, theirs in pairs:
        report.say(f"  ours: {ours}; theirs: {theirs}")
    goals = [SAME * theirs.loss for _, theirs in pairs]
    reached = [
        (a.reaches(goal), b.reaches(goal)) for (a, b), goal in zip(pairs, goals, strict=True)
    ]
    ended = [(a.run.end, b.run.end) for a, b in pairs]
    found: dict[str, object] = {"runs": [[one.row() for one in pair] for pair in pairs]}
    for name, costs in (("the same loss (bar 0.33)", reached), ("the end of the fit", ended)):
        wall = ratio([a.wall for a, _ in costs], [b.wall for _, b in costs])
        processor = ratio([a.processor for a, _ in costs], [b.processor for _, b in costs])
        report.say(f"  time to {name}: {wall} on the clock, {processor} of the processor")
        seconds = [f"{a.wall:.2f} s to {b.wall:.2f} s" for a, b in costs]
        report.say(f"    on the clock: {', '.join(seconds)}")
        found[name] = {"wall": asdict(wall), "processor": asdict(processor)}
    losses = ratio([a.loss for a, _ in pairs], [b.loss for _, b in pairs])
    report.say(f"  loss at the end (bar {SAME}): {losses}")
    report.add(key, {**found, "loss": asdict(losses)})


def _ours(problem: Problem, start: Array) -> Run:
    trace = Trace()

    def residuals(unit: Array) -> Array:
        values = _errors(problem, unit)
        trace.note(unit, values)
        return values

    best = least_squares(residuals, start).best
    return Run(best, trace.so_far(), trace)


def _judge(problem: Problem, run: Run) -> Judged:
    points = np.array([seen.point for seen in run.trace.seen])
    losses = _losses(problem, np.vstack([points, run.point]))
    return Judged(run, float(losses[-1]), np.minimum.accumulate(losses[:-1]))


def _losses(problem: Problem, unit: Array) -> Array:
    return np.asarray((_errors(problem, unit) ** 2).sum(axis=1) / 2)


def _errors(problem: Problem, unit: Array) -> Array:
    """Position errors by our replay, shape (n, n_residuals)."""
    position, _ = problem.loss.errors(problem.replay(unit))
    return position.reshape(len(unit), -1)


if __name__ == "__main__":
    main()
