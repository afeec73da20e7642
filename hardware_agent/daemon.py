"""The agent: one process that owns the robot, and what it says to those outside.

The control loop is a thread that waits for nobody, and so is the link to the gateway; an emergency
stop is done by whoever hears of it. This is everything else, in one loop: what the gateway says,
commands of this computer, trials, systemd.
"""

import logging
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any

from hardware_agent.activities import Event, Played, Ready
from hardware_agent.body import Body as RobotBody
from hardware_agent.conductor import MOVED, Conductor, Stage
from hardware_agent.config import Settings
from hardware_agent.control import ControlServer
from hardware_agent.distance import distance_of
from hardware_agent.health import health
from hardware_agent.journal import Journal, JournalError, own
from hardware_agent.link import Link
from hardware_agent.link_thread import LinkThread
from hardware_agent.motion import LATE, Motion
from hardware_agent.policies import Shelf
from hardware_agent.port import BusError, BusyError
from hardware_agent.recordings import Recordings
from hardware_agent.scripts import Scripts
from hardware_agent.status import brief
from hardware_agent.stopper import Stopper
from hardware_agent.systemd import notify
from hardware_agent.trials import TrialBook
from hardware_agent.warmth import Warmth
from hardware_agent.watchdog import Watchdog
from pup.errors import InputError
from pup.robot import RobotDescription
from pup.wire import (
    Acknowledge,
    AgentState,
    Assign,
    Body,
    Cancel,
    Heartbeat,
    Hello,
    Message,
    Policy,
    Stop,
)

log = logging.getLogger("pup-agent")

TURN = 0.05  # s, the longest sleep of the loop
RESEND = 2.0  # s between two sendings of an end that is not acknowledged
TAKEOVER = 5.0  # s that another process may still have the bus
PATIENCE = 5.0  # s that a command waits for the loop
UNASKED = (
    'control.gate is "operator": whoever stands at the robot has to agree to each script; '
    '--auto needs gate = "auto"'
)
CONFIRMED = 1.5  # s in which all servos should have said that they are limp
MOVING = ("enable", "arm", "pose", "play")  # commands that are not done once the robot was stopped


@dataclass
class Call:
    """A command that waits for the loop.

    Attributes:
      command: what was asked.
      stops: emergency stops by then.
      done: the answer.
    """

    command: dict[str, Any]
    stops: int
    done: Future[Any] = field(default_factory=Future)


