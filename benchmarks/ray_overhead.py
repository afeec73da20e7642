"""What Ray costs a fit, how two cores compare with one, and what is to be expected of 256.

(a) The same two fits of a few recordings by the local runner on all of two cores and by Ray on two
workers, in turn. Ray's start is told apart: it is paid once per job. Under `processor` stand the
seconds of all processes together, which hardly depend on what else the machine does.

(b) One fit of all suspended recordings, and several of subsets at once, by an embedded Ray of one
core and of two, in turn. Beside it what the machine has to give: two processes that share nothing
but its memory, each with a fit of its own, against one of them alone.

(c) Costs measured here (candidates at once, the search's own steps, Ray's time per task), played
through by an event simulation to 256 workers. Efficiency is the speed-up over one worker divided by
the number of workers. What is gained when one cause at a time is taken away names the bottleneck,
unless there are fewer candidates at once than workers: then that is it. The simulation knows
neither network nor memory bandwidth. `--simulated` does this part alone.

Ray gives its workers the lowest priority. Here they get the ordinary one, else what other programs
do to the two runners would be compared.
"""

import heapq
import itertools
import multiprocessing
import os
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from multiprocessing.synchronize import Event, Semaphore
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import psutil
import ray
from numpy.typing import NDArray

from benchmarks.paired import ROBOT, Report, parser, ratio, shipped
from pup.physics.parameters import robot_space
from pup.recording import Recording, load_recordings
from pup.robot import RobotDescription
from pup.sysid.fit import CmaFit, FitSettings
from pup.sysid.problem import Problem
from workers.cluster import connected
from workers.fits import Fit, LocalRunner, RayRunner, Runner, cut, evaluate

Array = NDArray[np.float64]

GENERATIONS = 12
FEW = 3
"""Recordings of the fits that are timed as a whole."""
SUBSETS = 4
"""Fits of so many recordings that run at once, as Algorithm 1 runs those of its subsets."""
WORKERS = (1, 2, 4, 8, 16, 32, 64, 128, 256)
TOLD = 32, 256
"""Workers at which the bottleneck is named."""
SIZES = (1, 2, 4, 8, 16)
SCENARIOS = ((1, 32), (1, 64), (10, 16), (50, 16), (200, 16))
"""Fits at once and their population."""
PAPER_SIZE = 5  # times the shipped recordings are as many as the paper's 60


def main() -> None:
    options = parser(__doc__, rounds=3)
    options.add_argument("--recordings", type=Path, help="of darwin_op2; default: the shipped ones")
    options.add_argument("--simulated", action="store_true", help="part (c) alone")
    given = options.parse_args()
    os.environ.setdefault("RAY_worker_niceness", "0")
    report = Report("ray_overhead", given.json)
    robot = RobotDescription.load(ROBOT)
    recordings = shipped(robot, "suspended") + shipped(robot, "ground")
    if given.recordings:
        recordings = tuple(load_recordings([given.recordings]))
    suspended = tuple(r for r in recordings if r.support == "suspended")
    few = suspended[:FEW]
    if not given.simulated:
        report.add("against_local", _against_local(robot, few, given.rounds, report))
        report.add("machine", _two_processes(robot, few, given.rounds, report))
        report.add("two_against_one", _two_against_one(robot, suspended, given.rounds, report))
    report.add("simulated", _to_many(robot, recordings, report))
    report.finish()


# (a) and (b)


@dataclass(frozen=True)
class Spent:
    """Seconds of a run: on the clock, and of the processor in all processes below this one."""

    wall: float
    processor: float


def _against_local(
    robot: RobotDescription, recordings: tuple[Recording, ...], rounds: int, report: Report
) -> dict[str, object]:
    fits = [_fit(robot, recordings, seed, threads=2) for seed in (0, 1)]
    begin = time.perf_counter()
    with connected(cores=2):
        start = time.perf_counter() - begin
        runs = [_run(r, fits) for _ in range(rounds + 1) for r in (LocalRunner(), RayRunner())][2:]
    local, on_ray = runs[::2], runs[1::2]
    wall = ratio([s.wall for s in on_ray], [s.wall for s in local])
    processor = ratio([s.processor for s in on_ray], [s.processor for s in local])
    report.say(
        f"(a) Ray's time over the local runner's, two fits on two cores: {wall} on the clock, "
        f"{processor} of the processor; bar 1.05. Ray starts in {start:.1f} s."
    )
    return {
        "wall": asdict(wall),
        "processor": asdict(processor),
        "start_seconds": start,
        "local": [asdict(s) for s in local],
        "ray": [asdict(s) for s in on_ray],
    }


