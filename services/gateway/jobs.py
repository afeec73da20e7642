"""What a job is and how it goes on: a state machine without clock, file or network.

    queued -> waiting -> running -> succeeded
      ^          |          |-----> failed | lost (no retry left)
      |__________|__________|       cancelled, by way of cancelling

A job is queued until Ray was asked to run an attempt, waiting until Ray found room for it. An
attempt that ends without a result is followed by another one, which resumes. What the job's own
process wrote into shared storage goes before what Ray says: it outlives Ray's head.
"""

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

from services.job_folder import REVOKED, Outcome

DONE, BAD_INPUT = 0, 2
ELSEWHERE = "stopped on the Ray cluster, not by this service"
BACKOFF, LONGEST = 5.0, 300.0
"""Before the second attempt, doubled before each later one up to the longest, s."""
PROGRESS = 600.0
"""An attempt that was lost after running longer did something: those before it count no more, s."""


class JobState(StrEnum):
    """Where a job is."""

    QUEUED = "queued"
    WAITING = "waiting"
    RUNNING = "running"
    CANCELLING = "cancelling"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"
    LOST = "lost"


OPEN = (JobState.QUEUED, JobState.WAITING, JobState.RUNNING, JobState.CANCELLING)


class Status(StrEnum):
    """What Ray says of an attempt; the first two are that it says nothing."""

    AWAY = "AWAY"
    UNKNOWN = "UNKNOWN"
    PENDING = "PENDING"
    RUNNING = "RUNNING"
    STOPPED = "STOPPED"
    SUCCEEDED = "SUCCEEDED"
    FAILED = "FAILED"


@dataclass(frozen=True)
class Seen:
    """An attempt as Ray has it.

    Attributes:
      status: of it.
      message: in words.
      exit: code of its process, where it came to an end of its own.
      unstarted: it never found room.
    """

    status: Status
    message: str = ""
    exit: int | None = None
    unstarted: bool = False

    @property
    def over(self) -> bool:
        """Whether no process of it can be left on the cluster, as far as Ray knows."""
        return self.status not in (Status.AWAY, Status.PENDING, Status.RUNNING)


@dataclass(frozen=True)
class Attempt:
    """One run of a job; times are seconds since 1970.

    Attributes:
      number: from 1.
      asked: when Ray was asked for it.
      known: Ray is known to have it, or to have had it.
      started: when it was first seen running.
      ended: when its end was seen.
      outcome: how it ended, in words.
    """

    number: int
    asked: float
    known: bool = False
    started: float | None = None
    ended: float | None = None
    outcome: str = ""


@dataclass(frozen=True)
class Job:
    """A job.

    Attributes:
      id: made by the gateway.
      verb: of the command line.
      arguments: behind it.
      who: submitted it.
      created: when, seconds since 1970.
      cpus: cores that are reserved for its process.
      gpus: likewise.
      retries: attempts after the first one.
      state: where it is.
      reason: why it is there, in words.
      cancelled_by: who called it off, or empty.
      failures: attempts that count against `retries`: those since the last long one that was lost.
      attempts: oldest first.
    """

    id: str
    verb: str
    arguments: tuple[str, ...]
    who: str
    created: float
    cpus: float = 1.0
    gpus: float = 0.0
    retries: int = 3
    state: JobState = JobState.QUEUED
    reason: str = ""
    cancelled_by: str = ""
    failures: int = 0
    attempts: tuple[Attempt, ...] = ()

    @property
    def open(self) -> bool:
        """Whether it may still change by itself."""
        return self.state in OPEN

    @property
    def last(self) -> Attempt:
        """The newest attempt."""
        return self.attempts[-1]

    @property
    def due(self) -> float:
        """When a queued job may be attempted, seconds since 1970."""
        if not self.failures or not self.attempts or self.last.ended is None:
            return 0.0
        return self.last.ended + min(BACKOFF * 2 ** (self.failures - 1), LONGEST)

    def waits(self, now: float) -> float:
        """Until a queued job may be attempted, s; no longer where the clock was put back since."""
        left = self.due - now
        return left if 0 < left <= LONGEST else 0.0

    @property
    def roomless(self) -> float:
        """When its last attempt ended without having found room, s; 0 where it did."""
        if not self.attempts or self.last.started is not None:
            return 0.0
        return self.last.ended or 0.0

    def attempted(self, now: float) -> "Job":
        """With another attempt."""
        attempt = Attempt(len(self.attempts) + 1, now)
        return replace(self, state=JobState.WAITING, attempts=(*self.attempts, attempt))

    def known(self) -> "Job":
        """With its attempt known to Ray."""
        return self._with(known=True)

    def cancel(self, who: str) -> "Job":
        """Called off; what runs is yet to be stopped."""
        if not self.open or self.cancelled_by:
            return self
        told = replace(self, cancelled_by=who, reason=f"cancelled by {who}")
        if self.state is JobState.QUEUED:
            return replace(told, state=JobState.CANCELLED)
        return replace(told, state=JobState.CANCELLING)

    def again(self, who: str) -> "Job":
        """Queued anew, after it ended without a result."""
        reason = f"tried again by {who}"
        return replace(self, state=JobState.QUEUED, reason=reason, cancelled_by="", failures=0)

    def _with(self, **changed: Any) -> "Job":
        last = replace(self.last, **changed)
        return replace(self, attempts=(*self.attempts[:-1], last))


