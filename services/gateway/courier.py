"""Carries trials to agents: assignments and recalls, each again until it is answered."""

import time
from collections.abc import Mapping
from typing import Protocol

from pup.transfer.study import Study
from pup.transfer.trial import HANDED_OUT, Trial
from pup.wire import Body, Cancel
from services.gateway.agents import AgentView
from services.gateway.assignment import assignment

RESEND = 2.0
"""Without an answer to an assignment until it is sent again, s."""


class Send(Protocol):
    """Sends a message to an agent, if it is connected."""

    def __call__(self, agent: str, body: Body) -> None:
        """Send it; nothing happens where it is away."""
        ...


class Courier:
    """What was sent to whom, and when.

    Args:
      agents: those that are known, by name.
    """

    def __init__(self, agents: Mapping[str, AgentView]) -> None:
        self.agents = agents
        self.send: Send = lambda agent, body: None
        self._sent: dict[str, float] = {}

    def waits(self, trial: Trial) -> bool:
        """Whether an agent was told of a trial so lately that it may still answer."""
        return time.monotonic() - self._sent.get(trial.wire, 0.0) <= RESEND

    def assign(self, study: Study, trial: Trial) -> None:
        """Tell an agent to run a trial, unless its journal says that it knows."""
        view = self.agents.get(trial.agent or "")
        if view is None or (trial.wire, trial.attempt, trial.fence) in view.journal:
            return
        self._sent[trial.wire] = time.monotonic()
        self.send(view.name, assignment(study, trial))

    def recall(self, trial: Trial) -> None:
        """Ask its agent to end a trial that is cancelled; until it has."""
        if trial.cancelled and trial.state in HANDED_OUT and trial.agent:
            self._sent[trial.wire] = time.monotonic()
            self.send(trial.agent, Cancel(trial.wire, trial.attempt, trial.fence))