def _two_against_one(
    robot: RobotDescription, recordings: tuple[Recording, ...], rounds: int, report: Report
) -> dict[str, object]:
    alone = [_fit(robot, recordings, seed=0, threads=1)]
    several = [_fit(robot, recordings[i : i + FEW], seed=i, threads=1) for i in range(SUBSETS)]
    first = _short(_fit(robot, recordings[:1], seed=0, threads=1))
    found: dict[str, object] = {}
    for name, fits in (("one fit of all", alone), (f"{SUBSETS} fits of subsets", several)):
        runs = []
        for cores in (1, 2) * rounds:
            with connected(cores=cores):
                _run(RayRunner(), [first])  # workers start
                runs.append(_run(RayRunner(), fits))
        speedup = ratio([s.wall for s in runs[::2]], [s.wall for s in runs[1::2]])
        report.say(f"(b) {name}, two workers against one: {speedup} times as fast; bar 1.8")
        found[name] = {"speedup": asdict(speedup), "runs": [asdict(s) for s in runs]}
    return found


def _two_processes(
    robot: RobotDescription, recordings: tuple[Recording, ...], rounds: int, report: Report
) -> dict[str, object]:
    seconds = [_separately(robot, recordings, count) for count in (1, 2) * rounds]
    speedup = ratio([2 * s for s in seconds[::2]], seconds[1::2])
    report.say(f"(b) two separate processes without Ray against one: {speedup} times as fast")
    return {"speedup": asdict(speedup), "seconds": seconds}


def _separately(robot: RobotDescription, recordings: tuple[Recording, ...], count: int) -> float:
    """Seconds of as many fits, each in a process of its own."""
    spawn = multiprocessing.get_context("spawn")
    begin, ready = spawn.Event(), spawn.Semaphore(0)
    fits = [_fit(robot, recordings, seed, threads=1) for seed in range(count)]
    processes = [spawn.Process(target=_alone, args=(fit, ready, begin)) for fit in fits]
    for process in processes:
        process.start()
    for _ in processes:
        ready.acquire()
    wall = time.perf_counter()
    begin.set()
    for process in processes:
        process.join()
    return time.perf_counter() - wall


def _alone(fit: Fit, ready: Semaphore, begin: Event) -> None:
    _run(LocalRunner(), [_short(fit)])
    ready.release()
    begin.wait()
    _run(LocalRunner(), [fit])


def _fit(
    robot: RobotDescription, recordings: tuple[Recording, ...], seed: int, threads: int
) -> Fit:
    space = robot_space(robot, "nn_pd")
    problem = Problem(robot, recordings, "nn_pd", space, space.names, threads)
    start = space.normalise(space.nominal)
    return Fit(f"fit{seed}", problem, FitSettings(start, 0.1, 16, GENERATIONS, seed))


def _short(fit: Fit) -> Fit:
    return replace(fit, settings=replace(fit.settings, generations=1))


def _run(runner: Runner, fits: list[Fit]) -> Spent:
    with TemporaryDirectory() as folder:
        wall, processor = time.perf_counter(), _processor()
        runner.run(fits, Path(folder), lambda _: None)
        return Spent(time.perf_counter() - wall, _processor() - processor)


def _processor() -> float:
    """Processor seconds of this process and all below it; none of them ends during a run."""
    me = psutil.Process()
    times = [p.cpu_times() for p in (me, *me.children(recursive=True))]
    return sum(t.user + t.system for t in times)


# (c)


@dataclass(frozen=True)
class Costs:
    """Measured costs, s.

    Attributes:
      fixed: of a task, whatever it evaluates.
      candidate: of each candidate in it.
      spread: relative standard deviation between equal tasks.
      search: of CMA-ES per generation and candidate.
      task: Ray's own per task.
    """

    fixed: float
    candidate: float
    spread: float
    search: float
    task: float

    def seconds(self, candidates: int) -> float:
        """What a task of some candidates takes."""
        return self.fixed + self.candidate * candidates


