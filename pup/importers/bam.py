"""Logs of BAM (Rhoban/bam and forks): one servo swinging a pendulum, JSON.

The recorder sends the goal, waits 1 ms, then reads position, speed and voltage; `timestamp` is the
middle of the reads. In the STS3032 logs, with a row each 5 to 7 ms and about 1.5 ms a read, the
goal of a row is thus sent some 3 ms before its time and the position read some 1.5 ms before it.
The times are taken as they are. A row that repeats a timestamp is left out with a note; a timestamp
that goes back is refused.
"""

from pathlib import Path
from typing import Any

import numpy as np

from pup.errors import InputError
from pup.importers.common import (
    MAX_CELLS,
    Array,
    ImportOptions,
    finite,
    item,
    number,
    parse_json,
    read_text,
    text,
)
from pup.recording import Recording, from_columns

JOINT = "servo"
KNOBS = ("mass", "length", "kp", "vin")


def read(path: Path, options: ImportOptions) -> list[Recording]:
    """Read one log."""
    document = parse_json(read_text(path))
    entries = item(document, "entries")
    if not isinstance(entries, list) or len(entries) * 6 > MAX_CELLS:
        raise InputError(f"'entries' is not a list of at most {MAX_CELLS // 6} rows")
    setup = {knob: number(document, knob) for knob in KNOBS}
    columns = {
        "time": _column(entries, "timestamp"),
        f"target/{JOINT}": _column(entries, "goal_position"),
        f"position/{JOINT}": _column(entries, "position"),
        f"velocity/{JOINT}": _column(entries, "speed"),
        "voltage": _volts(_column(entries, "input_volts"), setup["vin"]),
        "torque_enabled": _column(entries, "torque_enable"),
    }
    for row in np.flatnonzero(np.diff(columns["time"]) < 0) + 1:
        raise InputError(f"column 'timestamp', row {row}: is before that of the row before")
    kept = np.append(True, np.diff(columns["time"]) != 0)[: len(entries)]
    dropped = int(np.sum(~kept))
    columns = {name: values[kept] for name, values in columns.items()}
    return [
        from_columns(
            options.metadata(
                {
                    "id": path.stem,
                    "robot": "servo_bench",
                    "motion": text(document, "trajectory"),
                    "support": "bench",
                    "source": "hardware",
                    "setup": setup,
                    "notes": f"{dropped} rows that repeat a timestamp left out." if dropped else "",
                }
            ),
            columns,
        )
    ]


def _column(entries: list[Any], key: str) -> Array:
    values = []
    for row, entry in enumerate(entries):
        if not isinstance(entry, dict) or key not in entry:
            raise InputError(f"column {key!r}, row {row}: missing")
        values.append(entry[key])
    return finite(values, key, (None,))


def _volts(values: Array, nominal: float) -> Array:
    """Volts; some recorders log the servo's register, in tenths of a volt."""
    tenths = len(values) and abs(np.median(values) / 10 - nominal) < abs(
        np.median(values) - nominal
    )
    return values / 10 if tenths else values