def reconciled(job: Job, seen: Seen, outcome: Outcome | None, claimed: bool, now: float) -> Job:
    """A job with an attempt under way, after a look at Ray and at the job's folder.

    Args:
      job: waiting, running or cancelling.
      seen: what Ray says.
      outcome: what the attempt's process left, if it ended.
      claimed: the attempt has a process, or had one.
      now: seconds since 1970.
    """
    if seen.status not in (Status.AWAY, Status.UNKNOWN):
        job = job.known()
    final = outcome is not None and outcome.exit in (DONE, BAD_INPUT)
    if outcome and (final or job.cancelled_by or seen.over):
        return _ended(job, outcome.exit, outcome.told, seen, now)
    if job.cancelled_by and not claimed and seen.status is not Status.AWAY:
        return _end(job, JobState.CANCELLED, job.reason, now)  # its process will refuse to begin
    match seen.status:
        case Status.AWAY:
            return job
        case Status.UNKNOWN if not job.last.known:
            return job  # Ray is yet to be asked
        case Status.UNKNOWN:
            why = "the Ray cluster does not know it any more; was its head restarted?"
            return _fallen(job, JobState.LOST, why, now)
        case Status.PENDING:
            return job
        case Status.RUNNING:
            state = JobState.CANCELLING if job.cancelled_by else JobState.RUNNING
            reason = job.reason if job.cancelled_by else ""
            job = replace(job, state=state, reason=reason)
            return job if job.last.started else job._with(started=now)
    if seen.unstarted and not job.cancelled_by:
        why = "the Ray cluster found no room for it in time"
        return _end(job, JobState.QUEUED, f"{why}; it is asked again", now, why)
    if seen.status is Status.SUCCEEDED:
        return _ended(job, DONE, seen.message, seen, now)
    if seen.status is Status.FAILED and seen.exit:
        return _ended(job, seen.exit, seen.message, seen, now)
    if seen.status is Status.STOPPED:
        return _end(job, JobState.CANCELLED, job.reason if job.cancelled_by else ELSEWHERE, now)
    return _fallen(job, JobState.LOST, f"its process was lost ({_line(seen.message)})", now)


def _ended(job: Job, code: int, told: str, seen: Seen, now: float) -> Job:
    """After the end of the verb."""
    if code == DONE:
        return _end(job, JobState.SUCCEEDED, "", now, "done")
    if job.cancelled_by:
        return _end(job, JobState.CANCELLED, job.reason, now, f"exit code {code}")
    if code == BAD_INPUT:
        return _end(job, JobState.FAILED, _line(told) or "bad input", now)
    if code == REVOKED:
        return _fallen(job, JobState.LOST, "another process had the attempt", now)
    if seen.status is Status.STOPPED:
        return _end(job, JobState.CANCELLED, ELSEWHERE, now)
    return _fallen(job, JobState.FAILED, f"exit code {code}: {_line(told)}", now)


def _fallen(job: Job, end: JobState, why: str, now: float) -> Job:
    """After an attempt without a result: the next one, or the end."""
    if job.cancelled_by:
        return _end(job, JobState.CANCELLED, job.reason, now, why)
    began = job.last.started
    lasted = end is JobState.LOST and began is not None and now - began > PROGRESS
    failures = 1 if lasted else job.failures + 1
    if failures > job.retries:
        return replace(_end(job, end, why, now, why), failures=failures)
    reason = f"attempt {job.last.number}: {why}; it is tried again"
    return replace(_end(job, JobState.QUEUED, reason, now, why), failures=failures)


def _end(job: Job, state: JobState, reason: str, now: float, outcome: str = "") -> Job:
    ended = job._with(ended=now, outcome=outcome or reason)
    return replace(ended, state=state, reason=reason)


def _line(message: str) -> str:
    """The last line of a message, cut; without zeros, which no database keeps."""
    return (message.replace("\0", "").strip().splitlines() or [""])[-1].strip()[:300]
