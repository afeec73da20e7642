"""What the benchmarks share: measuring in pairs, and saying what came out.

Two things are measured in turn, A B A B ..., in one process, and compared by the median of the
ratios of neighbours: what else the machine does falls on both alike.
"""

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import psutil

from pup.recording import Recording, load_recordings
from pup.robot import RobotDescription

ROBOT = "darwin_op2"
CORES = len(os.sched_getaffinity(0))


@dataclass(frozen=True)
class Cost:
    """What one run took, s: on the clock, and of the processor on all cores together."""

    wall: float
    processor: float


@dataclass(frozen=True)
class Ratio:
    """Median of the ratios of pairs, with the lowest and highest."""

    median: float
    lowest: float
    highest: float

    def __str__(self) -> str:
        return f"{self.median:.2f} ({self.lowest:.2f} to {self.highest:.2f})"


def cost(action: Callable[[], object]) -> Cost:
    """What an action takes."""
    wall, processor = time.perf_counter(), _processor_time()
    action()
    return Cost(time.perf_counter() - wall, _processor_time() - processor)


def _processor_time() -> float:
    """Of this process and those below it, such as Ray's, s."""
    used = time.process_time()
    for child in psutil.Process().children(recursive=True):
        with suppress(psutil.NoSuchProcess):
            times = child.cpu_times()
            used += times.user + times.system
    return used


def in_turn(actions: Sequence[Callable[[], object]], rounds: int) -> list[list[Cost]]:
    """Costs of actions run in turn, shape (n_actions, rounds); a first round is not counted."""
    costs = [[cost(action) for action in actions] for _ in range(rounds + 1)]
    return [list(of_one) for of_one in zip(*costs[1:], strict=True)]


def ratio(upper: Sequence[float], lower: Sequence[float]) -> Ratio:
    """Ratio of two series of neighbours."""
    values = np.array(upper) / np.array(lower)
    return Ratio(float(np.median(values)), float(values.min()), float(values.max()))


def shipped(robot: RobotDescription, support: str, motion: str = "") -> tuple[Recording, ...]:
    """The recordings that come with a robot, of one support and, if given, one motion type."""
    every = load_recordings([robot.folder / "recordings"])
    return tuple(r for r in every if r.support == support and motion in ("", r.motion))


class Report:
    """Prints lines as they come, and with `--json` all of it as one object in the end.

    Args:
      name: of the benchmark.
      as_json: whether standard output is for the object; lines then go to standard error.
    """

    def __init__(self, name: str, as_json: bool) -> None:
        self.as_json = as_json
        self.document: dict[str, Any] = {
            "benchmark": name,
            "machine": {"cores": CORES, "processor": _processor(), "mujoco": mujoco.__version__},
        }
        self.say(f"{name}: {CORES} cores, {_processor()}, MuJoCo {mujoco.__version__}")

    def say(self, line: str) -> None:
        """Print a line."""
        print(line, file=sys.stderr if self.as_json else sys.stdout, flush=True)

    def add(self, key: str, value: object) -> None:
        """Put a value into the object."""
        self.document[key] = value

    def finish(self) -> None:
        """Print the object, if asked for."""
        if self.as_json:
            print(json.dumps(self.document))


def parser(description: str | None, rounds: int) -> argparse.ArgumentParser:
    """The options that every benchmark has."""
    options = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--json", action="store_true", help="print one JSON object at the end")
    options.add_argument("--rounds", type=int, default=rounds, help="pairs (default: %(default)s)")
    options.add_argument("--threads", type=int, default=CORES, help="default: all cores")
    return options


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((x.split(":", 1)[1].strip() for x in lines if x.startswith("model name")), "")
