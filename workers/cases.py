"""Jobs that have nothing to do with each other, each a task on one core of the Ray cluster."""

from collections.abc import Callable, Generator, Sequence
from contextlib import suppress
from typing import TypeVar

import ray
from ray.exceptions import RayError

from workers.fits import POLL_SECONDS

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")

TRIES = 2
"""Lost workers that a job outlives: one that ends its own process is given up."""


def on_ray(
    job: Callable[[Item], Outcome], items: Sequence[Item]
) -> Generator[tuple[int, Outcome | RayError], None, None]:
    """Do a job for each of some things on the cluster this process is connected to.

    What a job writes must lie where every node can write.

    Args:
      job: a function of a module, that the workers import too.
      items: what it is given, in the order in which to begin.

    Yields:
      The place of a thing and the outcome, as they come; what Ray tells of a job that raised or
      whose processes were lost.
    """
    task = ray.remote(num_cpus=1, max_retries=TRIES)(job)
    running = {task.remote(item): i for i, item in enumerate(items)}
    try:
        while running:
            for reference in ray.wait(list(running), timeout=POLL_SECONDS)[0]:
                i = running.pop(reference)
                yield i, _outcome(reference)
    finally:
        for reference in running:
            with suppress(RayError):
                ray.cancel(reference, force=True)


def _outcome(reference: "ray.ObjectRef[Outcome]") -> Outcome | RayError:
    try:
        return ray.get(reference)
    except RayError as error:
        return error
