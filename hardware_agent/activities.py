"""What the robot does between two ticks: one small class each, asked for a target every tick."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hardware_agent.config import ControlSettings
from hardware_agent.limits import Applied
from hardware_agent.rollout import Rollout, Row
from hardware_agent.senses import Senses
from pup.script import FALLEN, Script
from pup.wire import AgentState, Assign, Outcome

Array = NDArray[np.float64]

RETURN = 0.5  # s from where a walk's end left the joints to the pose that stands
WATCHED = 2.0  # s after that in which it may still fall; then people take it
REST = 1.5  # s in a script's first pose before it begins


@dataclass(frozen=True, eq=False)
class Ended:
    """A trial's motion is over.

    Attributes:
      assign: the trial.
      outcome: how it ended.
      reason: in words.
      rollout: that moved the robot; without rows where it did not come to that.
      time: that it walked, s; None where it did not.
    """

    assign: Assign
    outcome: Outcome
    reason: str
    rollout: Rollout
    time: float | None = None


@dataclass(frozen=True)
class Posed:
    """The robot has the pose it starts in; it may be put on its feet."""

    assign: Assign


@dataclass(frozen=True)
class Settled:
    """The robot stands ready; it waits to be told that the trial may run."""

    assign: Assign


@dataclass(frozen=True)
class Walked:
    """A tick of the walk, for whoever watches.

    Attributes:
      assign: the trial.
      number: of the tick.
      time: since the start, s.
    """

    assign: Assign
    number: int
    time: float


@dataclass(frozen=True, eq=False)
class Ready:
    """The robot is in a script's first pose."""

    script: Script


@dataclass(frozen=True, eq=False)
class Played:
    """A script is over.

    Attributes:
      script: which.
      rows: of its ticks.
      reason: why it ended before its end; empty where it did not.
    """

    script: Script
    rows: list[Row]
    reason: str = ""


TrialEvent = Ended | Posed | Settled | Walked
Event = TrialEvent | Ready | Played
Emit = Callable[[Event], None]


class Activity(Protocol):
    """What the robot does.

    Attributes:
      state: what the gateway is told.
      alone: whether the robot is on its own feet, so that a large tilt is a fall.
    """

    state: AgentState

    @property
    def alone(self) -> bool:
        """See above."""

    def step(self, senses: Senses) -> "tuple[Array, Activity]":
        """The target of this tick, rad, and what to do in the next."""


@dataclass(eq=False)
class Hold:
    """Stay."""

    pose: Array
    state: AgentState = AgentState.ENABLED
    alone: bool = False

    def step(self, senses: Senses) -> tuple[Array, Activity]:
        """See Activity."""
        return self.pose, self


@dataclass(eq=False)
class Lie:
    """Yield to whoever lifts the robot: the target is where the joints are."""

    state: AgentState = AgentState.ENABLED
    alone: bool = False

    def step(self, senses: Senses) -> tuple[Array, Activity]:
        """See Activity."""
        return np.where(np.isnan(senses.position), senses.goal, senses.position), self


@dataclass(eq=False)
class Ramp:
    """Go from one pose to another, at first and last slowly.

    Attributes:
      begin: rad.
      end: rad.
      duration: s.
      then: what comes after.
      state: meanwhile.
      alone: meanwhile.
    """

    begin: Array
    end: Array
    duration: float
    then: Activity
    state: AgentState = AgentState.ENABLED
    alone: bool = False
    start: float | None = None

    def step(self, senses: Senses) -> tuple[Array, Activity]:
        """See Activity."""
        if self.start is None:
            self.start = senses.time
        share = min(1.0, (senses.time - self.start) / self.duration)
        smooth = (1 - np.cos(np.pi * share)) / 2
        target = self.begin + smooth * (self.end - self.begin)
        return target, self.then if share >= 1.0 else self


@dataclass(eq=False)
class Settle:
    """Stand in the start pose until the torso is upright and quiet, and the trial may run.

    Attributes:
      assign: the trial.
      rollout: that follows.
      upright: roll and pitch of the torso in the start pose, rad; None without an IMU.
      settings: how near to it, how long, and for how long to try.
      emit: tells of it.
      placed: set when whoever puts the robot on its feet has done so.
      go: set when the journal has it that the trial runs.
    """

    assign: Assign
    rollout: Rollout
    upright: Array | None
    settings: ControlSettings
    emit: Emit
    placed: bool = False
    go: bool = False
    state: AgentState = AgentState.ARMED
    begun: float | None = None
    since: float | None = None
    told: bool = False

    @property
    def alone(self) -> bool:
        """Once it stands ready nobody holds it."""
        return self.told

    def step(self, senses: Senses) -> tuple[Array, Activity]:
        """See Activity."""
        if self.begun is None:
            self.begun = senses.time
            self.emit(Posed(self.assign))
        if not self.placed or not self._quiet(senses):
            self.since = None
        elif self.since is None:
            self.since = senses.time
        ready = self.since is not None and senses.time - self.since >= self.settings.settle
        if self.go:
            walk = Walk(self.assign, self.rollout, self.settings, self.emit)
            return walk.step(senses)
        if ready and not self.told:
            self.told = True
            self.emit(Settled(self.assign))
        if not self.told and senses.time - self.begun > self.settings.patience:
            self.emit(Ended(self.assign, Outcome.ABORTED, "not upright at the start", self.rollout))
            return self.rollout.pose, Hold(self.rollout.pose)
        return self.rollout.pose, self

    def _quiet(self, senses: Senses) -> bool:
        if self.upright is None or senses.imu is None:
            return True
        tilt = np.array([senses.imu.roll, senses.imu.pitch])
        return bool((np.abs(tilt - self.upright) <= self.settings.upright).all())


