"""Trials as the agent knows them: what may still be run, what was, and what is owed to the gateway.

Messages come at least once, late and in any order; a trial's motion comes at most once. Whatever is
decided here is in the journal before it is answered or acted upon.
"""

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from typing import Any

from hardware_agent.journal import Journal
from hardware_agent.status import brief
from pup.wire import (
    Accepted,
    Acknowledge,
    Assign,
    Body,
    Cancel,
    Finished,
    JournalEntry,
    Outcome,
    Progress,
    Running,
)

RESTARTED = "agent restarted"
NAMESAKE = "this agent knows another trial by this name; attempt it again and it walks"
Key = tuple[str, int]
"""Trial and attempt."""


class Event(StrEnum):
    """Entries of the journal.

    Attributes:
      ACCEPTED: a trial was taken on, or its fence grew.
      RUNNING: its motion is about to begin.
      WALKED: its motion is over, and somebody is asked for its distance.
      FINISHED: it is over.
      ACKNOWLEDGED: the gateway has stored its end.
    """

    ACCEPTED = "accepted"
    RUNNING = "running"
    WALKED = "walked"
    FINISHED = "finished"
    ACKNOWLEDGED = "acknowledged"


@dataclass(frozen=True)
class End:
    """How a trial ended.

    Attributes:
      outcome: in a word.
      reason: in words, for people.
      distance: m; None where none was measured.
      time: until the fall or the end, s; None where the robot did not move.
      recording: id of the recording, if there is one.
      digest: SHA-256 of its file.
    """

    outcome: Outcome
    reason: str
    distance: float | None = None
    time: float | None = None
    recording: str | None = None
    digest: str | None = None


@dataclass(frozen=True)
class Trial:
    """A trial.

    Attributes:
      fence: newest that was seen.
      assign: what to do; None where only a cancellation came.
      running: whether its motion has begun.
      walked: how its motion ended, where somebody was asked for its distance.
      finished: how it ended.
      acknowledged: whether the gateway knows.
    """

    fence: int
    assign: Assign | None = None
    running: bool = False
    walked: End | None = None
    finished: Finished | None = None
    acknowledged: bool = False


