"""A tap in the bus between the agent and the virtual robot: what passed, and when.

Two pseudo-terminals whose bytes are passed on and whose packets are noted with their time: times
are those of the bus and not of a log.
"""

import contextlib
import os
import select
import sys
import termios
import threading
import time
import tty
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from agents import Lab, lab

TORQUE, GOAL, LIMIT = 24, 30, 34  # registers of Protocol 1.0
SYNC_WRITE, BULK_READ = 0x83, 0x92
FULL = 1023  # of the torque limit

STRICT = """[bus]
timeout = 0.004
[imu]
timeout = 0.004
[control]
ramp = 0.5
settle = 0.2
[safety]
late = 0.15
stale = 0.02
[watchdog]
timeout = 0.3
"""
"""The defaults that tests on a busy machine soften, and a robot that is soon ready."""


@dataclass
class Tap:
    """Two ends of a bus and what went between them.

    Attributes:
      outer: link for the agent.
      inner: the virtual robot's own.
      goals: times of goals, s of CLOCK_MONOTONIC.
      safes: of torque off, or of its limit being lowered.
      questions: of bulk reads.
    """

    outer: Path
    inner: Path
    goals: list[float] = field(default_factory=list)
    safes: list[float] = field(default_factory=list)
    questions: list[float] = field(default_factory=list)
    ending: bool = False

    def __post_init__(self) -> None:
        self._master, slave = os.openpty()
        tty.setraw(self._master)
        tty.setraw(slave)
        self.outer.unlink(missing_ok=True)
        self.outer.symlink_to(os.ttyname(slave))
        self._far = os.open(self.inner, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self._far)
        settings = termios.tcgetattr(self._far)
        settings[4] = settings[5] = termios.B1000000
        termios.tcsetattr(self._far, termios.TCSANOW, settings)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        left = b""
        while not self.ending:
            ready, _, _ = select.select([self._master, self._far], [], [], 0.2)
            for one in ready:
                try:
                    data = os.read(one, 4096)
                    other = self._far if one == self._master else self._master
                    os.write(other, data)
                except OSError:
                    continue
                if one == self._master:
                    left = self._note(left + data, time.monotonic())

    def _note(self, data: bytes, now: float) -> bytes:
        while (start := data.find(b"\xff\xff\xfe")) >= 0 and len(data) >= start + 7:
            size = data[start + 3] + 4
            if len(data) < start + size:
                return data[start:]
            self._packet(data[start : start + size], now)
            data = data[start + size :]
        return data[-250:]

    def _packet(self, packet: bytes, now: float) -> None:
        if packet[4] == BULK_READ:
            self.questions.append(now)
        if packet[4] != SYNC_WRITE:
            return
        if packet[5] == GOAL:
            self.goals.append(now)
        limited = packet[5] == LIMIT and packet[8] + 256 * packet[9] < FULL
        if limited or (packet[5] == TORQUE and packet[8] == 0):
            self.safes.append(now)

    def close(self) -> None:
        """Stop listening."""
        self.ending = True
        self._thread.join()
        os.close(self._master)
        os.close(self._far)


@contextlib.contextmanager
def tapped(folder: Path, more: str = "") -> Iterator[tuple[Lab, Tap]]:
    """A lab with a tap in its bus.

    Args:
      folder: for everything.
      more: of the agent's configuration, as `agents.lab` has it.
    """
    with lab(folder, more=f'{STRICT}[bus]\nport = "{folder}/tap"\n{more}') as made:
        tap = Tap(folder / "tap", folder / "bus")
        try:
            yield made, tap
        finally:
            made.end()
            tap.close()
