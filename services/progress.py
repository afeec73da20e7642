"""Progress on standard error: a live table on a terminal, plain lines when piped.

Whoever tells of it also learns that the job shall stop, where a library has swallowed that.
"""

import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

from rich.console import Console
from rich.live import Live
from rich.table import Table

from services import stopping
from workers.fits import Status

PLAIN_SECONDS = 10.0


class Reporter(Protocol):
    """Told how far a stage is."""

    def __call__(self, stage: str, statuses: Sequence[Status]) -> None:
        """Show the fits of a stage."""
        ...


@contextmanager
def reporter() -> Iterator[Reporter]:
    """A reporter that fits standard error."""
    if not sys.stderr.isatty():
        yield _Plain()
        return
    with Live(console=Console(stderr=True), refresh_per_second=4, transient=True) as live:
        yield _Table(live)


@contextmanager
def stages() -> Iterator[Callable[[str, float], None]]:
    """Told a job's stage and the share of it that is done; a line for each on standard error."""
    begin = time.monotonic()

    def tell(stage: str, share: float) -> None:
        stopping.check()
        spent = _duration(time.monotonic() - begin)
        print(f"{stage}: {share:.0%} after {spent}", file=sys.stderr, flush=True)

    yield tell


Told = Callable[..., None]
"""Told how many cases are done, of how many, what else there is to say, and the share of the work
that is done and was done at the beginning, for a guess of the time left."""


@contextmanager
def counted(job: str) -> Iterator[Told]:
    """Tells how many cases of a job are done: a live line on a terminal, plain ones when piped."""
    begin, live = time.monotonic(), sys.stderr.isatty()

    def tell(done: int, total: int, note: str = "", share: float | None = None) -> None:
        stopping.check()
        line = f"{job}: {done}/{total} cases"
        if share and done < total:
            left = (time.monotonic() - begin) * (1 - share) / share
            line += f", {_duration(left)} left"
        line += f"; {note}" if note else ""
        start, end = ("\r\x1b[K", "") if live else ("", "\n")
        print(f"{start}{line}", file=sys.stderr, end=end, flush=True)

    try:
        yield tell
    finally:
        if live:
            print(file=sys.stderr)


@contextmanager
def trained() -> Iterator[Callable[[dict[str, Any], int], None]]:
    """Tells how a training gets on: a live line on a terminal, plain ones when piped."""
    live, last, first = sys.stderr.isatty(), -math.inf, None

    def tell(row: dict[str, Any], steps: int) -> None:
        stopping.check()
        nonlocal last, first
        before = time.monotonic()
        first = first or (before, row["steps"])
        if before - last < (0.2 if live else PLAIN_SECONDS) and row["steps"] < steps:
            return
        last, done = before, row["steps"]
        line = (
            f"training: {min(1.0, done / steps):.0%}, {done / 1e6:.2f} of {steps / 1e6:.2f} M steps"
        )
        if done > first[1]:
            rate = (done - first[1]) / (before - first[0])
            line += f", {rate:,.0f}/s, {_duration(max(0, steps - done) / rate)} left"
        if row["distance"] is not None:
            line += f"; {row['distance']:.2f} m in {row['time']:.1f} s"
        start, end = ("\r\x1b[K", "") if live else ("", "\n")
        print(f"{start}{line}", file=sys.stderr, end=end, flush=True)

    try:
        yield tell
    finally:
        if live:
            print(file=sys.stderr)


class _Clock:
    """Time spent and left in a stage, from the share of generations done since it began."""

    def __init__(self) -> None:
        self.stage, self.begin, self.first = "", 0.0, 0.0

    def told(self, stage: str, statuses: Sequence[Status]) -> str:
        """How far a stage is, in words."""
        stopping.check()
        now, share = time.monotonic(), _share(statuses)
        if stage != self.stage:
            self.stage, self.begin, self.first = stage, now, share
        spent = now - self.begin
        done = sum(s.done for s in statuses)
        words = f"{stage}: {share:.0%}, {done}/{len(statuses)} fits done"
        if done == len(statuses):
            return f"{words} in {_duration(spent)}"
        if share == 1:  # what is left of a fit after its generations is short and not counted
            return f"{words}, the last steps left"
        if share == self.first:
            return words
        return f"{words}, {_duration(spent * (1 - share) / (share - self.first))} left"


def _duration(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    return f"{minutes}:{seconds:02d}"


def _share(statuses: Sequence[Status]) -> float:
    total = sum(s.generations for s in statuses)
    return sum(s.generation for s in statuses) / total if total else 1.0


def _loss(status: Status) -> str:
    return f"{status.loss:.4f}" if math.isfinite(status.loss) else "-"


class _Plain:
    def __init__(self) -> None:
        self.clock, self.last = _Clock(), -math.inf

    def __call__(self, stage: str, statuses: Sequence[Status]) -> None:
        told = self.clock.told(stage, statuses)
        now = time.monotonic()
        if now - self.last < PLAIN_SECONDS and not all(s.done for s in statuses):
            return
        self.last = now
        losses = " ".join(f"{s.name}={_loss(s)}" for s in statuses if s.generation)
        print(f"{told}  {losses}".rstrip(), file=sys.stderr, flush=True)


class _Table:
    def __init__(self, live: Live) -> None:
        self.live, self.clock = live, _Clock()

    def __call__(self, stage: str, statuses: Sequence[Status]) -> None:
        table = Table(title=self.clock.told(stage, statuses), title_justify="left")
        for column in ("fit", "generation", "loss"):
            table.add_column(column, justify="left" if column == "fit" else "right")
        for s in statuses:
            table.add_row(s.name, f"{s.generation}/{s.generations}", _loss(s))
        self.live.update(table)
