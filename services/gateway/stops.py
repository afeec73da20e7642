"""The emergency stop of somebody who is not at the robot: it goes out first, all else beside it."""

import asyncio
import logging
import time
from collections.abc import Callable, Coroutine
from functools import partial
from typing import Any

from pup.transfer import orders
from pup.transfer.study import Study
from pup.transfer.trial import TrialError, UnknownError
from pup.wire import Stop
from services.gateway.agents import AgentView
from services.gateway.conductor import Conductor
from services.gateway.store import Event

log = logging.getLogger(__name__)

CONFIRMED = 2.0
"""In which a robot must say that it has stopped, s."""
_under_way: set["asyncio.Task[bool]"] = set()
"""What is still to be written when the answer is given."""


async def stop(conductor: Conductor, agent: str, who: str, reason: str) -> list[str]:
    """Stop a robot, now; give it no trial, and pause what it was at, or would be next.

    It is told again until it says that it is limp. A fit or a database that takes nothing may hold
    up the pause of a study, but neither the robot's word nor the pause of another.

    Args:
      conductor: of the studies.
      agent: that is stopped.
      who: stops it.
      reason: in words.

    Returns:
      What could not be written in time, in words; it is no reason to think that the robot moves.

    Raises:
      TrialError: the robot has not said that it is limp.
    """
    if agent not in conductor.agents:
        raise UnknownError(f"there is no agent {agent}")
    view, end = conductor.agents[agent], time.monotonic() + CONFIRMED
    view.held = f"{who}: {reason}"
    view.stop = Stop(view.held)
    conductor.courier.send(agent, view.stop)
    order = partial(orders.halt, agent=agent, reason=f"{agent} was stopped by {who}: {reason}")
    halts = [_begin(_halt(conductor, name, who, order)) for name in conductor.studies]
    event = Event("stopped", who, detail={"agent": agent, "reason": reason})
    logged = _begin(conductor.store.log([event]))
    await _limp(view, end)
    await asyncio.wait([*halts, logged], timeout=max(0.0, end - time.monotonic()))
    active = [name for name, study in conductor.studies.items() if order(study) != study]
    unwritten = [f"study {name} is not paused yet" for name in active]
    if not (logged.done() and logged.result()):
        unwritten.append("the history does not have the stop yet")
    if view.stop:
        told = f"{agent} has not said that it is limp: use the switch at the robot"
        raise TrialError("; ".join([told, "it is told again and given no trial", *unwritten]))
    return unwritten


async def _limp(view: AgentView, end: float) -> None:
    """Wait until a robot says that it is; not for one that is away."""
    while view.stop and view.present and time.monotonic() < end:
        await asyncio.sleep(0.05)


async def _halt(conductor: Conductor, name: str, who: str, order: Callable[[Study], Study]) -> None:
    study = await conductor.change(name, who, order, "stopped")
    if study.open:
        conductor.courier.recall(study.open)


def _begin(write: Coroutine[Any, Any, None]) -> "asyncio.Task[bool]":
    """Let it go on beside the others, also after the answer; its outcome is whether it was done."""
    task = asyncio.get_running_loop().create_task(_tried(write))
    _under_way.add(task)
    task.add_done_callback(_under_way.discard)
    return task


async def _tried(write: Coroutine[Any, Any, None]) -> bool:
    try:
        await write
    except Exception:  # one study that cannot be paused keeps no other from it
        log.exception("a stop could not be written")
        return False
    return True
