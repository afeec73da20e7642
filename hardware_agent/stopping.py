"""`pup-agent stop` and `disable`: a robot is made limp with an agent or without one.

Neither may fail because of something that it does not need, such as a mistake elsewhere in the
configuration while the agent that read an earlier one goes on.
"""

import re
import sys
import time
from contextlib import closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from hardware_agent.config import Settings, located
from hardware_agent.control import Unreachable, say
from pup.errors import InputError

if TYPE_CHECKING:  # imported where it is needed: most often an agent answers
    from hardware_agent.bus import Bus

SOCKET = Path("/run/pup-agent/agent.sock")
"""Where an agent listens whose configuration does not tell."""
TOLD = re.compile(r"""^\s*socket\s*=\s*["']([^"'\n]+)""", re.MULTILINE)
PERSISTENCE = 2.0  # s of trying to take the bus without an agent, and to make the robot limp
AGAIN = 0.05  # s between two tries to take it
SWITCH = "use the power switch"


def make_limp(file: Path, verb: str) -> bool:
    """Tell the agent; without one, take the bus and do it.

    Args:
      file: the configuration.
      verb: "stop", which the agent does at once, or "disable", which it does in its turn.

    Returns:
      Whether it was done and, as far as was asked, all servos say that they are limp.

    Raises:
      InputError: the agent refuses; or none answers and the configuration has a mistake.
    """
    settings, mistake = _read(file)
    places = [settings.socket] if settings is not None else sockets(file)
    for place in places:
        with suppress(Unreachable):
            limp = say(place, {"do": verb}).get("limp", True)
            doubt = "" if limp else f"not every servo says that it is limp; {SWITCH}"
            also = f"the agent at {place} was told; {mistake}" if mistake else ""
            if doubt or also:
                _note(verb, "; ".join(filter(None, (doubt, also))))
            return bool(limp)
    if settings is None:
        tried = " and ".join(map(str, places))
        raise InputError(
            f"{mistake}; no agent answers at {tried}, and no servo was told anything: {SWITCH}"
        )
    return _alone(settings, verb)


def sockets(file: Path) -> list[Path]:
    """Where the agent may listen whose configuration has a mistake, likeliest first."""
    told: list[Path] = []
    with suppress(OSError, ValueError):  # a path that leads nowhere may be the mistake
        told = [located(path, file) for path in TOLD.findall(file.read_text(errors="replace"))]
    return [*told[:1], SOCKET]


def _read(file: Path) -> tuple[Settings | None, str]:
    """A configuration, or what is wrong with it."""
    try:
        return Settings.read(file), ""
    except (InputError, OSError) as error:
        return None, str(error)


def _alone(settings: Settings, verb: str) -> bool:
    """Turn torque off over the bus; whether the servos that answer are limp."""
    from hardware_agent import watchdog
    from hardware_agent.bus import Bus
    from hardware_agent.port import BusError
    from pup.robot import RobotDescription

    try:
        joints = RobotDescription.load(settings.robot).joints
        bus = Bus(settings.bus, [j.servo_id for j in joints if j.servo_id is not None])
        _take(bus)
    except (BusError, InputError) as error:
        _note(verb, f"no agent answers, and no servo was told anything: {error}; {SWITCH}")
        return False
    with closing(bus):
        limp = watchdog.make_limp(bus, PERSISTENCE)
    if limp:
        _note(verb, f"no agent answers; torque was turned off over {settings.bus.port}")
    else:
        _note(
            verb,
            f"no agent answers, and no servo at {settings.bus.port} says that it is limp; {SWITCH}",
        )
    return limp


def _take(bus: "Bus") -> None:
    """Take the bus; the watchdog process of an agent that is gone may have it for a moment."""
    from hardware_agent.port import BusyError

    deadline = time.monotonic() + PERSISTENCE
    while True:
        try:
            bus.take()
            return
        except BusyError:
            if time.monotonic() > deadline:
                raise
        time.sleep(AGAIN)


def _note(verb: str, text: str) -> None:
    print(f"pup-agent {verb}: {' '.join(text.split())}", file=sys.stderr)
