"""Jobs that have nothing to do with each other, each a task on one core of the Ray cluster."""

from collections.abc import Callable
from contextlib import suppress
from typing import Generic, TypeVar

import ray
from ray.exceptions import RayError

from workers.fits import POLL_SECONDS

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")

TRIES = 2
"""Lost workers that a job outlives: one that ends its own process is given up."""


class RayPool(Generic[Item, Outcome]):
    """Does a job for each of some things on the cluster this process is connected to.

    What a job writes must lie where every node can write.

    Args:
      job: a function of a module, that the workers import too.
    """

    def __init__(self, job: Callable[[Item], Outcome]) -> None:
        self._task = ray.remote(num_cpus=1, max_retries=TRIES)(job)
        self._running: dict[ray.ObjectRef[Outcome], Item] = {}

    def begin(self, item: Item) -> None:
        """Do the job for a thing when a core is free and all that began before have one."""
        self._running[self._task.remote(item)] = item

    def settled(self) -> tuple[Item, Outcome | RayError]:
        """The next thing that is done, and the outcome.

        That is what Ray tells of a job that raised or whose processes were lost.

        Raises:
          LookupError: nothing is left to wait for.
        """
        if not self._running:
            raise LookupError("nothing was begun that is not settled")
        settled: list[ray.ObjectRef[Outcome]] = []
        while not settled:  # by turns, so that signals are heard
            settled = ray.wait(list(self._running), timeout=POLL_SECONDS)[0]
        return self._running.pop(settled[0]), _outcome(settled[0])

    def close(self) -> None:
        """End what runs."""
        for reference in self._running:
            with suppress(RayError):
                ray.cancel(reference, force=True)


def _outcome(reference: "ray.ObjectRef[Outcome]") -> Outcome | RayError:
    try:
        return ray.get(reference)
    except RayError as error:
        return error
