"""Effects that leave the same trace as a finding are told with it, refitted or not."""

import numpy as np
import pytest

from pup.diagnosis.evidence import Score, Trace
from pup.diagnosis.hypotheses import hypotheses
from pup.diagnosis.residuals import Measured
from pup.diagnosis.selection import Round
from pup.diagnosis.verdict import twins_of
from tests.diagnosis_cases import BENCH, recordings

MEASURED = Measured.of(BENCH, recordings({}))
CHANGE = np.linspace(-1, 1, 50)[:, None] / 4


def score(effect: str, sign: float, size: float) -> Score:
    hypothesis = next(h for h in hypotheses(MEASURED) if h.effect == effect)
    trace = Trace(hypothesis, sign * CHANGE, sign * CHANGE, CHANGE / np.linalg.norm(CHANGE))
    return Score(trace, 9.0, 1, np.array([size]))


@pytest.mark.parametrize(
    ("effect", "sign", "told"),
    [
        ("measurement_delay", 1.0, True),
        ("derivative_kick", -1.0, False),  # it would have to be negative
        ("clock_skew", -1.0, True),  # which may be
    ],
)
def test_twins_have_sizes_that_they_can_have(effect: str, sign: float, told: bool) -> None:
    own, other = score("command_delay", 1.0, 2.0), score(effect, sign, 2.0 * sign)
    chosen = Round(None, (own, other), (), 1)  # type: ignore[arg-type]
    found = twins_of(own.trace.hypothesis, {}, chosen)
    assert [name for name, _ in found] == ([effect] if told else [])