def _to_many(
    robot: RobotDescription, recordings: tuple[Recording, ...], report: Report
) -> list[dict[str, object]]:
    task = _task_overhead(robot, recordings[:1])
    search = _search_cost()
    report.say(
        f"(c) Ray per task: {1e3 * task:.1f} ms; the search per candidate: {1e3 * search:.2f} ms"
    )
    many = tuple(replace(r, id=f"{r.id}_{i}") for i in range(PAPER_SIZE) for r in recordings)
    found = []
    for name, every in (("shipped", recordings), ("paper-size", many)):
        subset = every[:: len(every) // max(2, round(0.1 * len(every)))]
        nominal = _costs(_fit(robot, every, 0, 1), search, task)
        few = _costs(_fit(robot, subset, 0, 1), search, task)
        for label, count, of in (("all", len(every), nominal), ("a subset", len(subset), few)):
            report.say(
                f"  {name}, {label} ({count} recordings): {1e3 * of.fixed:.0f} ms a task + "
                f"{1e3 * of.candidate:.1f} ms a candidate, ±{of.spread:.0%}"
            )
        for fits, population in SCENARIOS:
            found.append(_scenario(name, fits, population, nominal if fits == 1 else few))
            report.say(_line(found[-1]))
    return found


def _scenario(name: str, fits: int, population: int, costs: Costs) -> dict[str, object]:
    def efficiency(of: Costs, workers: int) -> float:
        return _makespan(fits, population, of, 1) / (
            workers * _makespan(fits, population, of, workers)
        )

    by_workers = {w: efficiency(costs, w) for w in WORKERS}
    full = costs.seconds(population) / population  # if a task cost no more for being small
    without = {
        "small batches": replace(costs, fixed=0.0, candidate=full),
        "the search's own steps": replace(costs, search=0.0),
        "unequal tasks": replace(costs, spread=0.0),
        "Ray": replace(costs, task=0.0),
    }
    gains = {
        workers: {
            cause: efficiency(better, workers) - by_workers[workers]
            for cause, better in without.items()
        }
        for workers in TOLD
    }
    few = {workers: fits * population / workers for workers in TOLD}
    bottleneck = {
        workers: "few candidates" if few[workers] < 1 else max(told, key=lambda c: told[c])
        for workers, told in gains.items()
    }
    return {
        "recordings": name,
        "fits": fits,
        "population": population,
        "costs": asdict(costs),
        "efficiency": by_workers,
        "gained_without": gains,
        "bottleneck": bottleneck,
    }


def _line(row: dict[str, object]) -> str:
    efficiency, gains = row["efficiency"], row["gained_without"]
    assert isinstance(efficiency, dict) and isinstance(gains, dict)
    told = ", ".join(f"{w}: {e:.0%}" for w, e in efficiency.items())
    causes = "; ".join(
        f"{workers} workers, {row['bottleneck'][workers]}, without "
        + ", ".join(f"{cause} {gain:+.0%}" for cause, gain in gain_of.items())
        for workers, gain_of in gains.items()
    )
    return (
        f"  {row['recordings']}, {row['fits']} fits of population {row['population']}: {told}; "
        f"bar 70 %. {causes}"
    )


def _makespan(
    fits: int, population: int, costs: Costs, workers: int, generations: int = 30
) -> float:
    """Seconds that some fits take on some workers, by events."""
    rng = np.random.default_rng(0)
    share = max(1, -(-workers // fits))
    search = costs.search * population
    idle, queue = workers, deque[tuple[int, int]]()
    left, pending = [generations] * fits, [0] * fits
    events: list[tuple[float, int, str, int]] = []
    order = itertools.count()

    def at(when: float, what: str, fit: int) -> None:
        heapq.heappush(events, (when, next(order), what, fit))

    for fit in range(fits):
        at(search, "asked", fit)
    now = 0.0
    while events:
        now, _, what, fit = heapq.heappop(events)
        if what == "asked":
            sizes = np.diff(np.linspace(0, population, cut(population, share, costs.candidate) + 1))
            pending[fit] = len(sizes)
            queue.extend((fit, round(size)) for size in sizes)
        else:
            idle += 1
            pending[fit] -= 1
            if not pending[fit]:
                left[fit] -= 1
                if left[fit]:
                    at(now + search, "asked", fit)
        while idle and queue:
            which, candidates = queue.popleft()
            noise = rng.lognormal(-(costs.spread**2) / 2, costs.spread)
            at(now + costs.task + costs.seconds(candidates) * noise, "evaluated", which)
            idle -= 1
    return now


def _costs(fit: Fit, search: float, task: float) -> Costs:
    """Processor time of evaluations in this process, a straight line through the sizes."""
    problem, start = fit.problem, fit.settings.start
    rng = np.random.default_rng(1)
    problem.losses(start[None])
    sizes, seconds = [], []
    for _ in range(4):
        for size in SIZES:
            unit = np.clip(start + 0.1 * rng.normal(size=(size, len(start))), 0, 1)
            sizes.append(size)
            seconds.append(_processor_of(lambda unit=unit: problem.losses(unit)))
    candidate, fixed = np.polyfit(sizes, seconds, 1, w=1 / np.array(sizes))
    expected = fixed + candidate * np.array(sizes)
    spread = float(np.std(np.array(seconds) / expected))
    return Costs(max(0.0, float(fixed)), float(candidate), spread, search, task)


def _processor_of(action: Callable[[], object]) -> float:
    begin = time.process_time()
    action()
    return time.process_time() - begin


def _search_cost(population: int = 32, generations: int = 20) -> float:
    fit = CmaFit(FitSettings(np.full(41, 0.5), population=population))
    rng = np.random.default_rng(0)

    def search() -> None:
        for _ in range(generations):
            fit.ask()
            fit.tell(rng.random(population))

    search()
    return _processor_of(search) / (generations * population)


def _task_overhead(robot: RobotDescription, recordings: Sequence[Recording]) -> float:
    """Median of what a task takes longer than the evaluation in it."""
    fit = _fit(robot, tuple(recordings), 0, 1)
    unit = fit.settings.start[None]
    over = []
    with connected(cores=1):
        problem = [ray.put(fit.problem)]
        for _ in range(60):
            begin = time.perf_counter()
            _, seconds = ray.get(evaluate.remote("losses", problem, fit.problem.digest, unit))
            over.append(time.perf_counter() - begin - seconds)
    return float(np.median(over))


if __name__ == "__main__":
    main()
