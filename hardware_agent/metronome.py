"""The beat of the control loop: absolute deadlines, and none made up for when it was missed."""

import math
import threading
import time
from collections import deque
from dataclasses import dataclass

import numpy as np

KEPT = 2000  # periods for the statistics, a minute at 33 Hz


@dataclass(frozen=True)
class Timing:
    """How regular the loop was.

    Attributes:
      ticks: so far.
      missed: ticks that were left out because the loop was late.
      p50: of the latest periods, s; NaN before there are any.
      p99: likewise.
      longest: likewise.
    """

    ticks: int
    missed: int
    p50: float
    p99: float
    longest: float


class Metronome:
    """Waits for ticks.

    Args:
      period: s.
      lockstep: the time is that of a robot that moves by a period with each command: ticks then
        follow each other as fast as they can, and time is what they count.
    """

    def __init__(self, period: float, lockstep: bool = False) -> None:
        self.period = period
        self.lockstep = lockstep
        self.paced = True
        self._origin = time.monotonic()
        self._beat = 0
        self._ticks = self._missed = 0
        self._time = 0.0
        self._last = math.nan
        self._periods: deque[float] = deque(maxlen=KEPT)

    def wait(self, interrupt: threading.Event) -> float:
        """Sleep until the next tick, or until interrupted.

        A tick whose time is over is left out: commands that pile up would come in a burst.

        Returns:
          The loop's time, s.
        """
        if self.paced:
            self._sleep(interrupt)
        now = time.monotonic()
        if not math.isnan(self._last):
            self._periods.append(now - self._last)
        self._last = now
        self._ticks += 1
        self._time = self._time + self.period if self.lockstep else now
        return self._time

    def _sleep(self, interrupt: threading.Event) -> None:
        now = time.monotonic()
        late = math.floor((now - self._origin) / self.period) - self._beat
        self._beat += 1 + max(0, late)
        self._missed += max(0, late)
        interrupt.wait(self._origin + self._beat * self.period - now)

    def now(self) -> float:
        """The loop's time, s; in lock-step that of the tick."""
        return self._time if self.lockstep else time.monotonic()

    def pace(self, paced: bool) -> None:
        """Whether ticks of a lock-step robot keep to the clock: when nothing waits for them."""
        if self.lockstep and paced != self.paced:
            self.paced = paced
            self._origin, self._beat = time.monotonic(), 0

    def timing(self) -> Timing:
        """How regular the ticks were lately."""
        periods = np.array(self._periods)
        p50, p99 = np.quantile(periods, [0.5, 0.99]) if len(periods) else (math.nan, math.nan)
        longest = float(periods.max()) if len(periods) else math.nan
        return Timing(self._ticks, self._missed, float(p50), float(p99), longest)

    def leave_out(self) -> None:
        """Leave the tick under way out of the statistics: it does what takes longer than one."""
        self._last = math.nan

    def forget(self) -> None:
        """Begin the statistics anew."""
        self._periods.clear()
        self._ticks = self._missed = 0
        self._last = math.nan
