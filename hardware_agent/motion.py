"""The control loop: a thread that owns the body and does the same few things every tick.

Read all sensors, ask the rules of safety, ask the activity for a target, send it.
"""

import gc
import logging
import time
from collections.abc import Callable

import numpy as np

from hardware_agent.activities import (
    Activity,
    Ended,
    Event,
    Hold,
    Lie,
    Play,
    Played,
    Ramp,
    Settle,
    Walk,
    along,
    fallen,
    script_of,
    trial_of,
)
from hardware_agent.body import Body
from hardware_agent.limits import Applied
from hardware_agent.loop import Loop
from hardware_agent.port import BusError
from hardware_agent.rollout import Rollout
from hardware_agent.senses import Response, Senses, Trip
from hardware_agent.status import MotionStatus, Refused, brief
from hardware_agent.watchdog import Watchdog
from pup.errors import InputError
from pup.script import Script
from pup.wire import AgentState, Assign, Outcome

log = logging.getLogger("pup-agent")

REOPEN = 1.0  # s between tries to find a bus that is gone
LATE = Refused("the robot was stopped meanwhile; ask again")
STATISTICS = 33  # ticks between updates of the loop's statistics


class Motion(Loop):
    """The control loop.

    Args:
      body: the robot; only this thread touches it once it runs.
      watchdog: is told of every tick; None in tests that do without.
      emit: called from this thread with what happens to a trial.
    """

    def __init__(
        self, body: Body, watchdog: Watchdog | None, emit: Callable[[Event], None]
    ) -> None:
        super().__init__(body, watchdog, emit)
        self._activity: Activity | None = None
        self._state, self._reason = AgentState.DISABLED, ""
        self._limited: dict[str, str] = {}
        self._hurried = False
        self._count = 0
        self._timing = self.metronome.timing()
        self.status = self._told(None)

    # Requests, from other threads.

    def stop(self, reason: str) -> None:
        """The emergency stop: limp at once, not at the next tick."""
        self._stop_reason = brief(reason)
        self._wake.set()

    def enable(self, stopped: Callable[[], bool]) -> Refused | None:
        """Hold the pose that the robot is in, with full power.

        Args:
          stopped: whether somebody has stopped the robot since this was asked for.
        """
        # Asked again where it is done: a stop may have come since, from any thread.
        return self._ask(lambda senses: LATE if stopped() else self._enable(senses))

    def disable(self) -> Refused | None:
        """Let the robot go limp."""
        return self._ask(self._disable)

    def prepare(
        self, assign: Assign, rollout: Rollout, upright: np.ndarray | None
    ) -> Refused | None:
        """Go to the start pose and stand ready."""
        return self._ask(lambda senses: self._prepare(senses, assign, rollout, upright))

    def go(self, assign: Assign) -> None:
        """The trial that stands ready may run: the journal has it."""
        self._want(lambda senses: self._go(assign))

    def placed(self, assign: Assign, cold: bool = False) -> None:
        """Whoever puts the robot on its feet has done so, or leaves it to the robot.

        Args:
          assign: the trial.
          cold: whether motors are cold now, as only those of a virtual robot can be made.
        """
        self._want(lambda senses: self._placed(assign, cold))

    def pose(self, script: Script, stopped: Callable[[], bool]) -> Refused | None:
        """Go to a script's first pose.

        Args:
          script: which.
          stopped: whether somebody has stopped the robot since this was asked for.
        """
        return self._ask(lambda senses: LATE if stopped() else self._pose(senses, script))

    def play(self, stopped: Callable[[], bool]) -> Refused | None:
        """Play the script whose first pose the robot is in."""
        return self._ask(lambda senses: LATE if stopped() else self._play(senses))

    @property
    def state(self) -> AgentState:
        """Of the robot, as of now; `status` is as of the last tick's end."""
        return self._state

    def cancel(self, reason: str) -> None:
        """End the trial that there is, standing."""
        self._want(lambda senses: self._cancel(reason))

    def measured(self) -> None:
        """How far the robot came is known: time may go on where it stood still for that."""
        if self.metronome.lockstep:
            self._want(lambda senses: None)

    def hurry(self, hurried: bool) -> None:
        """Whether something waits for time to pass: lock-step need not keep to the clock then."""
        self._hurried = hurried

    # The loop.

    def _tick(self, now: float) -> None:
        if self._stop_reason is not None:
            self._stopped()
        if not self._bus and not self._reopen():
            self._tell()
            return
        try:
            doing = self._activity
            alone = doing is not None and doing.alone
            senses = self._body.sense(now, isinstance(doing, Walk), alone)
            if self._body.torque:
                self._move(senses)
            else:
                self._body.guard.rest(senses)
                self._body.confirm_limp(senses)
                self._body.mend(senses)
                self._bus = not self._body.dark(senses)  # without current: opened anew next time
            self._serve(senses)
        except BusError as error:
            self._bus = False
            self._trip(Trip("bus", str(error)), None)
            self._refuse_all(f"bus: {error}")
            self._tell()
            senses = None
        busy = isinstance(self._activity, Ramp | Settle | Walk | Play)
        self.metronome.pace(not (busy or self._hurried))
        self._count += 1
        if self._count % STATISTICS == 0:
            self._timing = self.metronome.timing()
        self.status = self._told(senses)

    def _move(self, senses: Senses) -> None:
        """Ask the rules, then the activity, and send its target."""
        trip = self._body.guard.check(senses)
        if trip is None and self._watchdog is not None and not self._watchdog.alive():
            trip = Trip("watchdog", "its process has ended")
        if trip is not None:
            self._trip(trip, senses)
            return
        doing = self._activity
        assert doing is not None
        target, after = doing.step(senses)
        applied = self._body.command(target, senses.time)
        if isinstance(applied, Trip):
            self._trip(applied, senses)
            return
        self._limited = applied.limited
        if isinstance(after, Walk | Play):
            after.keep(senses, applied)
        self._become(after)
        if isinstance(after, Lie) and not isinstance(doing, Lie):
            self._body.make_safe(Response.SOFT, senses, senses.time)
            if not self._body.torque:
                self._disable(senses)

    def _become(self, activity: Activity) -> None:
        now, before = (isinstance(a, Walk | Play) for a in (activity, self._activity))
        if now != before:
            (gc.disable if now else gc.enable)()
        self._activity, self._state = activity, activity.state

    def _trip(self, trip: Trip, senses: Senses | None) -> None:
        """Make the robot safe, and only then tell."""
        activity = self._activity
        rows_goal = self._body.goal
        was_on = self._body.torque
        self._body.make_safe(trip.response, senses, self.metronome.now())
        gc.enable()
        soft = trip.response is Response.SOFT and self._body.torque
        self._activity = Lie() if soft else None
        if soft:
            self._state = AgentState.ENABLED
        elif was_on or trip.rule in ("bus", "stop"):
            self._state = AgentState.STOPPED if trip.rule == "stop" else AgentState.FAULT
            self._reason = str(trip)
        if isinstance(activity, Walk):
            self._end_walk(activity, trip, senses, rows_goal)
        else:
            self._over(activity, str(trip))

    def _end_walk(self, walk: Walk, trip: Trip, senses: Senses | None, goal: np.ndarray) -> None:
        if senses is not None:
            walk.rollout.keep(senses, Applied(goal, {}), self._body.torque)
        outcome = Outcome.ABORTED
        if trip.rule == "fall":
            outcome = Outcome.SUCCEEDED
        elif trip.rule == "bad target":
            outcome = Outcome.INFEASIBLE
        rows = walk.rollout.rows
        time_walked = rows[-1].time if rows else None
        self._happened(Ended(walk.assign, outcome, str(trip), walk.rollout, time_walked))

    def _stopped(self) -> None:
        self._trip(Trip("stop", self._stop_reason or ""), None)
        self._refuse_all(f"stop: {self._stop_reason}")
        self._stop_reason = None
        self._wake.clear()

    def _reopen(self) -> bool:
        """Look for a bus that is gone; requests that come meanwhile time out."""
        self.status = self._told(None)
        try:
            told = self._body.open()
        except (BusError, InputError) as error:
            self._reason = f"bus: {error}"
            self.status = self._told(None)
            self._wake.wait(REOPEN)
            return False
        for line in told:
            log.info("%s", line)
        if self._state is AgentState.DISABLED:  # nothing was stopped: the robot was switched on
            self._reason = ""
        self._bus = True
        return True

    # What requests do, in this thread.

    def _enable(self, senses: Senses) -> Refused | None:
        if busy := self._busy():
            return busy
        if self._activity is None:
            self._beat(torque=True)  # the watchdog watches from before it is on
            self.metronome.leave_out()
            trip = self._body.enable(senses)
            if trip is not None:
                return Refused(str(trip))
        else:
            self._body.full_power()
        self._reason = ""
        pose = self._body.limiter.within(self._body.goal)
        self._become(Ramp(self._body.goal, pose, self._settings.ramp, Hold(pose)))
        return None

    def _disable(self, senses: Senses) -> Refused | None:
        activity = self._activity
        self._body.limp()
        gc.enable()
        self._activity = None
        self._state, self._reason = AgentState.DISABLED, ""
        self._over(activity, "disabled")
        return None

    def _prepare(
        self, senses: Senses, assign: Assign, rollout: Rollout, upright: np.ndarray | None
    ) -> Refused | None:
        if refused := self._idle():
            return refused
        begin = self._taken_up(senses)
        settle = Settle(assign, rollout, upright, self._settings, self._happened)
        self._become(Ramp(begin, rollout.pose, self._settings.ramp, settle, AgentState.ARMED))
        return None

    def _pose(self, senses: Senses, script: Script) -> Refused | None:
        if refused := self._idle():
            return refused
        ramp, begin = self._settings.ramp, self._taken_up(senses)
        self._become(along((begin, *script.way), ramp, Play(script, ramp, self._happened)))
        return None

    def _play(self, senses: Senses) -> Refused | None:
        if not isinstance(self._activity, Play) or self._activity.go:
            return Refused("no script waits in its first pose")
        if self._activity.script.support == "ground" and fallen(senses):
            return Refused("the robot lies; put it on its feet")
        self._activity.go = True
        return None

    def _idle(self) -> Refused | None:
        """Why the robot cannot begin with anything; None where it can."""
        if self._activity is None:
            return Refused(f"the robot is {self._state}; enable it first")
        return self._busy()

    def _busy(self) -> Refused | None:
        if trial_of(self._activity) is not None:
            return Refused("a trial is under way")
        if script_of(self._activity) is not None:
            return Refused("a script is under way")
        return None

    def _taken_up(self, senses: Senses) -> np.ndarray:
        """The pose to begin from; with full power where the robot lay."""
        if not isinstance(self._activity, Lie):
            return self._body.goal
        self._body.command(senses.position, senses.time)
        self._body.full_power()
        self._body.guard.reset()
        return senses.position

    def _go(self, assign: Assign) -> None:
        if isinstance(self._activity, Settle) and self._activity.assign == assign:
            self._activity.go = True

    def _placed(self, assign: Assign, cold: bool) -> None:
        trial = trial_of(self._activity)
        if isinstance(trial, Settle) and trial.assign == assign:
            trial.placed = True
            if cold:
                self._body.guard.warm(0.0)

    def _cancel(self, reason: str) -> None:
        trial = trial_of(self._activity)
        if isinstance(trial, Walk):
            trial.cancelled = True
        elif trial is not None:
            self._over(trial, reason)
            self._become(Hold(self._body.goal))

    # The rest.

    def _over(self, activity: Activity | None, reason: str) -> None:
        """A trial or a script ends before it has walked, or come to its end."""
        if (trial := trial_of(activity)) is not None:
            self._happened(Ended(trial.assign, Outcome.ABORTED, reason, trial.rollout))
        elif (play := script_of(activity)) is not None:
            self._happened(Played(play.script, play.rows, reason))

    def _told(self, senses: Senses | None) -> MotionStatus:
        return MotionStatus(
            state=self._state,
            reason=self._reason,
            tick=time.monotonic(),
            bus=self._bus,
            senses=senses,
            timing=self._timing,
            repeated=self._body.repeated,
            lost=self._body.lost,
            limited=self._limited,
            heat=self._body.guard.heat,
            doubted=self._body.long_doubted,
            limp=self._bus and not self._body.torque and not self._body.doubted,
        )
