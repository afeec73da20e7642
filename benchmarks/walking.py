"""Env-steps per second of the walking task, against its physics through the same motion.

Three things go through the same episodes of random actions, falls and resets among them: the whole
task; its simulations alone, which are the engine with the torque law; and the engine alone, with
the law's torques known beforehand. An env-step is a control step of one robot that is not a reset.
Beside them the task of a corrected robot, with four effects, goes through the same actions.
"""

from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.paired import ROBOT, Report, in_turn, parser, ratio
from pup.locomotion.sampling import ParameterSampler
from pup.locomotion.settings import TaskSettings
from pup.locomotion.simulations import Simulations
from pup.locomotion.task import WalkingTask
from pup.robot import RobotDescription, TermSpec
from pup.sysid.result import read_bounds

SIZES = (64, 256, 1024)
FOUND = (
    TermSpec("backlash", "joint", "l_knee", {"gap": 0.006}),
    TermSpec("stribeck_friction", "group", "ankle", {"torque": 0.05, "rest": 0.06, "speed": 0.5}),
    TermSpec("command_delay", "bus", "", {"time": 0.012}),
    TermSpec("voltage_sag", "bus", "", {"drop": 0.03}),
)
"""Effects of typical sizes."""


def main() -> None:
    options = parser(__doc__, rounds=7)
    options.add_argument("--steps", type=int, default=40, help="control steps (default: 40)")
    given = options.parse_args()
    report = Report("walking", given.json)
    report.say("env-steps/s; ratios of processor time, median (range) of pairs; bar 0.80")
    rows = [_row(n, given.threads, given.steps, given.rounds) for n in SIZES]
    for row in rows:
        report.say(
            f"  {row['robots']:>4} robots: task {row['task']:,.0f} on the clock, "
            f"{row['task_per_core']:,.0f} per core; engine {row['engine_per_core']:,.0f} per core; "
            f"engine and law over task {_told(row['law_share'])}, engine over task "
            f"{_told(row['engine_share'])}; task with {len(FOUND)} effects over task, an env-step, "
            f"{_told(row['effects_share'])}"
        )
    report.add("rows", rows)
    report.finish()


def _row(n: int, threads: int, steps: int, rounds: int) -> dict[str, Any]:
    robot = RobotDescription.load(ROBOT)
    sampler = ParameterSampler(read_bounds(robot.identified_path, robot))
    settings = TaskSettings()
    actions = np.random.default_rng(1).integers(0, settings.bins, (steps, n, len(robot.joints)))
    live = live_corrected = 0

    def task() -> WalkingTask:
        return WalkingTask(robot, sampler, settings, n, np.random.default_rng(0), threads)

    whole = task()
    corrected = WalkingTask(
        replace(robot, terms=FOUND),
        ParameterSampler(read_bounds(robot.identified_path, replace(robot, terms=FOUND))),
        settings,
        n,
        np.random.default_rng(0),
        threads,
    )

    def walk() -> None:
        nonlocal live
        live = _walked(whole, actions)

    def walk_corrected() -> None:
        nonlocal live_corrected
        live_corrected = _walked(corrected, actions)

    calls = _calls(task(), actions)
    physics, engine = (task()._simulations for _ in range(2))
    known = _known_torques(engine, calls)

    def with_law() -> None:
        _go_through(physics, calls)

    def alone() -> None:
        known()
        _go_through(engine, calls)

    costs = in_turn([walk, with_law, alone, walk_corrected], rounds)
    clock = [float(np.median([c.wall for c in of])) for of in costs]
    busy = [[c.processor for c in of] for of in costs]
    return {
        "robots": n,
        "env_steps": live,
        "task": live / clock[0],
        "task_per_core": live / float(np.median(busy[0])),
        "engine_per_core": live / float(np.median(busy[2])),
        "law_share": asdict(ratio(busy[1], busy[0])),
        "engine_share": asdict(ratio(busy[2], busy[0])),
        "effects_share": asdict(
            ratio([s / live_corrected for s in busy[3]], [s / live for s in busy[0]])
        ),
    }


def _walked(task: WalkingTask, actions: np.ndarray) -> int:
    """Control steps of a task through actions from a first reset on, less those that reset."""
    task.rng = np.random.default_rng(0)
    task.reset()
    return sum(int(task.step(action).live.sum()) for action in actions)


Call = tuple[str, tuple[Any, ...]]


def _calls(task: WalkingTask, actions: np.ndarray) -> list[Call]:
    """What a task asks of its simulations while it goes through actions."""
    calls: list[Call] = []
    simulations = task._simulations
    start, step = simulations.start, simulations.step

    def kept_start(*given: Any) -> Any:
        calls.append(
            ("start", tuple(np.copy(a) if isinstance(a, np.ndarray) else a for a in given))
        )
        return start(*given)

    def kept_step(*given: Any) -> Any:
        calls.append(("step", tuple(np.copy(a) for a in given)))
        return step(*given)

    with patch.multiple(simulations, start=kept_start, step=kept_step):
        task.reset()
        for action in actions:
            task.step(action)
    return calls


def _go_through(simulations: Simulations, calls: list[Call]) -> None:
    for name, given in calls:
        getattr(simulations, name)(*given)


def _known_torques(simulations: Simulations, calls: list[Call]) -> Callable[[], None]:
    """Let simulations know the torques of calls beforehand; gives a way to begin anew."""
    parts = simulations._parts
    known: list[list[Any]] = [[] for _ in parts]
    for part, kept in zip(parts, known, strict=True):
        law = part.limited.torque

        def noted(error: Any, velocity: Any, law: Any = law, kept: Any = kept) -> Any:
            answer = law(error, velocity)
            kept.append(tuple(a.copy() for a in answer))
            return answer

        part.limited.torque = noted  # type: ignore[method-assign]  # the instance alone
    _go_through(simulations, calls)

    def rewind() -> None:
        for part, kept in zip(parts, known, strict=True):
            left = iter(kept)
            part.limited.torque = lambda error, velocity, left=left: next(left)

    return rewind


def _told(share: dict[str, float]) -> str:
    return "{median:.2f} ({lowest:.2f} to {highest:.2f})".format(**share)


if __name__ == "__main__":
    main()
