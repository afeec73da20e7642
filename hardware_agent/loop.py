"""What a control loop is besides the robot: its ticks, requests to it, and what it tells.

Others talk to it by requests, which it takes between two ticks, and hear of it by events; nobody
waits for it, and it waits for nobody. Only in lock-step, where the robot's time stands still
between two commands, does it wait for the answer to an event that has one: so a trial does not hang
on how long that takes.
"""

import gc
import os
import queue
import threading
import time
from abc import abstractmethod
from collections.abc import Callable
from contextlib import suppress

from hardware_agent.activities import Ended, Event, Posed, Settled
from hardware_agent.body import Body
from hardware_agent.metronome import Metronome
from hardware_agent.port import BusError
from hardware_agent.request import Request
from hardware_agent.senses import Senses
from hardware_agent.status import MotionStatus, Refused
from hardware_agent.watchdog import Watchdog

PRIORITY = 20  # of the real-time scheduler
STANDSTILL = 10.0  # s, the longest wait for an answer in lock-step
BEAT = 0.05  # s between two beats meanwhile


class Loop(threading.Thread):
    """Ticks until it is closed.

    Args:
      body: the robot; only this thread touches it once it runs.
      watchdog: is told of every tick; None in tests that do without.
      emit: called from this thread with what happens.
    """

    status: MotionStatus

    def __init__(
        self, body: Body, watchdog: Watchdog | None, emit: Callable[[Event], None]
    ) -> None:
        super().__init__(name="motion", daemon=True)
        self._body, self._watchdog = body, watchdog
        self._settings = body.settings.control
        self._emit = emit
        self._events: list[Event] = []
        self.metronome = Metronome(1 / self._settings.rate, self._settings.clock == "lockstep")
        self._requests: queue.SimpleQueue[Request] = queue.SimpleQueue()
        self._wake = threading.Event()
        self._stop_reason: str | None = None
        self._quit = False
        self._bus = body.ready

    def close(self) -> None:
        """End the thread; the robot is limp afterwards."""
        self._quit = True
        self._wake.set()
        if self.ident is not None:
            self.join(timeout=5.0)

    def run(self) -> None:
        """Tick until closed."""
        self._realtime()
        gc.collect()
        gc.freeze()
        try:
            while not self._quit:
                now = self.metronome.wait(self._wake)
                self._beat()
                self._tick(now)
        finally:
            self._body.close()

    @abstractmethod
    def _tick(self, now: float) -> None:
        """Do what is done every tick."""

    def _ask(self, act: Callable[[Senses], Refused | None]) -> Refused | None:
        """From another thread: do something between two ticks, and tell what became of it."""
        request = Request(act)
        self._requests.put(request)
        refused = Refused(f"the control loop does not run: {self.status.reason or 'no bus'}")
        return request.wait(2.0, refused)

    def _want(self, act: Callable[[Senses], None]) -> None:
        """From another thread: have something done between two ticks, however late that is.

        For what is never asked for again: a trial that is told once to run.
        """
        self._requests.put(Request(act))

    def _happened(self, event: Event) -> None:
        """Keep what an activity tells until its target is sent."""
        self._events.append(event)

    def _serve(self, senses: Senses) -> None:
        """Tell what happened, and do what is asked."""
        while (request := self._next(self._tell())) is not None:
            request.run(senses)

    def _tell(self) -> float:
        """Tell what happened; returns for how long time may stand still until it is answered, s."""
        events, self._events = self._events, []
        answered = any(isinstance(event, Posed | Settled | Ended) for event in events)
        if answered and self.metronome.lockstep:
            with suppress(BusError):
                self._body.bus.read()  # once this is answered, what was written has passed
        for event in events:
            self._emit(event)
        return STANDSTILL if answered and self.metronome.lockstep else 0.0

    def _next(self, patience: float) -> "Request | None":
        deadline = time.monotonic() + patience
        while self._requests.empty() and time.monotonic() < deadline:
            if self._stop_reason is not None or self._quit:
                return None
            self._beat()
            with suppress(queue.Empty):
                return self._requests.get(timeout=BEAT)
        if self._requests.empty() or self._stop_reason is not None:
            return None
        return self._requests.get()

    def _refuse_all(self, reason: str) -> None:
        """What was asked before a stop is not done after it."""
        while not self._requests.empty():
            self._requests.get().refuse(Refused(reason))

    def _beat(self, torque: bool = False) -> None:
        if self._watchdog is not None:
            doubted = self._bus and self._body.doubted
            self._watchdog.beat(torque or self._body.torque or doubted)

    def _realtime(self) -> None:
        if self._settings.realtime:
            with suppress(PermissionError, OSError):  # then it is one thread among others
                os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
