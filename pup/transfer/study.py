"""Studies and trials as data, and what may happen to them.

A trial goes `requested → assigned → armed → running → succeeded | aborted | infeasible | lost`.
Every change is a function of the trial and of what happened, so that whoever keeps the trials can
store the outcome before it acts on it, and anybody can replay a history.

Three rules keep a robot from walking twice for one trial, and the Gaussian process from hearing of
one walk twice:

- a trial is handed out with a fencing token, `fence`, that only grows; reports with another one
  change nothing;
- a trial that ended stays as it ended, unless an operator makes it void; a result that comes
  after its lease ran out is late: it is kept and flagged, but never counts;
- a trial that was aborted or lost is attempted again only when an operator says so.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
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


class Gate(StrEnum):
    """Who lets a trial go to the robot; the robot has a gate of its own besides."""

    OPERATOR = "operator"
    AUTO = "auto"


class StudyState(StrEnum):
    """Whether a study makes trials."""

    ACTIVE = "active"
    PAUSED = "paused"
    DONE = "done"


class Verdict(StrEnum):
    """What a report means for its trial.

    Attributes:
      COUNTED: the trial changed.
      REPEATED: heard before; nothing changes.
      LATE: of a lease that ended, or of an attempt that is over; kept, never counted.
      UNKNOWN: the gateway never handed this out to this agent.
    """

    COUNTED = "counted"
    REPEATED = "repeated"
    LATE = "late"
    UNKNOWN = "unknown"


class TrialError(InputError):
    """A change that the state of a trial does not allow; told in one line."""


@dataclass(frozen=True)
class StudySettings:
    """What a study looks for and how.

    Attributes:
      robot: name of the robot description.
      policy: SHA-256 of the bundle's `policy.json`.
      lower: of the box that eta is searched in, shape (n_eta,).
      upper: likewise.
      trials: that count, before eta is chosen; the most, with `least_gain`.
      initial: uniform ones among them.
      least_gain: eta is chosen once a further trial is expected to gain less, as a share of the
        best eta's distance; 0 makes all trials.
      repeats: walks of the chosen eta afterwards, and of each one in `compare`.
      compare: etas from elsewhere.
      horizon: longest walk, s.
      lease: silence after which a trial that was handed out is lost, s.
      failures: trials in a row that end without a result before the study pauses.
      gate: who lets trials go to the robot.
      agent: that runs them; None for whichever has the policy.
      warm_start: whether the simulated rollouts given with the study are used.
      seed: of everything random.
    """

    robot: str
    policy: str
    lower: Eta = (-1.0, -1.0, -1.0)
    upper: Eta = (1.0, 1.0, 1.0)
    trials: int = 25
    initial: int = 5
    least_gain: float = 0.0
    repeats: int = 5
    compare: tuple[Eta, ...] = ()
    horizon: float = 15.0
    lease: float = 120.0
    failures: int = 3
    gate: Gate = Gate.OPERATOR
    agent: str | None = None
    warm_start: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        n = len(self.lower)
        if not 1 <= n <= 16 or len(self.upper) != n:
            raise InputError("lower and upper need the same length, 1 to 16")
        if not all(a < b for a, b in zip(self.lower, self.upper, strict=True)):  # NaN is refused
            raise InputError("each entry of lower must be below that of upper")
        if not all(math.isfinite(x) for x in (*self.lower, *self.upper)):
            raise InputError("lower and upper must be finite")
        if any(len(eta) != n or not all(map(math.isfinite, eta)) for eta in self.compare):
            raise InputError(f"each eta in compare needs {n} finite numbers")
        if min(self.trials, self.initial) < 1:
            raise InputError("trials and initial must be 1 or more")
        if not 0 <= self.least_gain < 1:
            raise InputError("least_gain must be from 0 up to 1")


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
      agent: that it was handed out to.
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
        if verdict is not Verdict.COUNTED:
            return self, verdict
        if HANDED_OUT.index(state) <= HANDED_OUT.index(self.state):
            return self, Verdict.REPEATED
        return replace(self, state=state), Verdict.COUNTED

    def finish(self, ticket: Ticket, result: Result, horizon: float) -> tuple["Trial", Verdict]:
        """Hear how it ended.

        A success without a distance that can be is no result of eta, nor is one of a walk that
        somebody had cancelled.

        Args:
          ticket: of who tells.
          result: that is told.
          horizon: longest walk of the study, s.
        """
        verdict = self._judge(ticket)
        if verdict is not Verdict.COUNTED:
            return self, verdict
        far = math.inf if result.distance is None else abs(result.distance)
        if result.state is S.SUCCEEDED and not far <= farthest(horizon):
            why = f"no distance that can be was measured: {result.distance}"
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
        fresh = Trial(self.study, self.number, self.eta, self.purpose)
        return replace(fresh, mark=self.mark, attempt=attempt, fence=self.fence, released=True)

    def _judge(self, ticket: Ticket) -> Verdict:
        ours = Ticket(self.attempt, self.fence, self.agent or "")
        if ticket == ours and self.fence:
            if self.state in HANDED_OUT:
                return Verdict.COUNTED
            return Verdict.LATE if self.state is S.LOST else Verdict.REPEATED
        known = 0 < ticket.fence <= self.fence and 0 < ticket.attempt <= self.attempt
        older = (ticket.attempt, ticket.fence) < (self.attempt, self.fence)
        return Verdict.LATE if known and older else Verdict.UNKNOWN


@dataclass(frozen=True)
class Study:
    """A search for the eta that walks furthest on one robot.

    Attributes:
      name: unique.
      settings: what it looks for.
      state: whether it makes trials.
      reason: why it pauses, in words.
      fence: the last token given out.
      chosen: the eta that was chosen; None before.
      trials: all of them, by number.
      mark: tells it from another study of this name: of a gateway before this one, say.
    """

    name: str
    settings: StudySettings
    state: StudyState = StudyState.ACTIVE
    reason: str = ""
    fence: int = 0
    chosen: Eta | None = None
    trials: tuple[Trial, ...] = field(default=(), repr=False)
    mark: str = ""

    def trial(self, number: int) -> Trial:
        """The trial of a number.

        Raises:
          TrialError: there is none.
        """
        if not 1 <= number <= len(self.trials):
            raise TrialError(f"study {self.name} has no trial {number}")
        return self.trials[number - 1]

    def with_trial(self, trial: Trial) -> "Study":
        """The study with a trial changed or, by the next number, added."""
        rest = [t for t in self.trials if t.number != trial.number]
        if trial.number > len(rest) + 1:
            raise TrialError(f"trial {trial.id} would leave a gap")
        return replace(self, trials=tuple(sorted((*rest, trial), key=lambda t: t.number)))

    @property
    def open(self) -> Trial | None:
        """The trial under way; a study has one at a time."""
        return next((t for t in reversed(self.trials) if t.state in OPEN), None)

    @property
    def told(self) -> tuple[Trial, ...]:
        """The trials that the Gaussian process hears of, by number."""
        return tuple(t for t in self.trials if t.state in TOLD)

    @property
    def searched(self) -> tuple[Trial, ...]:
        """Those of them that the search consists of."""
        return tuple(t for t in self.told if t.purpose in (Purpose.INITIAL, Purpose.SEARCH))

    def infeasible(self) -> int:
        """Trials at the end of which none walked, because of their etas or without a result."""
        walked = (n for n, t in enumerate(reversed(self.trials)) if t.state is S.SUCCEEDED)
        return next(walked, len(self.trials))

    def failures(self) -> int:
        """Trials at the end that gave no result."""
        return sum(1 for _ in _until_told(reversed(self.trials)))


def _until_told(trials: Iterable[Trial]) -> Iterable[Trial]:
    for trial in trials:
        if trial.state in TOLD:
            return
        if trial.state not in OPEN:
            yield trial
