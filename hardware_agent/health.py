"""How the agent is, for people, scripts, systemd and the gateway.

The verdict is about what a program or a cable can be blamed for; battery and temperature are told,
and have their own rules of safety.
"""

import math
import time
from importlib.metadata import version
from typing import Any

import numpy as np

from hardware_agent.config import Settings
from hardware_agent.status import MotionStatus
from pup.wire import AgentState

SILENT = 1.0  # s without a tick after which the loop counts as hung
LATE = 1.5  # times the period that the 99th percentile may take
FEWEST = 200  # ticks, of fewer of which it is nearly the longest


def health(
    settings: Settings, status: MotionStatus, watchdog: bool, link: bool | None
) -> dict[str, Any]:
    """The agent's health, as JSON values.

    Args:
      settings: of the agent.
      status: of its control loop.
      watchdog: whether that process lives.
      link: whether the gateway answers; None without one.
    """
    senses = status.senses
    told: dict[str, Any] = {
        "agent": settings.name,
        "version": version("pup"),
        "state": str(status.state),
        "reason": status.reason,
        "problems": _problems(settings, status, watchdog, link),
        "loop": {
            "rate": settings.control.rate,
            "ticks": status.timing.ticks,
            "missed": status.timing.missed,
            "period_p50": _number(status.timing.p50),
            "period_p99": _number(status.timing.p99),
            "period_longest": _number(status.timing.longest),
        },
        "bus": {"works": status.bus, "repeated": status.repeated, "lost": status.lost},
        "limp": status.limp,
        "watchdog": watchdog,
        "link": link,
        "limited": status.limited,
    }
    if senses is not None:
        temperature = np.nan_to_num(senses.temperature, nan=-273.0)
        hottest = int(np.argmax(temperature))
        told["supply"] = _number(senses.supply)
        told["hottest"] = {
            "joint": senses.names[hottest],
            "temperature": _number(float(senses.temperature[hottest])),
        }
        told["position"] = {
            name: _number(round(float(angle), 4))
            for name, angle in zip(senses.names, senses.position, strict=True)
        }
        if senses.imu is not None:
            told["tilt"] = {"roll": senses.imu.roll, "pitch": senses.imu.pitch}
    return told


def _problems(
    settings: Settings, status: MotionStatus, watchdog: bool, link: bool | None
) -> list[str]:
    problems = []
    silent = time.monotonic() - status.tick
    if not status.bus:
        problems.append(status.reason or "the bus does not work")
    elif silent > SILENT:
        problems.append(f"the control loop has not ticked for {silent:.1f} s")
    if status.bus and status.state is AgentState.FAULT:
        problems.append(status.reason)
    senses = status.senses
    if senses is not None and senses.has_imu:
        silent = senses.time - senses.imu_seen
        if silent > max(SILENT, settings.safety.stale):
            problems.append("the IMU does not answer, or tells nothing that can be")
    if status.doubted:
        told = ", ".join(status.doubted[:3])
        more = f" and {len(status.doubted) - 3} more" if len(status.doubted) > 3 else ""
        problems.append(f"{told}{more}: not known to be limp")
    limit = LATE / settings.control.rate
    timed = settings.control.clock == "wall" and status.timing.ticks >= FEWEST
    if timed and status.timing.p99 > limit:
        problems.append(f"the control loop is late: p99 of its period {status.timing.p99:.4f} s")
    if not watchdog:
        problems.append("the watchdog process has ended")
    if link is False:
        problems.append(f"the gateway {settings.link.gateway} does not answer")
    return problems


def _number(value: float) -> float | None:
    return None if math.isnan(value) else float(value)
