"""One trial after the other: from the book to the robot and back.

accepted → (enabled, cool, and let start by whoever stands there) armed → start pose → put on its
feet → settled → written down as running → walking → ended → distance → finished.
"""

import logging
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from enum import StrEnum
from typing import Any

import numpy as np

from hardware_agent.activities import Ended, Posed, Settled, TrialEvent, Walked
from hardware_agent.config import Settings
from hardware_agent.distance import Distance, DistanceError, check_typed
from hardware_agent.journal import JournalError
from hardware_agent.motion import Motion
from hardware_agent.policies import Shelf
from hardware_agent.recordings import Recordings
from hardware_agent.rollout import Rollout
from hardware_agent.trials import End, TrialBook
from pup.errors import InputError
from pup.robot import RobotDescription
from pup.wire import (
    AgentState,
    Armed,
    Assign,
    Body,
    Cancel,
    Finished,
    Outcome,
    Sample,
)

log = logging.getLogger("pup-agent")

SAMPLES = 0.2  # s between two samples
AGAIN = 2.0  # s between two tries to write an end down
LONGEST = 600.0  # s, of a walk
COOL = "cool"  # what a trial waits for while a winding is hot


class Stage(StrEnum):
    """Where the current trial is."""

    NONE = "none"
    WAITING = "waiting"
    POSING = "posing"
    PLACING = "placing"
    SETTLING = "settling"
    RUNNING = "running"
    MEASURING = "measuring"
    ENDING = "ending"


MOVED = (Stage.POSING, Stage.PLACING, Stage.SETTLING, Stage.RUNNING)
"""Stages in which a trial moves the robot, or is about to."""


