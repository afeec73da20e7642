"""Where a job's work is done: in this process, on an embedded Ray or on a cluster."""

import argparse
import os
import sys
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol

from pup.errors import InputError
from services.failures import FailedError


class Pool(Protocol):
    """Does a job for things, several at once."""

    def begin(self, item: Any) -> None:
        """Do it for a thing when its turn comes."""
        ...

    def settled(self) -> tuple[Any, Any]:
        """The next thing that is done and the outcome; an exception where the process was lost."""
        ...

    def close(self) -> None:
        """End what runs."""
        ...


Pools = Callable[[Callable[[Any], Any]], Pool]
"""Makes a pool for a job."""


def cores(options: argparse.Namespace) -> int:
    """Cores that a job takes on this computer."""
    return int(options.cores or len(os.sched_getaffinity(0)))


@contextmanager
def fits(options: argparse.Namespace) -> Iterator[Any]:
    """Where fits run."""
    from workers.fits import LocalRunner, RayRunner

    if options.local:
        yield LocalRunner()
        return
    from workers.cluster import connected

    with connected(options.address, options.cores):
        yield RayRunner()


@contextmanager
def training(options: argparse.Namespace) -> Iterator[int]:
    """Where a training runs; gives the cores there are for it."""
    from workers.cluster import connected, cores_there

    if (options.cores or not options.address) and options.runners > cores(options):
        raise InputError(
            f"--runners {options.runners} on {cores(options)} cores; use at most one for each core"
        )
    with connected(options.address, options.cores):
        yield _shared_out(options) if options.address else cores_there()


def _shared_out(options: argparse.Namespace) -> int:
    """Cores of a cluster for a training: as many for each of its runners as one node has for it.

    Raises:
      InputError: some runners would wait for ever.
      FailedError: others have the cores, or nodes are away; there may be room another time.
    """
    from workers import nodes

    runners = options.runners
    if not runners:
        return cores(options)  # without runners this process does all
    if options.cores:
        _tell_who_waits(runners, options.cores)
        return cores(options)
    free = nodes.cores_free()
    if share := nodes.largest_share(free, runners):
        return share * runners
    if runners < sum(nodes.cores_whole()):
        raise FailedError(f"{sum(free)} cores of the cluster are free for {runners} runners")
    raise InputError(
        f"--runners {runners}, where {sum(free)} cores of the cluster are free beside this "
        "process; use fewer, or say by --cores how many there will be on one that grows"
    )


def _tell_who_waits(runners: int, in_all: int) -> None:
    """Say so where a cluster has no room for the runners yet; it may grow, so they wait for it."""
    from workers import nodes

    share = in_all // runners
    there = nodes.room(nodes.cores_free(), share)
    if there < runners:
        largest = max(nodes.cores_whole(), default=0)
        line = f"--runners {runners} --cores {in_all}: waiting for nodes with {share} free cores "
        line += f"for each runner; there is room for {there}, and the largest node has {largest}"
        print(line, file=sys.stderr, flush=True)


@contextmanager
def replays(options: argparse.Namespace) -> Iterator[Any]:
    """Where batches of replays run: a `diagnosis.Where`."""
    from services.diagnosis import Where, alone

    if options.local:
        yield alone(cores(options))
        return
    from workers.cluster import connected
    from workers.hypotheses import lanes, ray_runner

    with connected(options.address, options.cores):
        yield Where(ray_runner, lanes(), here=False)


@contextmanager
def cases(options: argparse.Namespace) -> Iterator[tuple[Pools, int]]:
    """Where whole cases are worked on, each on one core, and how many at once."""
    if options.local:
        yield OneByOne, 1
        return
    from workers.cases import RayPool
    from workers.cluster import connected
    from workers.hypotheses import lanes

    with connected(options.address, options.cores):
        yield RayPool, lanes()


class OneByOne:
    """See Pool; in this process, one after the other."""

    def __init__(self, job: Callable[[Any], Any]) -> None:
        self._job, self.waiting = job, deque[Any]()

    def begin(self, item: Any) -> None:
        """See Pool."""
        self.waiting.append(item)

    def settled(self) -> tuple[Any, Any]:
        """See Pool."""
        item = self.waiting.popleft()
        return item, self._job(item)

    def close(self) -> None:
        """See Pool."""
        self.waiting.clear()
