"""What the gateway knows of the agents that are connected, in memory."""

import time
from dataclasses import dataclass, field
from typing import Any

from pup.wire import AgentState, Heartbeat, Hello, Sample, Stop

STILL = (AgentState.DISABLED, AgentState.STOPPED, AgentState.FAULT)
"""States of a robot without torque."""
SILENCE = 5.0
"""After which an agent counts as away, s."""


@dataclass
class AgentView:
    """An agent as it was last heard.

    Attributes:
      name: of the file with its CURVE key.
      hello: what it said of itself.
      state: of its robot; None before the first heartbeat.
      health: what it tells of it.
      trial: that it is at.
      heard: monotonic time of the last message, s; -inf before the first.
      journal: trials that its journal knows of, as (trial, attempt, fence).
      sample: the newest of the rollout under way.
      stop: that its robot was sent and has not obeyed yet.
      held: why it is given no trial, since it was stopped; empty once a study goes on.
      admitted: whether its key is known still.
    """

    name: str
    hello: Hello | None = None
    state: AgentState | None = None
    health: dict[str, Any] = field(default_factory=dict)
    trial: str | None = None
    heard: float = -float("inf")
    journal: set[tuple[str, int, int]] = field(default_factory=set)
    sample: Sample | None = None
    stop: Stop | None = None
    held: str = ""
    admitted: bool = True
    _shown: tuple[bool, AgentState | None] = (False, None)

    @property
    def present(self) -> bool:
        """Whether it was heard of lately."""
        return self.silent < SILENCE

    @property
    def silent(self) -> float:
        """Since the last message, s."""
        return time.monotonic() - self.heard

    def greet(self, hello: Hello) -> None:
        """A new connection, perhaps of a new program: what was known of the old one is void."""
        self.hello, self.state, self.trial, self.sample = hello, None, None, None
        self.journal = {(e.trial, e.attempt, e.fence) for e in hello.journal}

    def beat(self, heartbeat: Heartbeat) -> None:
        """How it is."""
        self.state, self.health = heartbeat.state, heartbeat.health
        self.trial = heartbeat.trial
        if self.state in STILL and self.health.get("limp") is True:
            self.stop = None

    def changed(self) -> bool:
        """Whether it has come, gone or changed its state since it was asked this."""
        before, self._shown = self._shown, (self.present, self.state)
        return before != self._shown

    def sampled(self, sample: Sample) -> bool:
        """A sample of a rollout; whether it is newer than the last."""
        last = self.sample
        same = last and (last.trial, last.attempt, last.fence) == (
            sample.trial,
            sample.attempt,
            sample.fence,
        )
        if last and same and sample.number <= last.number:
            return False
        self.sample = sample
        return True

    def can_run(self, robot: str, policy: str) -> str | None:
        """Why it cannot run a policy on a robot now; None where it can."""
        if not self.present or self.hello is None:
            return "is not connected"
        if self.hello.robot != robot:
            return f"is a {self.hello.robot}"
        if policy not in {p.sha256 for p in self.hello.policies}:
            return "does not have the policy"
        if self.state is not AgentState.ENABLED:
            return f"is {self.state or 'silent'}"
        if self.trial:
            return f"is at {self.trial}"
        if self.stop:
            return "has not said that it is limp since it was stopped"
        if self.held:
            return f"was stopped ({self.held}): resume the study to let it walk"
        return None

    def document(self) -> dict[str, Any]:
        """As the REST interface tells it."""
        hello = self.hello
        silent = self.silent
        return {
            "name": self.name,
            "robot": hello.robot if hello else None,
            "version": hello.version if hello else None,
            "policies": [{"name": p.name, "sha256": p.sha256} for p in hello.policies]
            if hello
            else [],
            "present": self.present,
            "silent_seconds": round(silent, 3) if silent < float("inf") else None,
            "state": self.state.value if self.state else None,
            "trial": self.trial,
            "held": self.held,
            "health": self.health,
        }