class Conductor:
    """Runs the trials of a book, in the agent's main thread.

    Args:
      settings: of the agent.
      robot: its description.
      book: of trials.
      motion: the control loop.
      shelf: of policies.
      distance: who measures.
      recordings: of walks.
      send: to the gateway.
    """

    def __init__(
        self,
        settings: Settings,
        robot: RobotDescription,
        book: TrialBook,
        motion: Motion,
        shelf: Shelf,
        distance: Distance,
        recordings: Recordings,
        send: Callable[..., None],
    ) -> None:
        self._settings, self._robot = settings, robot
        self._book, self._motion, self._shelf = book, motion, shelf
        self._distance, self._recordings, self._send = distance, recordings, send
        self._hands = ThreadPoolExecutor(1, "distance")  # for what takes its time
        self.stage = Stage.NONE
        self.waiting = ""
        self._assign: Assign | None = None
        self._rollout: Rollout | None = None
        self._direction = "forward"
        self._armed = False
        self._future: Future[Any] | None = None
        self._end: End | None = None  # of a motion that is over
        self._unkept: np.ndarray | None = None  # rows of its recording, where no disk took them
        self._doubted: float | None = None
        self._sampled = self._written = 0.0
        if (left := book.unmeasured) is not None:  # it walked before the agent was started anew
            self._assign, self._end = left
            self._ask()

    @property
    def trial(self) -> str | None:
        """The current trial's id."""
        return self._assign.trial if self._assign else None

    # What others tell.

    def arm(self) -> None:
        """Whoever stands at the robot lets the trial start.

        Raises:
          InputError: there is none that waits for it.
        """
        if self.stage is not Stage.WAITING or self.waiting != "arm":
            raise InputError("no trial waits to be started")
        self._armed = True

    def skip(self, reason: str) -> None:
        """Whoever stands at the robot does not want the trial.

        Raises:
          InputError: there is none that could be skipped.
        """
        if self._assign is None or self.stage in (Stage.RUNNING, Stage.ENDING):
            raise InputError("no trial can be skipped now; `pup-agent stop` stops one that runs")
        if self.stage is Stage.MEASURING or self.stage is Stage.WAITING:
            self._finish(Outcome.ABORTED, reason)
        else:
            self._motion.cancel(reason)

    def measured(self, distance: float, trial: str | None = None) -> None:
        """Somebody has measured how far the robot came, in m.

        Args:
          distance: m; one that is hard to believe counts where it is told twice in a row.
          trial: that was measured; None for whichever it is that asks.

        Raises:
          InputError: nobody was asked, or the distance is not believed.
        """
        if self.stage is not Stage.MEASURING or self._future is not None or self._assign is None:
            raise InputError("no distance is asked for now")
        if trial not in (None, self._assign.trial):
            raise InputError(f"the distance of {self._assign.trial} is asked for, not of {trial}")
        assert self._end is not None
        sure, self._doubted = distance == self._doubted, distance
        check_typed(distance, self._end.time or 0.0, self._assign.horizon, sure)
        self._finish(Outcome.SUCCEEDED, self._end.reason, distance)

    def cancelled(self, cancel: Cancel) -> None:
        """The gateway takes a trial back."""
        try:
            answers, end = self._book.cancelled(cancel)
        except JournalError:  # the robot stops for it all the same; the rest is told again
            if self._assign is not None and _key(cancel) == _key(self._assign):
                self._motion.cancel("cancelled")
            raise
        self._send(*answers)
        if not end or self._assign is None or _key(cancel) != _key(self._assign):
            return
        if self.stage is Stage.MEASURING:  # it walked, and shall not count all the same
            self._finish(Outcome.ABORTED, "cancelled")
        else:
            self._motion.cancel("cancelled")

    def handle(self, event: TrialEvent) -> None:
        """Something happened in the control loop."""
        if self._assign is None or event.assign != self._assign:
            return
        if isinstance(event, Posed):
            self.stage = Stage.PLACING
            self._future = self._hands.submit(self._distance.start, event.assign, self._direction)
        elif isinstance(event, Settled):
            self._begin()
        elif isinstance(event, Walked):
            self._sample(event)
        else:
            self._over(event)

    def tend(self) -> None:
        """Do what can be done now."""
        current = self._book.current
        if self.stage is Stage.WAITING and current != self._assign:
            self._reset()
        if self.stage is Stage.NONE and current is not None:
            self._take(current)
        if self.stage is Stage.WAITING:
            self._start()
        if self.stage in (Stage.POSING, Stage.PLACING, Stage.SETTLING) and not self._mine(current):
            self._motion.cancel("taken back")
        self._motion.hurry(self.stage is Stage.WAITING and self.waiting == COOL)
        if self._future is not None and self._future.done():
            self._collect(self._future)
        if self.stage is Stage.ENDING and time.monotonic() - self._written > AGAIN:
            self._write_down()

    def told(self, finished: Finished) -> list[Body]:
        """How a trial ended, as the gateway is told: its recording in pieces, then the end."""
        upload = self._settings.link.upload
        return [*(self._recordings.pieces(finished) if upload else ()), finished]

    def close(self) -> None:
        """Leave it to the next start."""
        self._hands.shutdown(wait=False, cancel_futures=True)

    # One stage after the other.

    def _take(self, assign: Assign) -> None:
        self._assign = assign
        try:
            policy = self._shelf.load(assign.policy)
            self._rollout = Rollout(policy, assign.eta, self._settings.control.rate)
            self._direction = policy.card.direction
            self._check(assign, policy.card.observation)
        except (InputError, OSError) as error:  # storage that fails must drop no robot either
            self._finish(Outcome.ABORTED, str(error))
            return
        self.stage, self._armed = Stage.WAITING, False

    def _check(self, assign: Assign, observation: Sequence[str]) -> None:
        if not 0 < assign.horizon <= LONGEST:
            raise InputError(f"a horizon of {assign.horizon:g} s is not between 0 and {LONGEST:g}")
        if self._settings.imu.kind == "none" and any(n.startswith("imu") for n in observation):
            raise InputError("the policy wants to see an IMU, and imu.kind is none")

    def _start(self) -> None:
        assert self._assign is not None and self._rollout is not None
        self.waiting = self._obstacle()
        if self.waiting:
            self._armed = False  # who let it start did so in another situation
            return
        refused = self._motion.prepare(self._assign, self._rollout, self._upright())
        if refused is not None:
            self.waiting = refused.reason
            return
        self.stage = Stage.POSING
        self._send(Armed(self._assign.trial, self._assign.attempt, self._fence()))

    def _obstacle(self) -> str:
        """What the trial waits for; empty when for nothing."""
        status = self._motion.status
        if status.state is not AgentState.ENABLED:
            return "enable"
        if status.senses is not None and not self._settings.distance.renew:
            hottest = np.nanmax(np.append(status.senses.temperature, -273.0))
            safety = self._settings.safety
            if hottest > safety.cool or status.heat > safety.rested:
                return COOL
        if self._settings.control.gate == "operator" and not self._armed:
            return "arm"
        return ""

    def _upright(self) -> np.ndarray | None:
        """The torso's roll and pitch in the start pose, rad."""
        gait = self._robot.gait
        if self._settings.imu.kind == "none" or gait is None:
            return None
        return np.array([0.0, gait.start_pitch or 0.0])

    def _begin(self) -> None:
        assert self._assign is not None
        if not self._mine(self._book.current):
            self._motion.cancel("taken back")
            return
        try:
            self._send(self._book.begin(self._assign))
        except JournalError as error:  # a walk that is not written down could be walked twice
            self._motion.cancel(str(error))
            return
        self._recordings.flight.begin(self._assign)
        self.stage = Stage.RUNNING
        self._motion.go(self._assign)

    def _sample(self, event: Walked) -> None:
        if self._rollout is not None:
            self._recordings.flight.keep(self._rollout.rows)
        if time.monotonic() - self._sampled < SAMPLES:
            return
        self._sampled = time.monotonic()
        try:
            distance = self._distance.now()
        except DistanceError:
            distance = None
        key = (event.assign.trial, event.assign.attempt, self._fence())
        self._send(Sample(*key, event.number, event.time, distance))

    def _over(self, event: Ended) -> None:
        """The motion has ended; the distance is taken at once, before the robot is touched."""
        self._future = None
        ended = event.outcome is Outcome.SUCCEEDED
        if ended and not self._distance.asks:
            self.stage, self._future = Stage.MEASURING, self._hands.submit(self._distance.end)
        self._unkept = np.array([row.values for row in event.rollout.rows])
        self._end = self._with_recording(End(event.outcome, event.reason, None, event.time))
        if not ended:
            self._finish(event.outcome, event.reason)
        elif self._distance.asks:
            try:
                self._book.walked(event.assign, self._end)  # before anybody goes for the tape
            except JournalError as error:  # then the distance has to come before a restart
                log.error("%s", error)
            self._ask()

    def _with_recording(self, end: End) -> End:
        """The end with its recording, where there is one and the disk takes it now."""
        assert self._assign is not None
        if self._unkept is None:
            return end
        kept = self._recordings.keep(self._assign, self._unkept, end.reason)
        if kept is None:
            return end
        self._unkept = None
        return replace(end, recording=kept[0], digest=kept[1])

    def _ask(self) -> None:
        """Have somebody tell how far the robot came."""
        self.stage, self.waiting = Stage.MEASURING, "distance"

    def _collect(self, future: Future[Any]) -> None:
        self._future = None
        try:
            told = future.result()
        except DistanceError as error:
            if self.stage is Stage.MEASURING:
                self._finish(Outcome.ABORTED, str(error))
            else:
                self._motion.cancel(str(error))
            return
        if self.stage is Stage.PLACING and self._assign is not None:
            self.stage = Stage.SETTLING
            self._motion.placed(self._assign, cold=self._settings.distance.renew)
        elif self.stage is Stage.MEASURING:
            self._believe(told)

    def _believe(self, told: float) -> None:
        """End the trial with the distance of a program; one in millimetres, say, never counts."""
        assert self._end is not None and self._assign is not None
        try:
            check_typed(told, self._end.time or 0.0, self._assign.horizon, sure=True)
        except InputError as error:
            self._finish(Outcome.ABORTED, str(error))
        else:
            self._finish(Outcome.SUCCEEDED, self._end.reason, told)

    def _finish(self, outcome: Outcome, reason: str, distance: float | None = None) -> None:
        walked = self._end or End(outcome, reason)
        self._end = replace(walked, outcome=outcome, reason=reason, distance=distance)
        self.stage, self.waiting = Stage.ENDING, "journal"
        self._write_down()

    def _write_down(self) -> None:
        """Write the trial's end down, and only then tell it; again later where that fails.

        The robot stays as it is meanwhile: it stands, and nobody may be holding it.
        """
        assert self._assign is not None and self._end is not None
        self._written = time.monotonic()
        self._end = self._with_recording(self._end)
        try:
            finished = self._book.finish(self._assign, self._end)
        except JournalError as error:
            log.error("%s; the end of %s waits for it", error, self._assign.trial)
            return
        self._send(*self.told(finished))
        self._reset()
        self._motion.measured()

    def _reset(self) -> None:
        self.stage, self.waiting = Stage.NONE, ""
        self._assign = self._rollout = self._end = self._future = self._unkept = None
        self._armed, self._doubted = False, None

    def _mine(self, current: Assign | None) -> bool:
        """Whether the book's trial is still the one at work here."""
        both = current is not None and self._assign is not None
        return both and _key(current) == _key(self._assign)

    def _fence(self) -> int:
        assert self._assign is not None
        return self._book.fence(self._assign)


def _key(told: Assign | Cancel) -> tuple[str, int]:
    return told.trial, told.attempt
