"""The agent against the virtual robot's bus: how regular its loop is, and how soon it lets go.

    python -m benchmarks.agent jitter --minutes 10
    python -m benchmarks.agent stops --repeats 100

What causes a stop, and from when it is timed: `benchmarks.stops`.
"""

import argparse
import json
import os
import platform
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.stops import PERIOD, enable, stops
from benchmarks.tap import tapped


def jitter(folder: Path, minutes: float) -> dict[str, Any]:
    """Periods between goals on the bus while the robot holds its pose."""
    with tapped(folder) as (made, tap):
        made.start()
        enable(made)
        time.sleep(2.0)
        tap.goals.clear()
        before = made.health()["loop"]["missed"]
        time.sleep(60 * minutes)
        told = made.health()
        periods = np.diff(tap.goals)
        return {
            "ticks": len(periods),
            "nominal_ms": 1000 * PERIOD,
            **{
                f"p{q:g}_ms": round(1000 * float(np.quantile(periods, q / 100)), 3)
                for q in (1, 50, 90, 99, 99.9)
            },
            "longest_ms": round(1000 * float(periods.max()), 3),
            "p99_over_nominal": round(float(np.quantile(periods, 0.99)) / PERIOD, 3),
            "missed": told["loop"]["missed"] - before,
            "state": f"{told['state']} {told['reason']}".strip(),
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    what = parser.add_subparsers(dest="what", required=True)
    what.add_parser("jitter").add_argument("--minutes", type=float, default=10.0)
    stop = what.add_parser("stops")
    stop.add_argument("--repeats", type=int, default=100)
    stop.add_argument("--only", nargs="+", default=(), help="triggers whose name has this")
    options = parser.parse_args()
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        told = (
            jitter(folder, options.minutes)
            if options.what == "jitter"
            else stops(folder, options.repeats, options.only)
        )
    machine = f"{os.cpu_count()} cores, {platform.processor() or platform.machine()}"
    print(
        json.dumps(
            {options.what: told, "machine": machine, "load": [load, os.getloadavg()[0]]}, indent=1
        )
    )


if __name__ == "__main__":
    main()
