"""Where a job's work is done: in this process, on an embedded Ray or on a cluster."""

import argparse
import os
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from pup.errors import InputError

Each = Callable[[Callable[[Any], Any], Sequence[Any]], Generator[tuple[int, Any], None, None]]
"""Does a job for each of some things, and yields their places in the list and the outcomes as they
come; the outcome of a job whose process was lost is an exception."""


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

    if not options.address and options.runners > cores(options):
        raise InputError(
            f"--runners {options.runners} on {cores(options)} cores; use at most one for each core"
        )
    with connected(options.address, options.cores):
        yield options.cores if options.address and options.cores else cores_there()


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
def cases(options: argparse.Namespace) -> Iterator[tuple[Each, int]]:
    """Where whole cases are worked on, each on one core, and how many at once."""
    if options.local:
        yield one_by_one, 1
        return
    from workers.cases import on_ray
    from workers.cluster import connected
    from workers.hypotheses import lanes

    with connected(options.address, options.cores):
        yield on_ray, lanes()


def one_by_one(
    job: Callable[[Any], Any], items: Sequence[Any]
) -> Generator[tuple[int, Any], None, None]:
    """See Each; in this process."""
    for i, item in enumerate(items):
        yield i, job(item)