@dataclass(eq=False)
class Walk:
    """Let the policy move the robot."""

    assign: Assign
    rollout: Rollout
    settings: ControlSettings
    emit: Emit
    cancelled: bool = False
    state: AgentState = AgentState.RUNNING
    alone: bool = True

    def step(self, senses: Senses) -> tuple[Array, Activity]:
        """See Activity."""
        time = self.rollout.time(senses.time)
        if time >= self.assign.horizon - 1e-9:
            return self._end(senses, Outcome.SUCCEEDED, "reached the horizon")
        if self.cancelled:
            return self._end(senses, Outcome.ABORTED, "cancelled while it walked")
        target = self.rollout.target(senses)
        self.emit(Walked(self.assign, len(self.rollout.rows), time))
        return target, self

    def keep(self, senses: Senses, applied: Applied) -> None:
        """Add a tick to what is recorded."""
        self.rollout.keep(senses, applied)

    def _end(self, senses: Senses, outcome: Outcome, reason: str) -> tuple[Array, Activity]:
        time = self.rollout.time(senses.time)
        self.emit(Ended(self.assign, outcome, reason, self.rollout, time))
        pose = self.rollout.pose
        stand = Ramp(pose, pose, WATCHED, Hold(pose), alone=True)
        return Ramp(senses.goal, pose, RETURN, stand, alone=True).step(senses)


@dataclass(eq=False)
class Play:
    """Wait in a script's first pose, play it when told to, and go home.

    Attributes:
      script: which.
      ramp: time from one pose to the next on the way home, s.
      emit: tells of it.
      go: set when it may begin.
      alone: on the ground, once it has begun, but where the robot is to fall.
      rows: of its ticks so far.
    """

    script: Script
    ramp: float
    emit: Emit
    go: bool = False
    state: AgentState = AgentState.RUNNING
    alone: bool = False
    ready: float | None = None
    begun: float | None = None
    home: Activity | None = None
    rows: list[Row] = field(default_factory=list)

    def step(self, senses: Senses) -> tuple[Array, Activity]:
        """See Activity."""
        if self.ready is None:
            self.ready = senses.time
            self.emit(Ready(self.script))
        if self.begun is None:
            if not self.go or senses.time - self.ready < REST:
                return self.script.target[0], self
            self.begun = senses.time
            self.alone = self.script.support == "ground" and not self.script.falls
        time = self._time(senses)
        if self.home is None and time <= self.script.duration + 1e-9 and not self._lies(senses):
            return self.script.at(time), self
        return self._return(senses)

    def keep(self, senses: Senses, applied: Applied) -> None:
        """Add a tick to what is recorded."""
        if self.begun is not None and self.home is None:
            self.rows.append(Row(self._time(senses), senses, applied))

    def _return(self, senses: Senses) -> tuple[Array, Activity]:
        """Home; the script is over when the robot is there."""
        if self.home is None:
            way = (self.script.target[-1], *self.script.back)
            self.home = Lie() if self.script.falls else along(way, self.ramp)
        target, self.home = self.home.step(senses)
        if isinstance(self.home, Ramp):
            return target, self
        self.emit(Played(self.script, self.rows))
        return target, self.home

    def _lies(self, senses: Senses) -> bool:
        return self.script.falls and fallen(senses)

    def _time(self, senses: Senses) -> float:
        assert self.begun is not None
        return round(senses.time - self.begun, 9)


def along(poses: Sequence[Array], ramp: float, then: Activity | None = None) -> Activity:
    """Go from pose to pose, and stay in the last or do something else.

    Args:
      poses: rad, the first of them where the robot is.
      ramp: time from one to the next, s.
      then: what comes after.
    """
    activity = Hold(poses[-1]) if then is None else then
    for begin, end in reversed(list(pairwise(poses))):
        activity = Ramp(begin, end, ramp, activity, activity.state)
    return activity


def fallen(senses: Senses) -> bool:
    """Whether the robot leans as far as one that falls as it should."""
    imu = senses.imu
    return imu is not None and max(abs(imu.roll), abs(imu.pitch)) > FALLEN


def trial_of(activity: Activity | None) -> Settle | Walk | None:
    """The part of a trial that an activity is, or leads to."""
    last = _last(activity)
    return last if isinstance(last, Settle | Walk) else None


def script_of(activity: Activity | None) -> Play | None:
    """The script that an activity plays, or leads to."""
    last = _last(activity)
    return last if isinstance(last, Play) else None


def _last(activity: Activity | None) -> Activity | None:
    while isinstance(activity, Ramp):
        activity = activity.then
    return activity
