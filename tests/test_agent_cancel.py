"""A trial that is taken back while somebody measures how far the robot came."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hardware_agent.activities import Ended
from hardware_agent.conductor import Conductor, Stage
from hardware_agent.distance import Operator
from hardware_agent.journal import Journal
from hardware_agent.trials import TrialBook
from pup.errors import InputError
from pup.wire import Assign, Body, Cancel, Finished, Outcome

TRIAL = Assign("s", "s/1.ab", 1, 1, "0" * 64, (0.0,), 15.0)


class Still:
    """A control loop whose robot has walked and stands."""

    status = SimpleNamespace(state="enabled")

    def cancel(self, reason: str) -> None:
        """There is no walk any more."""

    def measured(self) -> None:
        """Time does not stand still."""

    def hurry(self, hurried: bool) -> None:
        """Nor does it go faster."""


@pytest.fixture
def measuring(tmp_path: Path) -> tuple[Conductor, list[Body]]:
    """A conductor that waits for a distance, and what it tells."""
    told: list[Body] = []
    book = TrialBook(Journal(tmp_path / "journal"))
    settings: Any = SimpleNamespace(
        link=SimpleNamespace(upload=False), control=SimpleNamespace(gate="operator", rate=33.0)
    )
    kept: Any = SimpleNamespace(keep=lambda *more: None)
    still: Any = Still()
    nothing: Any = None
    made = Conductor(
        settings, nothing, book, still, nothing, Operator(), kept, lambda *more: told.extend(more)
    )
    book.assigned(TRIAL)
    book.begin(TRIAL)
    made._assign = TRIAL
    rollout: Any = SimpleNamespace(rows=[SimpleNamespace(values=np.zeros(3))])
    made.handle(Ended(TRIAL, Outcome.SUCCEEDED, "reached the horizon", rollout, 15.0))
    return made, told


def test_it_ends_and_does_not_count(measuring: tuple[Conductor, list[Body]]) -> None:
    conductor, told = measuring
    assert conductor.stage is Stage.MEASURING and conductor.trial == "s/1.ab"
    conductor.cancelled(Cancel("s/1.ab", 1, 1))
    ended = [body for body in told if isinstance(body, Finished)]
    assert [(e.state, e.reason, e.distance) for e in ended] == [
        (Outcome.ABORTED, "cancelled", None)
    ]
    assert conductor.trial is None, "or its lease would never run out"
    with pytest.raises(InputError, match="no distance is asked for"):
        conductor.measured(0.42)


def test_where_another_is_taken_back_it_counts(measuring: tuple[Conductor, list[Body]]) -> None:
    conductor, told = measuring
    conductor.cancelled(Cancel("s/2.ab", 1, 1))
    conductor.measured(0.42)
    ended = [body for body in told if isinstance(body, Finished) and body.trial == "s/1.ab"]
    assert [(e.state, e.distance) for e in ended] == [(Outcome.SUCCEEDED, 0.42)]
