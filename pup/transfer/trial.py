"""Trials as data, and what may happen to them.

A trial goes `requested → assigned → armed → running → succeeded | aborted | infeasible | lost`.
Every change is a function of the trial and of what happened, so that whoever keeps the trials can
store the outcome before it acts on it, and anybody can replay a history.

Three rules keep a robot from walking twice for one trial, and the Gaussian process from hearing of
one walk twice:

- a trial is handed out with a fencing token, `fence`, that only grows; reports with another one
  change nothing;
- a trial that ended stays as it ended, unless an operator makes it void; a result that comes
  after its lease ran out counts as long as nobody has had the trial retried: another attempt has
  another number, so that no walk counts twice. After that it is late: kept and flagged;
- a trial that was aborted or lost is attempted again only when an operator says so.
"""

import math
from dataclasses import dataclass, replace
from enum import StrEnum

from pup.errors import InputError
from pup.wire import farthest

Eta = tuple[float, ...]


class TrialState(StrEnum):
    """Where a trial is.

    Attributes:
      REQUESTED: stored; nobody has been asked to run it.
      ASSIGNED: an agent may have been told to run it.
      ARMED: whoever stands at the robot let it start.
      RUNNING: the robot moves.
      SUCCEEDED: the rollout ended by itself; its distance counts.
      ABORTED: it was not run to its end, for a reason that says nothing of eta.
      INFEASIBLE: eta makes the policy command what no robot can do.
      LOST: nothing was heard of it until its lease ended.
    """

    REQUESTED = "requested"
    ASSIGNED = "assigned"
    ARMED = "armed"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    ABORTED = "aborted"
    INFEASIBLE = "infeasible"
    LOST = "lost"


S = TrialState
HANDED_OUT = (S.ASSIGNED, S.ARMED, S.RUNNING)
OPEN = (S.REQUESTED, *HANDED_OUT)
TOLD = (S.SUCCEEDED, S.INFEASIBLE)
"""What the Gaussian process hears of."""


class Purpose(StrEnum):
    """Why a trial is made.

    Attributes:
      INITIAL: one of the uniform ones at the beginning.
      SEARCH: suggested by the Gaussian process.
      REPEAT: of the eta that was chosen, after the search.
      COMPARE: of an eta from elsewhere, such as the projection of the fitted parameters.
    """

    INITIAL = "initial"
    SEARCH = "search"
    REPEAT = "repeat"
    COMPARE = "compare"


class Verdict(StrEnum):
    """What a report means for its trial.

    Attributes:
      COUNTED: the trial changed.
      REPEATED: heard before; nothing changes.
      LATE: of an attempt that is over, or a sign of life of a trial that is lost; kept, never
        counted.
      UNKNOWN: the gateway never handed this out to this agent.
    """

    COUNTED = "counted"
    REPEATED = "repeated"
    LATE = "late"
    UNKNOWN = "unknown"


class TrialError(InputError):
    """A change that the state of a trial does not allow; told in one line."""


class UnknownError(TrialError):
    """There is nothing of this name or number."""


@dataclass(frozen=True)
class Result:
    """How an attempt ended.

    Attributes:
      state: succeeded, aborted or infeasible.
      distance: m; None where none was measured.
      time: until the fall or the end, s.
      reason: in words.
      recording: id of the recording, if there is one.
      digest: SHA-256 of its file.
    """

    state: TrialState
    distance: float | None = None
    time: float | None = None
    reason: str = ""
    recording: str | None = None
    digest: str | None = None


@dataclass(frozen=True)
class Ticket:
    """Which handing-out of a trial a report is about."""

    attempt: int
    fence: int
    agent: str