class TrialBook:
    """All trials of a journal.

    A motion that was under way when the journal was written last is over: it becomes aborted, but
    where it had ended and only its distance was awaited; that can still be measured.

    Args:
      journal: where they stand.
      salvage: how such a motion ended; it may have left a recording.
    """

    def __init__(self, journal: Journal, salvage: Callable[[Assign], "End"] | None = None) -> None:
        self._journal = journal
        self._trials: dict[Key, Trial] = {}
        for entry in journal.entries:
            self._replay(entry)
        for key, trial in list(self._trials.items()):
            if trial.running and trial.finished is None and trial.walked is None:
                known = salvage and trial.assign and salvage(trial.assign)
                self._finish(key, known or End(Outcome.ABORTED, RESTARTED))
            elif trial.assign is None and trial.finished is None:
                self._finish(key, End(Outcome.ABORTED, "cancelled"))

    @property
    def current(self) -> Assign | None:
        """The trial to run or being run."""
        for trial in self._trials.values():
            if trial.finished is None and trial.assign is not None:
                return trial.assign
        return None

    @property
    def running(self) -> bool:
        """Whether the current trial's motion has begun."""
        return any(t.running and t.finished is None for t in self._trials.values())

    @property
    def unmeasured(self) -> tuple[Assign, End] | None:
        """The trial whose motion is over and whose distance is awaited, and how that ended."""
        for trial in self._trials.values():
            if trial.finished is None and trial.assign is not None and trial.walked is not None:
                return trial.assign, trial.walked
        return None

    @property
    def owed(self) -> list[Finished]:
        """Ends that the gateway has not acknowledged."""
        return [t.finished for t in self._trials.values() if t.finished and not t.acknowledged]

    def entries(self) -> tuple[JournalEntry, ...]:
        """For `Hello`: what is open between the gateway and this agent."""
        return tuple(
            JournalEntry(name, attempt, trial.fence, _progress(trial))
            for (name, attempt), trial in self._trials.items()
            if not trial.acknowledged
        )

    def assigned(self, assign: Assign) -> list[Body]:
        """A trial was handed out to this agent; returns what to answer.

        One that is known is never run again: where it stands is told anew. A newer fence is taken
        over, an older one is from a gateway that has been replaced, and gets no answer. A gateway
        whose database was restored may call another trial by a name that is known: what was walked
        then is no answer to it, whatever its fence.
        """
        if namesakes := self._namesakes(assign):
            return [self._refused(assign, namesakes)]
        key = (assign.trial, assign.attempt)
        known = self._trials.get(key)
        if known is None:
            if not self._free_for(assign):
                return []
            self._record(key, Trial(assign.fence, assign))
        elif assign.fence < known.fence:
            return []
        elif assign.fence > known.fence:
            self._record(key, _refenced(known, assign))
        return list(self._standing(key))

    def cancelled(self, cancel: Cancel) -> tuple[list[Body], bool]:
        """A trial shall not run.

        Returns:
          What to answer, and whether its motion must be ended first; `finish` then tells the rest.
        """
        key = (cancel.trial, cancel.attempt)
        known = self._trials.get(key)
        if known is not None and cancel.fence < known.fence:
            return [], False
        if known is None:  # it has overtaken the trial, which will find itself cancelled
            self._record(key, Trial(cancel.fence))
        elif cancel.fence > known.fence and known.assign is not None:
            self._record(key, _refenced(known, replace(known.assign, fence=cancel.fence)))
        known = self._trials[key]
        if known.running and known.finished is None:
            return [], True
        if known.finished is None:
            self._finish(key, End(Outcome.ABORTED, "cancelled"))
        return list(self._standing(key)), False

    def acknowledged(self, message: Acknowledge) -> None:
        """The gateway has stored something."""
        if message.trial is None or message.attempt is None:
            return
        key = (message.trial, message.attempt)
        known = self._trials.get(key)
        if known is None or known.finished is None or known.acknowledged:
            return
        if message.fence is not None and message.fence == known.fence:
            self._write(Event.ACKNOWLEDGED, key)
            self._trials[key] = replace(known, acknowledged=True)

    def begin(self, assign: Assign) -> Running:
        """The trial's motion is about to begin: from here on it is never begun again."""
        key = (assign.trial, assign.attempt)
        self._write(Event.RUNNING, key)
        self._trials[key] = replace(self._trials[key], running=True)
        return Running(*key, self._trials[key].fence)

    def walked(self, assign: Assign, end: End) -> None:
        """The trial's motion is over and its distance is awaited, after a restart too."""
        key = (assign.trial, assign.attempt)
        self._write(Event.WALKED, key, end=asdict(end))
        self._trials[key] = replace(self._trials[key], walked=end)

    def finish(self, assign: Assign, end: End) -> Finished:
        """The trial is over. One that is over already keeps its end."""
        key = (assign.trial, assign.attempt)
        known = self._trials[key]
        if known.finished is None:
            self._finish(key, end)
        finished = self._trials[key].finished
        assert finished is not None
        return finished

    def fence(self, assign: Assign) -> int:
        """The newest fence of a trial."""
        return self._trials[assign.trial, assign.attempt].fence

    def _namesakes(self, assign: Assign) -> list[Key]:
        """This attempt of the trial and later ones, where they are of something else here."""
        return [
            key
            for key, known in self._trials.items()
            if key[0] == assign.trial and key[1] >= assign.attempt and _differs(known, assign)
        ]

    def _refused(self, assign: Assign, namesakes: list[Key]) -> Finished:
        """The end of a trial whose name is taken; nobody waits any more for what has it."""
        for key in namesakes:
            if not self._trials[key].running and self._trials[key].finished is None:
                self._finish(key, End(Outcome.ABORTED, "another trial has its name"))
        key = (assign.trial, assign.attempt)
        return Finished(*key, assign.fence, Outcome.ABORTED, reason=NAMESAKE)

    def _free_for(self, assign: Assign) -> bool:
        """Whether a new trial can be taken on; an operator's new attempt replaces the old one."""
        attempts = [attempt for trial, attempt in self._trials if trial == assign.trial]
        if any(attempt > assign.attempt for attempt in attempts):
            return False
        current = self.current
        if current is None:
            return True
        if current.trial != assign.trial or self.running:
            return False
        reason = f"superseded by attempt {assign.attempt}"
        self._finish((current.trial, current.attempt), End(Outcome.ABORTED, reason))
        return True

    def _standing(self, key: Key) -> Iterator[Body]:
        """What a trial's answer is, as it stands."""
        trial = self._trials[key]
        if trial.finished is not None:
            yield trial.finished
        elif trial.running:
            yield Running(*key, trial.fence)
        else:
            yield Accepted(*key, trial.fence)

    def _finish(self, key: Key, end: End) -> None:
        finished = Finished(
            *key,
            self._trials[key].fence,
            end.outcome,
            end.distance,
            end.time,
            brief(end.reason),
            end.recording,
            end.digest,
        )
        self._record(key, replace(self._trials[key], finished=finished))

    def _record(self, key: Key, trial: Trial) -> None:
        """Write down a trial that is new, or changed in its fence or its end."""
        if trial.finished is not None:
            self._write(Event.FINISHED, key, finished=asdict(trial.finished))
        else:
            told = None if trial.assign is None else asdict(trial.assign)
            self._write(Event.ACCEPTED, key, fence=trial.fence, assign=told)
        self._trials[key] = trial

    def _write(self, event: Event, key: Key, **more: object) -> None:
        self._journal.append({"event": event, "trial": key[0], "attempt": key[1], **more})

    def _replay(self, entry: dict[str, Any]) -> None:
        key = (str(entry["trial"]), int(entry["attempt"]))
        event = Event(str(entry["event"]))
        known = self._trials.get(key)
        if event is Event.ACCEPTED:
            told = entry["assign"]
            assign = None if told is None else Assign(**(told | {"eta": tuple(told["eta"])}))
            known = known or Trial(0)
            self._trials[key] = replace(known, fence=entry["fence"], assign=assign)
            return
        assert known is not None
        if event is Event.RUNNING:
            self._trials[key] = replace(known, running=True)
        elif event is Event.WALKED:
            end = dict(entry["end"])
            walked = End(**(end | {"outcome": Outcome(end["outcome"])}))
            self._trials[key] = replace(known, walked=walked)
        elif event is Event.FINISHED:
            told = dict(entry["finished"])
            finished = Finished(**(told | {"state": Outcome(told["state"])}))
            self._trials[key] = replace(
                known, fence=finished.fence, finished=finished, acknowledged=False
            )
        else:
            self._trials[key] = replace(known, acknowledged=True)


def _differs(known: Trial, assign: Assign) -> bool:
    """Whether a trial that is known asks for another walk than one of its name."""
    told = known.assign
    asked = (assign.policy, assign.eta, assign.horizon)
    return told is not None and (told.policy, told.eta, told.horizon) != asked


def _refenced(trial: Trial, assign: Assign) -> Trial:
    """A trial under a newer fence; its end, if there is one, is owed anew."""
    finished = trial.finished and replace(trial.finished, fence=assign.fence)
    return replace(
        trial,
        fence=assign.fence,
        assign=trial.assign and replace(trial.assign, fence=assign.fence),
        finished=finished,
        acknowledged=False,
    )


def _progress(trial: Trial) -> Progress:
    if trial.finished is not None:
        return Progress(trial.finished.state)
    return Progress.RUNNING if trial.running else Progress.ACCEPTED
