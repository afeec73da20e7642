"""The Gaussian processes that people look at: fitted once for the same walks, whoever asks."""

import asyncio
from collections.abc import Callable

from pup.transfer.study import Study
from services.gateway import fits
from services.gateway.records import Row


class StoppingError(Exception):
    """The gateway stops before a process is fitted."""


NOTHING: Row = {"walks": 0, "best": None, "slices": []}


class Posteriors:
    """The processes of studies as the REST interface tells them.

    Args:
      fitted: runs the fits.
      notify: tells whoever waits for a study to change.
    """

    def __init__(self, fitted: fits.Fits, notify: Callable[[str], None]) -> None:
        self._fits, self._notify = fitted, notify
        self._kept: dict[str, tuple[str, Row]] = {}
        self._tasks: dict[str, tuple[str, asyncio.Task[Row]]] = {}

    async def of(self, study: Study, simulated: Row | None) -> Row:
        """The process of all walks of a study."""
        walks = _walks(study)
        known, row = self._kept.get(study.name, ("", NOTHING))
        if known == walks:
            return row
        begun, task = self._tasks.get(study.name, ("", None))
        if task is None or begun != walks:
            task = asyncio.create_task(self._fits.run(fits.posterior, study, simulated))
            task.add_done_callback(lambda done: self._done(study.name, walks, done))
            self._tasks[study.name] = walks, task
        try:
            return await asyncio.shield(task)
        except asyncio.CancelledError:
            if task.cancelled():  # not the request, but the fit
                raise StoppingError("the gateway stops; ask again when it is back") from None
            raise

    async def soon(self, study: Study, simulated: Row | None, seconds: float) -> Row:
        """The process, or after some time the latest there is: of fewer walks, or of none."""
        try:
            return await asyncio.wait_for(self.of(study, simulated), seconds)
        except TimeoutError:
            return self._kept.get(study.name, ("", NOTHING))[1]

    def stop(self) -> None:
        """Let nobody wait any more: the gateway stops."""
        for _, task in self._tasks.values():
            task.cancel()

    def _done(self, name: str, walks: str, task: asyncio.Task[Row]) -> None:
        if self._tasks.get(name, ("", None))[1] is task:
            del self._tasks[name]
        if not task.cancelled() and task.exception() is None:
            self._kept[name] = walks, task.result()
            self._notify(name)


def _walks(study: Study) -> str:
    """Tells whether a study has other walks than before."""
    return f"{len(study.told)}/{[(t.number, t.attempt) for t in study.told]}"