class Agent:
    """The agent.

    Args:
      settings: of it.

    Raises:
      InputError: a part of the configuration cannot work here.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._robot = RobotDescription.load(settings.robot)
        self._body = RobotBody(settings, self._robot)
        self._recordings = Recordings(settings.state, self._robot, settings.control.source)
        self._owned = own(settings.state)  # before what another agent may be writing is read
        self._journal = Journal(settings.state / "journal")
        self._book = TrialBook(self._journal, self._recordings.salvage)
        self._warmth = Warmth(settings.state / "warmth", settings.safety.current_time)
        self._body.guard.warm(self._warmth.left())
        self._shelf = Shelf(settings.policies, self._robot)
        self._events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._calls: queue.SimpleQueue[Call] = queue.SimpleQueue()
        self._stops = 0
        self._bell = threading.Event()
        self._heard: queue.SimpleQueue[Message] = queue.SimpleQueue()
        self._met = threading.Event()  # the gateway, and it has not been told hello
        self._announced: tuple[Policy, ...] = ()
        self._link: LinkThread | None = None
        if settings.link.gateway:
            self._link = LinkThread(Link(settings.link, self._meet), self._hear)
        self._control = ControlServer(settings.socket, self.answer, self._left)
        self._stopper = Stopper(settings.stop.command, self._pressed)
        self._ending = False
        self._beaten = self._resent = 0.0
        self._seen: tuple[AgentState, bool] | None = None

    def run(self) -> None:
        """Open the robot and serve until told to end; the robot is limp then."""
        self._open()
        bus = self._settings.bus
        self._watchdog = Watchdog(
            bus.port, bus.baud, bus.protocol, self._body.ids, self._settings.watchdog.timeout
        )
        self._motion = Motion(self._body, self._watchdog, self._happened)
        self._conductor = Conductor(
            self._settings,
            self._robot,
            self._book,
            self._motion,
            self._shelf,
            distance_of(self._settings.distance),
            self._recordings,
            self._send,
        )
        scripts, source = self._settings.state / "scripts", self._settings.control.source
        self._scripts = Scripts(self._robot, self._motion, scripts, source)
        self._motion.start()
        self._control.start()
        if self._link is not None:
            self._link.start()
        log.info("ready: %s, torque is off", self._settings.name)
        notify("READY=1")
        try:
            while not self._ending:
                self._turn()
                if not self._motion.is_alive():  # its error stands in the log
                    raise RuntimeError("the control loop has ended")
                if self._link is not None and not self._link.is_alive():  # likewise
                    raise RuntimeError("the link's thread has ended")
        finally:
            self._close()

    def end(self) -> None:
        """End the agent at its next turn, from a signal or another thread."""
        self._ending = True  # no more: a signal may come while the loop holds the bell's lock

    def answer(self, command: dict[str, Any]) -> dict[str, Any]:
        """Do a command of this computer; called from other threads.

        Raises:
          InputError: it cannot be done; the message says why.
        """
        if command.get("do") == "stop":  # before anything that may be busy
            self._stop(str(command.get("reason", "at the robot's computer")))
            return {"limp": self._limp()}
        if command.get("do") == "health":
            return self.health()
        call = Call(command, self._stops)
        self._calls.put(call)
        self._bell.set()
        try:
            return call.done.result(timeout=PATIENCE) or {}
        except TimeoutError as error:
            if call.done.cancel():
                raise InputError("the agent is busy; nothing was done") from error
            raise InputError("the agent is still at it; `pup-agent health` tells more") from error

    def _limp(self) -> bool:
        """Whether all servos say, within a while, that they are limp."""
        end = time.monotonic() + CONFIRMED
        while not self._motion.status.limp and time.monotonic() < end:
            time.sleep(0.02)
        return self._motion.status.limp

    def health(self) -> dict[str, Any]:
        """See `hardware_agent.health`."""
        link = None if self._link is None else self._link.connected
        told = health(self._settings, self._motion.status, self._watchdog.alive(), link)
        if self._journal.trouble:
            told["problems"].append(self._journal.trouble)
        conductor = self._conductor
        return told | {
            "robot": self._robot.name,
            "trial": conductor.trial,
            "stage": str(conductor.stage),
            "waiting": conductor.waiting,
            "script": self._scripts.told,
        }

    def _open(self) -> None:
        """Take the robot; the watchdog of an agent that was killed may have it for a moment."""
        deadline = time.monotonic() + TAKEOVER
        while True:
            try:
                for told in self._body.open():
                    log.info("%s", told)
            except BusyError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.2)
                continue
            except BusError as error:  # it may be switched on later
                log.warning("%s; trying again", error)
            return

    def _turn(self) -> None:
        """Sleep until something happens, and see to everything."""
        self._bell.wait(TURN)
        self._bell.clear()
        while not self._calls.empty():
            self._answer(self._calls.get())
        if self._met.is_set():
            self._met.clear()
            self._send(*self._hello())
            self._beaten = 0.0  # a hello tells no state
        while not self._heard.empty():
            message = self._heard.get()
            try:
                self._receive(message)
            except JournalError as error:  # neither done nor answered; the gateway tells it again
                log.error("%s: not taken: %s", type(message.body).__name__, error)
        while not self._events.empty():
            event = self._events.get()
            if isinstance(event, Ready | Played):
                self._scripts.handle(event)
            else:
                self._conductor.handle(event)
        self._conductor.tend()
        self._beat()

    def _answer(self, call: Call) -> None:
        if not call.done.set_running_or_notify_cancel():  # who asked has been told that it is not
            return
        try:
            call.done.set_result(self._command(call))
        except InputError as error:
            call.done.set_exception(error)
        except Exception as error:  # a command must not end who holds the robot
            log.exception("a command failed")
            call.done.set_exception(InputError(f"the agent failed at it: {brief(str(error))}"))

    def _stop(self, reason: str) -> None:
        """The emergency stop; what was asked before it is not done after it. From any thread."""
        self._stops += 1
        self._motion.stop(reason)

    def _left(self) -> None:
        """Whoever stood at the robot is gone: nobody could stop it any more. From any thread."""
        moved = self._conductor.stage in MOVED or self._scripts.told["stage"]
        if moved and not self._ending:
            self._stop("the operator's terminal is gone")

    def _meet(self) -> None:
        """A connection has come about; from the link's thread."""
        self._met.set()
        self._bell.set()

    def _hear(self, message: Message) -> None:
        """A message has come; from the link's thread. A stop is done there and then."""
        if isinstance(message.body, Stop):
            self._stop(f"gateway: {message.body.reason}")
            return
        self._heard.put(message)
        self._bell.set()

    def _receive(self, message: Message) -> None:
        body = message.body
        if isinstance(body, Assign):
            answers = self._book.assigned(body)
            if not answers:
                log.warning("trial %s, attempt %d: not taken", body.trial, body.attempt)
            self._send(*answers)
        elif isinstance(body, Cancel):
            self._conductor.cancelled(body)
        elif isinstance(body, Acknowledge):
            self._book.acknowledged(body)

    def _command(self, call: Call) -> dict[str, Any] | None:
        def stopped() -> bool:
            return call.stops != self._stops

        do = call.command.get("do")
        if do in MOVING and stopped():
            raise InputError(LATE.reason)
        if do == "enable":
            self._stopper.watch()
            refused = self._motion.enable(stopped)
        elif do == "disable":
            refused = self._motion.disable()
        elif do in ("pose", "play"):
            self._script(call.command, stopped)
            return None
        else:
            self._order(call.command)
            return None
        if refused is not None:
            raise InputError(refused.reason)
        return {"state": str(self._motion.state)}

    def _script(self, command: dict[str, Any], stopped: Callable[[], bool]) -> None:
        """What the operator lets the robot play; whoever asks has to say that he did."""
        if self._settings.control.gate == "operator" and command.get("agreed") is not True:
            raise InputError(UNASKED)
        if command["do"] == "play":
            self._scripts.play(stopped)
        elif self._conductor.stage in (Stage.NONE, Stage.WAITING):
            script, repeat_of = command.get("script"), command.get("repeat_of")
            self._scripts.pose(script, repeat_of, command.get("setup", {}), stopped)
        else:
            raise InputError("a trial is under way")

    def _order(self, command: dict[str, Any]) -> None:
        """What the operator tells of a trial."""
        do = command.get("do")
        if do == "arm":
            self._conductor.arm()
        elif do == "skip":
            self._conductor.skip(brief(str(command.get("reason", "skipped by the operator"))))
        elif do == "distance":
            told = command.get("distance")
            if isinstance(told, bool) or not isinstance(told, int | float):
                raise InputError("distance is no number of metres")
            self._conductor.measured(float(told), command.get("trial"))
        else:
            raise InputError(f"{do!r} is no command of this agent")

    def _pressed(self) -> None:
        """The command of the emergency stop has ended."""
        if not self._ending:
            self._stop("the emergency stop's command has ended")

    def _beat(self) -> None:
        now = time.monotonic()
        self._warmth.keep(self._motion.status.heat)
        state, limp = self._motion.status.state, self._motion.status.limp
        if self._seen is None or state is not self._seen[0]:
            log.info("%s %s", state, self._motion.status.reason)
        changed, self._seen = self._seen != (state, limp), (state, limp)
        if now - self._motion.status.tick < 2.0 or not self._motion.status.bus:
            notify("WATCHDOG=1", f"STATUS={state} {self._motion.status.reason}")
        if self._link is None:
            return
        if now - self._beaten >= self._settings.link.heartbeat or changed:
            self._beaten = now
            if self._shelf.policies() != self._announced:
                self._met.set()
            told = self.health()
            self._send(Heartbeat(self._settings.name, state, told, self._conductor.trial))
        if now - self._resent >= RESEND:
            self._resent = now
            self._send(*self._owed())

    def _hello(self) -> list[Body]:
        self._announced = self._shelf.policies()
        hello = Hello(
            self._settings.name,
            self._robot.name,
            version("pup"),
            self._announced,
            self._book.entries(),
        )
        return [hello, *self._owed()]

    def _owed(self) -> list[Body]:
        """What the gateway has not acknowledged; with recordings, which may have been cut off."""
        return [body for end in self._book.owed for body in self._conductor.told(end)]

    def _send(self, *bodies: Body) -> None:
        if self._link is not None:
            self._link.send(*bodies)

    def _happened(self, event: Event) -> None:
        self._events.put(event)
        self._bell.set()

    def _close(self) -> None:
        """Limp, then silent."""
        notify("STOPPING=1")
        self._motion.close()
        self._watchdog.close()
        self._stopper.close()
        self._control.close()
        self._conductor.close()
        if self._link is not None:
            self._link.close()
        log.info("ended, torque is off")
