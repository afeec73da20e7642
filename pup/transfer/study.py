"""Studies: what a search for the best eta of one robot looks for, and the trials it has made."""

import math
from dataclasses import dataclass, field, replace
from enum import StrEnum

from pup.errors import InputError
from pup.transfer.trial import OPEN, TOLD, Eta, Purpose, Trial, TrialError, TrialState, UnknownError


class Gate(StrEnum):
    """Who lets a trial go to the robot; the robot has a gate of its own besides."""

    OPERATOR = "operator"
    AUTO = "auto"


FAILURES = {Gate.OPERATOR: 1, Gate.AUTO: 3}
"""Trials in a row without a result before a study pauses, where nothing else is asked for: whoever
releases each trial looks at each that failed."""


class StudyState(StrEnum):
    """Whether a study makes trials."""

    ACTIVE = "active"
    PAUSED = "paused"
    DONE = "done"


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
      agent: that runs them; None for whichever has the policy first.
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
        if self.initial > self.trials:
            raise InputError(f"initial ({self.initial}) must be at most trials ({self.trials})")
        if not 0 <= self.least_gain < 1:
            raise InputError("least_gain must be from 0 up to 1")


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
          UnknownError: there is none.
        """
        if not 1 <= number <= len(self.trials):
            raise UnknownError(f"study {self.name} has no trial {number}")
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
    def agent(self) -> str | None:
        """Who runs its trials: whom the settings name, else who began one; None for anybody.

        Two robots are two landscapes: a process that hears of both finds the best eta of neither.
        """
        begun = (t.agent for t in reversed(self.trials) if t.begun)
        return self.settings.agent or next(begun, None)

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
        walked = (n for n, t in enumerate(reversed(self.trials)) if t.state is TrialState.SUCCEEDED)
        return next(walked, len(self.trials))

    @property
    def fruitless(self) -> tuple[Trial, ...]:
        """The trials that ended without a result, by number."""
        return tuple(t for t in self.trials if t.state not in (*TOLD, *OPEN))

    @property
    def fruitless_since(self) -> tuple[Trial, ...]:
        """Those of them after the last one that was told."""
        last = max((t.number for t in self.told), default=0)
        return tuple(t for t in self.fruitless if t.number > last)

    def failures(self) -> int:
        """Trials at the end that gave no result."""
        return len(self.fruitless_since)
