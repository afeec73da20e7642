"""CMA-ES fits on Ray: an actor per fit, one pool of stateless evaluation tasks for all of them.

An actor owns its fit's state and writes a checkpoint after every generation; killed, it is started
again and resumes from it. Evaluations are tasks without state, so that a lost node costs a task.
Neither the number of workers nor how a generation is cut into tasks changes any result.
"""

import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import ray
from numpy.typing import NDArray
from ray.exceptions import RayError, RayTaskError

from pup.sysid.fit import FitResult, FitSettings, run_fit
from pup.sysid.polish import polish
from pup.sysid.problem import Problem

Array = NDArray[np.float64]

TASK_SECONDS = 0.05
"""A task should last at least this long: Ray's own cost per task is half a millisecond."""
POLL_SECONDS = 0.5
RETRIES = 100
"""Lost workers and nodes that a task or an actor outlives; one that kills its own stops here."""


@dataclass(frozen=True)
class Fit:
    """One fit of a list.

    Attributes:
      name: also the name of its checkpoint.
      problem: what is evaluated.
      settings: the search.
    """

    name: str
    problem: Problem
    settings: FitSettings


@dataclass(frozen=True)
class Status:
    """How far a fit is.

    Attributes:
      name: of the fit.
      generation: generations done.
      generations: of how many.
      loss: best objective so far.
      done: whether it has ended, what comes after the generations included.
    """

    name: str
    generation: int
    generations: int
    loss: float
    done: bool = False


Progress = Callable[[Sequence[Status]], None]


class Runner(Protocol):
    """Runs fits to their end."""

    def run(self, fits: Sequence[Fit], checkpoints: Path, progress: Progress) -> list[FitResult]:
        """Run the fits, resuming those that have a checkpoint in the folder."""
        ...


class LocalRunner:
    """Runs fits one after the other in this process, without Ray."""

    def run(self, fits: Sequence[Fit], checkpoints: Path, progress: Progress) -> list[FitResult]:
        """See Runner."""
        statuses = {f.name: Status(f.name, 0, f.settings.generations, np.inf) for f in fits}
        results = []
        for fit in fits:

            def report(result: FitResult, fit: Fit = fit) -> None:
                done = Status(fit.name, len(result.history), fit.settings.generations, result.loss)
                statuses[fit.name] = done
                progress(list(statuses.values()))

            checkpoint = checkpoints / f"{fit.name}.npz"
            problem = fit.problem
            result = run_fit(
                fit.settings,
                problem.losses,
                checkpoint,
                report,
                problem.digest,
                partial(polish, problem.errors, anchor=fit.settings.anchor),
            )
            results.append(result)
            statuses[fit.name] = _done(fit, result)
            progress(list(statuses.values()))
        return results


class RayRunner:
    """Runs fits at once on the Ray cluster this process is connected to.

    Checkpoints must lie where every node can write. Actors are kept for later fits, as a new one
    spends seconds on its imports.
    """

    def __init__(self) -> None:
        self._idle: list[Any] = []

    def run(self, fits: Sequence[Fit], checkpoints: Path, progress: Progress) -> list[FitResult]:
        """See Runner."""
        shared = {f.problem.digest: f.problem for f in fits}
        references = {d: ray.put(replace(p, threads=1)) for d, p in shared.items()}
        waiting = list(enumerate(fits))[::-1]
        running: dict[Any, tuple[int, Any]] = {}
        results: dict[int, FitResult] = {}
        statuses = [Status(f.name, 0, f.settings.generations, np.inf) for f in fits]
        try:
            while waiting or running:
                while waiting and len(running) < max(4, 2 * _cores()):
                    i, fit = waiting.pop()
                    digest = fit.problem.digest
                    # Absolute: an actor's working directory is that of its node's Ray.
                    path = str((checkpoints / f"{fit.name}.npz").absolute())
                    actor = self._idle.pop() if self._idle else _actor()
                    share = _share(len(fits))
                    run = actor.run.remote(
                        fit.name, [references[digest]], digest, fit.settings, path, share
                    )
                    running[run] = (i, actor)
                for reference in ray.wait(list(running), timeout=POLL_SECONDS)[0]:
                    i, actor = running[reference]
                    results[i] = fetched(reference)
                    del running[reference]
                    self._idle.append(actor)
                    statuses[i] = _done(fits[i], results[i])
                _poll(running.values(), fits, statuses)
                progress(statuses)
        finally:
            for _, actor in running.values():
                ray.kill(actor)
        return [results[i] for i in range(len(fits))]


def _actor() -> Any:
    return FitActor.remote()  # type: ignore[attr-defined]  # Ray adds it


def fetched(reference: Any) -> Any:
    """What a task or an actor answers; what went wrong in it is raised as it was there.

    Raises:
      OSError: without a file's name, for what a node cannot read or write is nobody's input; a
        ConnectionError where its processes were lost more often than they are replaced.
    """
    try:
        return ray.get(reference)
    except RayError as error:
        cause: BaseException = error
        while isinstance(cause, RayTaskError) and cause.cause is not None:
            cause = cause.cause  # what a task raised comes wrapped once more by the actor
        if isinstance(cause, OSError):
            raise OSError(f"on a node of the cluster: {cause}") from error
        if isinstance(cause, RayError) and not isinstance(cause, RayTaskError):
            raise ConnectionError(
                "a process on the cluster was lost again and again, perhaps for want of memory; "
                "the same command resumes"
            ) from error
        raise cause from error


