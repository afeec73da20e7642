"""Gaussian processes in a process of their own, so that heartbeats flow during a fit."""

import asyncio
import logging
import os
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context, parent_process
from multiprocessing.process import BaseProcess
from typing import Any, ParamSpec, TypeVar

import numpy as np

from pup.transfer.study import Study
from pup.transfer.trial import TrialState
from services.gateway.records import Row

P = ParamSpec("P")
T = TypeVar("T")
log = logging.getLogger(__name__)
LONGEST = 300.0
"""For a fit and those before it, s: one takes seconds, its process' first imports a minute where
the machine is slow."""


class Fits:
    """Runs functions of `pup.transfer.optimizer` one after the other in a child process.

    Args:
      longest: after which the process counts as hung, s.
    """

    def __init__(self, longest: float = LONGEST) -> None:
        self._pool, self.longest = self._made(), longest

    def _made(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=_begin)

    async def run(self, act: Callable[P, T], *args: P.args, **options: P.kwargs) -> T:
        """Run a function of a module; once more where its process was killed meanwhile, or hung."""
        for last in (False, True):
            pool = self._pool
            try:
                future = asyncio.wrap_future(pool.submit(act, *args, **options))
                return await asyncio.wait_for(future, self.longest)
            except (BrokenProcessPool, TimeoutError) as error:
                why = "hangs" if isinstance(error, TimeoutError) else "ended"
                log.warning(f"the process of the fits {why}; another one is started")
                if self._pool is pool:
                    self._pool = self._made()
                    for child in _children(pool):  # whoever waits for it hears that it ended
                        child.kill()
                if last:
                    raise
        raise AssertionError

    async def warm_up(self) -> None:
        """Import what fits need before somebody waits for it."""
        await self.run(_imported)

    def close(self) -> None:
        """End the process, whatever it is at."""
        pool, children = self._pool, _children(self._pool)
        pool.shutdown(wait=False, cancel_futures=True)
        for child in children:
            child.kill()


def _children(pool: ProcessPoolExecutor) -> list[BaseProcess]:
    return list((pool._processes or {}).values())


def _begin() -> None:
    """One thread: more for such small matrices only take cores from others."""
    threading.Thread(target=_follow, daemon=True).start()
    os.environ["OMP_NUM_THREADS"] = "1"
    import signal
    import warnings

    import torch

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the gateway ends it
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")


def _follow() -> None:
    """End with the gateway, also where it was killed."""
    gateway = parent_process()
    assert gateway is not None
    gateway.join()
    os._exit(0)


def _imported() -> None:
    import pup.transfer.optimizer  # noqa: F401


def search_of(study: Study, simulated: Row | None) -> Any:
    """What the optimiser gets to know of a study: all its trials, in the order of their numbers."""
    from pup.transfer.optimizer import Search
    from pup.transfer.surrogate import Simulated

    settings = study.settings
    told = study.told
    eta = np.array([t.eta for t in told], dtype=float).reshape(-1, len(settings.lower))
    feasible = np.array([t.state is TrialState.SUCCEEDED for t in told], dtype=bool)
    walked = np.array([t.result.distance if t.result else None for t in told], dtype=float)
    nowhere = min(0.0, np.min(walked[feasible], initial=0.0))  # where an infeasible eta went
    distance = np.where(feasible, walked, nowhere)
    used = simulated if settings.warm_start else None
    return Search(
        settings.lower,
        settings.upper,
        settings.initial,
        settings.seed,
        eta,
        distance,
        used and Simulated(np.array(used["eta"], float), np.array(used["distance"], float)),
        feasible,
        settings.trials,
        tuple(t.eta for t in study.fruitless),
        tuple(t.eta for t in study.fruitless_since),
    )


def suggest(study: Study, simulated: Row | None) -> Any:
    """The decision on the next trial's eta; on the one to keep, where none is worth a walk."""
    from pup.transfer import optimizer

    search = search_of(study, simulated)
    decision = optimizer.suggest(search, len(study.trials) + 1)
    if decision.is_worth(study.settings.least_gain):
        return decision
    share = f"{decision.gain / decision.best:.2%}"
    return optimizer.choose(search, f"another walk is expected to gain {share} only")


def choose(study: Study, simulated: Row | None) -> Any:
    """The decision on the eta to keep."""
    from pup.transfer import optimizer

    return optimizer.choose(search_of(study, simulated))


def posterior(study: Study, simulated: Row | None) -> Row:
    """The process as the REST interface tells it: what would be chosen, and slices through it."""
    from dataclasses import asdict

    from pup.transfer import optimizer

    search = search_of(study, simulated)
    if len(search.distance) < 2 or not search.feasible.any():
        return {"walks": len(search.distance), "best": None, "slices": []}
    best = asdict(optimizer.choose(search))
    drawn = [asdict(s) for s in optimizer.slices(search)]
    return {"walks": len(search.distance), "best": best, "slices": drawn}
