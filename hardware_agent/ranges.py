"""Which values keys of `agent.toml` may have.

Those of `[safety]` end where a rule would say nothing any more: a tilt in degrees, a time in ms, a
root mean square of the stall current itself, which a stalled motor never gets beyond.
"""

from collections.abc import Mapping
from typing import Any

from hardware_agent.mounting import LAST
from pup.robot_toml import Table

CHOICES: Mapping[tuple[str, str], tuple[object, ...]] = {
    ("BusSettings", "protocol"): (1, 2),
    ("BusSettings", "read"): ("bulk", "sync"),
    ("BusSettings", "write"): ("sync", "bulk"),
    ("BusSettings", "detail"): ("all", "rotating"),
    ("Mounting", "sign"): (1, -1),
    ("ImuSettings", "kind"): ("bno055-uart", "bno055-i2c", "cm740", "none"),
    ("ControlSettings", "clock"): ("wall", "lockstep"),
    ("ControlSettings", "gate"): ("operator", "auto"),
    ("ControlSettings", "source"): ("hardware", "simulation"),
    ("DistanceSettings", "kind"): ("operator", "hook", "virtual"),
}
"""By kind of settings and key."""
VOLTAGE = 5.0, 20.0
"""V, of a supply that an MX-28 survives."""
LIMITS: Mapping[tuple[str, str], tuple[float, float]] = {
    ("BusSettings", "timeout"): (0.0005, 1.0),
    ("BusSettings", "tries"): (1, 10),
    ("BusSettings", "board"): (0, 252),
    ("Mounting", "zero"): (0, LAST),
    ("ImuSettings", "timeout"): (0.0005, 1.0),
    ("ControlSettings", "rate"): (5.0, 500.0),
    ("ControlSettings", "ramp"): (0.5, 60.0),
    ("ControlSettings", "settle"): (0.0, 60.0),
    ("ControlSettings", "patience"): (0.1, 3600.0),
    ("ControlSettings", "upright"): (0.01, 1.6),
    ("SafetySettings", "stale"): (0.001, 1.0),
    ("SafetySettings", "late"): (0.001, 2.0),
    ("SafetySettings", "speed"): (0.1, 100.0),
    ("SafetySettings", "temperature"): (20.0, 80.0),
    ("SafetySettings", "cool"): (20.0, 80.0),
    ("SafetySettings", "heating"): (0.01, 5.0),
    ("SafetySettings", "heating_time"): (1.0, 60.0),
    ("SafetySettings", "current"): (0.01, 0.95),
    ("SafetySettings", "current_time"): (0.1, 60.0),
    ("SafetySettings", "rested"): (0.01, 1.0),
    ("SafetySettings", "duty_per_radian"): (0.1, 1000.0),
    ("SafetySettings", "free_speed"): (0.5, 20.0),
    ("SafetySettings", "lag"): (0.001, 1.0),
    ("SafetySettings", "stuck_time"): (0.05, 2.0),
    ("SafetySettings", "stuck_angle"): (0.02, 1.0),
    ("SafetySettings", "frozen"): (0.1, 5.0),
    ("SafetySettings", "fall_tilt"): (0.1, 1.6),
    ("SafetySettings", "fall_lead"): (0.0, 1.0),
    ("SafetySettings", "fallen_power"): (0.0, 1.0),
    ("WatchdogSettings", "timeout"): (0.05, 10.0),
    ("LinkSettings", "heartbeat"): (0.05, 60.0),
    ("LinkSettings", "liveness"): (1.0, 100.0),
}
"""Likewise; least and largest."""


def check(table: Table, kind: str, key: str, value: Any) -> None:
    """Refuse a value that cannot be.

    Args:
      table: where it stands.
      kind: name of the class of its settings.
      key: of it there.
      value: that was read.

    Raises:
      InputError: see the message.
    """
    choices = CHOICES.get((kind, key))
    if choices is not None and value not in choices:
        told = ", ".join(repr(c) for c in choices)
        raise table.mistake(key, f"{value!r}; use one of {told}")
    if choices is None and type(value) in (int, float):
        low, high = LIMITS.get((kind, key), (1e-6, 1e9))
        if not low <= value <= high:
            raise table.mistake(key, f"{value:g} is outside [{low:g}, {high:g}]")