def _poll(running: Iterable[tuple[int, Any]], fits: Sequence[Fit], statuses: list[Status]) -> None:
    """Ask the actors how far they are, and tell them their share of the cores."""
    live = list(running)
    share = _share(len(live))
    asked = [(i, actor.status.remote(fits[i].name, share)) for i, actor in live]
    if asked:
        answered, _ = ray.wait([a for _, a in asked], num_returns=len(asked), timeout=POLL_SECONDS)
        for i, answer in asked:
            # An actor that starts, restarts or has just ended does not answer; one that has
            # restarted is at its checkpoint only after its next generation.
            with suppress(RayError):
                told = _status(fits[i], *ray.get(answer)) if answer in answered else statuses[i]
                statuses[i] = max(told, statuses[i], key=lambda s: s.generation)


def _status(fit: Fit, generation: int, loss: float) -> Status:
    return Status(fit.name, generation, fit.settings.generations, loss)


def _done(fit: Fit, result: FitResult) -> Status:
    generations = fit.settings.generations
    return Status(fit.name, generations, generations, result.loss, done=True)


def _share(fits: int) -> int:
    """Cores for each of some fits; rounded up, so that none is without a task."""
    return max(1, -(-_cores() // max(1, fits)))


def _cores() -> int:
    return max(1, int(ray.cluster_resources().get("CPU", 1)))


@ray.remote(
    scheduling_strategy="SPREAD",
    max_restarts=RETRIES,
    max_task_retries=RETRIES,
    max_concurrency=2,
)
class FitActor:
    """Owns one fit; see the module.

    Without `num_cpus` Ray places it where there is a core, and has it hold none; with 0 it would be
    put anywhere, on a head too that is to do no work.
    """

    def __init__(self) -> None:
        self.name = ""
        self.share = 1
        self.cost = np.inf  # s per candidate, measured
        self.state = (0, np.inf)
        self.lock = threading.Lock()

    def run(
        self,
        name: str,
        problem: list[Any],
        digest: str,
        settings: FitSettings,
        checkpoint: str,
        share: int,
    ) -> FitResult:
        """Run a fit to its end.

        Args:
          name: of the fit.
          problem: the problem's reference, in a list so that Ray leaves it a reference.
          digest: of the problem.
          settings: the search.
          checkpoint: path of its checkpoint.
          share: cores it has to begin with.
        """
        with self.lock:
            self.name, self.share, self.cost, self.state = name, share, np.inf, (0, np.inf)

        def losses(unit: Array) -> Array:
            return np.concatenate(self._evaluated("losses", problem, digest, unit))

        def errors(unit: Array) -> tuple[Array, NDArray[np.int64]]:
            parts = self._evaluated("errors", problem, digest, unit)
            return np.concatenate([error for error, _ in parts]), parts[0][1]

        return run_fit(
            settings,
            losses,
            Path(checkpoint),
            self._progress,
            digest,
            partial(polish, errors, anchor=settings.anchor),
        )

    def status(self, name: str, share: int) -> tuple[int, float]:
        """Generations done and the best objective; takes the cores that the fit has now.

        Of a fit that has not begun, or has begun again, there are none yet.
        """
        with self.lock:
            if name != self.name:
                return 0, np.inf
            self.share = share
            return self.state

    def _progress(self, result: FitResult) -> None:
        with self.lock:
            self.state = (len(result.history), result.loss)

    def _evaluated(self, what: str, problem: list[Any], digest: str, unit: Array) -> list[Any]:
        """What some candidates evaluate to, in pieces of as many tasks as is worth it."""
        with self.lock:
            share = self.share
        pieces = np.array_split(unit, cut(len(unit), share, self.cost))
        answers = ray.get([evaluate.remote(what, problem, digest, p) for p in pieces])
        self.cost = sum(seconds for _, seconds in answers) / len(unit)
        return [value for value, _ in answers]


def cut(candidates: int, share: int, cost: float) -> int:
    """How many tasks candidates are cut into.

    Args:
      candidates: how many there are, one at least.
      share: cores for them.
      cost: of one candidate, s; infinite while it is unknown.
    """
    return int(max(1, min(share, candidates, candidates * cost / TASK_SECONDS)))


@ray.remote(num_cpus=1, max_retries=RETRIES)
def evaluate(what: str, problem: list[Any], digest: str, unit: Array) -> tuple[Any, float]:
    """`losses` or `errors` of some candidates, and the seconds they took."""
    begin = time.perf_counter()
    if digest not in _PROBLEMS:
        if len(_PROBLEMS) >= CACHED_PROBLEMS:
            _PROBLEMS.clear()
        _PROBLEMS[digest] = ray.get(problem[0])
    value = getattr(_PROBLEMS[digest], what)(unit)
    return value, time.perf_counter() - begin


_PROBLEMS: dict[str, Problem] = {}
"""Problems with their compiled models, kept by a worker process from task to task."""
CACHED_PROBLEMS = 16