@dataclass(frozen=True)
class Trial:
    """A walk with one eta.

    Attributes:
      study: that it belongs to.
      number: counts the study's trials from 1.
      eta: what the policy is conditioned on.
      purpose: why it is made.
      state: where it is.
      attempt: counts an operator's decisions to run it, from 1.
      fence: of the last handing-out; 0 before the first.
      agent: that it was handed out to; while it waits for another attempt, who began the last.
      released: whether it passed the gate of the study.
      cancelled: whether an operator wants its agent to end it.
      result: how it ended; None while it is open or lost.
      mark: of its study; see Study.
    """

    study: str
    number: int
    eta: Eta
    purpose: Purpose
    state: TrialState = S.REQUESTED
    attempt: int = 1
    fence: int = 0
    agent: str | None = None
    released: bool = False
    cancelled: bool = False
    result: Result | None = None
    mark: str = ""

    @property
    def id(self) -> str:
        """Names the trial to people."""
        return f"{self.study}/{self.number}"

    @property
    def wire(self) -> str:
        """Names it on the wire, where an agent may remember one of another gateway."""
        return f"{self.id}.{self.mark}" if self.mark else self.id

    @property
    def begun(self) -> bool:
        """Whether its agent may have moved the robot for it."""
        stood = self.state is S.ABORTED and self.result is not None and self.result.time is None
        return self.agent is not None and not stood

    def release(self) -> "Trial":
        """Let it pass the gate; a second time changes nothing."""
        if self.state in OPEN:
            return replace(self, released=True)
        raise TrialError(f"trial {self.id} is {self.state}; only an open one can be released")

    def assign(self, agent: str, fence: int) -> "Trial":
        """Hand it out.

        Args:
          agent: that will be told to run it.
          fence: larger than any before in this study.
        """
        if self.state is not S.REQUESTED or not self.released:
            raise TrialError(f"trial {self.id} is {self.state} and not to be handed out")
        if fence <= self.fence:
            raise TrialError(f"fence {fence} of trial {self.id} must exceed {self.fence}")
        return replace(self, state=S.ASSIGNED, agent=agent, fence=fence)

    def report(self, ticket: Ticket, state: TrialState) -> tuple["Trial", Verdict]:
        """Hear that it is armed or running; what comes out of order moves it forward only."""
        verdict = self._judge(ticket)
        if self.state is S.LOST and verdict is Verdict.COUNTED:
            verdict = Verdict.LATE  # that it moved tells nothing of how it ended
        if verdict is not Verdict.COUNTED:
            return self, verdict
        if HANDED_OUT.index(state) <= HANDED_OUT.index(self.state):
            return self, Verdict.REPEATED
        return replace(self, state=state), Verdict.COUNTED

    def finish(self, ticket: Ticket, result: Result, horizon: float) -> tuple["Trial", Verdict]:
        """Hear how it ended.

        A success without a distance that can be is no result of eta, nor is one of a walk that
        somebody had cancelled. That of a trial which was lost is: its walk was as good as any.

        Args:
          ticket: of who tells.
          result: that is told.
          horizon: longest walk of the study, s.
        """
        verdict = self._judge(ticket)
        if verdict is not Verdict.COUNTED:
            return self, verdict
        far = math.inf if result.distance is None else abs(result.distance)
        if result.state is S.SUCCEEDED and not far <= farthest(horizon, result.time):
            why = f"no distance that can be was measured: {result.distance} m in {result.time} s"
            result = replace(result, state=S.ABORTED, reason=why)
        if result.state is S.SUCCEEDED and self.cancelled:  # it had ended before it was told
            result = replace(result, state=S.ABORTED, reason="cancelled")
        return replace(self, state=result.state, result=result), Verdict.COUNTED

    def expire(self) -> "Trial":
        """Its lease ran out."""
        if self.state not in HANDED_OUT:
            raise TrialError(f"trial {self.id} is {self.state} and has no lease")
        return replace(self, state=S.LOST)

    def recall(self) -> "Trial":
        """Have its agent end it, however long it takes until the agent hears of it."""
        if self.state not in HANDED_OUT:
            raise TrialError(f"trial {self.id} is {self.state}; it cannot be cancelled")
        return replace(self, cancelled=True)

    def withdraw(self, reason: str) -> "Trial":
        """Take it back before anybody was asked to run it."""
        if self.state is not S.REQUESTED:
            raise TrialError(f"trial {self.id} is {self.state}; ask its agent to cancel it")
        return replace(self, state=S.ABORTED, result=Result(S.ABORTED, reason=reason))

    def void(self, reason: str) -> "Trial":
        """Let a walk not count after all: its distance was mistyped, or somebody held the robot."""
        if self.state is S.ABORTED and self.result and self.result.reason == reason:
            return self
        if self.state not in TOLD or self.result is None:
            raise TrialError(f"trial {self.id} is {self.state}; there is nothing to make void")
        result = replace(self.result, state=S.ABORTED, reason=reason)
        return replace(self, state=S.ABORTED, result=result)

    def retry(self, attempt: int) -> "Trial":
        """Run it again, which only an operator may want; the same decision twice is one.

        Args:
          attempt: the number that the new attempt shall have.
        """
        if attempt == self.attempt and self.attempt > 1:
            return self
        if self.state not in (S.ABORTED, S.LOST):
            raise TrialError(
                f"trial {self.id} is {self.state}; only aborted or lost ones are retried"
            )
        if attempt != self.attempt + 1:
            raise TrialError(
                f"attempt {attempt} of trial {self.id}; the next is {self.attempt + 1}"
            )
        agent = self.agent if self.begun else None
        fresh = replace(self, state=S.REQUESTED, attempt=attempt, released=True, agent=agent)
        return replace(fresh, cancelled=False, result=None)

    def _judge(self, ticket: Ticket) -> Verdict:
        ours = Ticket(self.attempt, self.fence, self.agent or "")
        if ticket == ours and self.fence and self.state is not S.REQUESTED:
            awaited = self.state in (*HANDED_OUT, S.LOST)
            return Verdict.COUNTED if awaited else Verdict.REPEATED
        known = 0 < ticket.fence <= self.fence and 0 < ticket.attempt <= self.attempt
        older = (ticket.attempt, ticket.fence) < (self.attempt, self.fence)
        return Verdict.LATE if known and older else Verdict.UNKNOWN
