"""What refits of all effects would take, told from some of them."""

import numpy as np
import pytest

from benchmarks.exhaustive import Cost, cost
from benchmarks.rivals.case import Case
from pup.diagnosis.hypotheses import hypotheses
from tests.blind_sets import FRICTION, motions
from tests.diagnosis_cases import BENCH


def test_the_cost_of_all_is_told_from_some() -> None:
    case = Case.of(BENCH, motions(FRICTION)[0][:3])
    told = cost(case, 2, seed=1)
    assert told.effects == len(hypotheses(case.measured))
    assert (told.each > len(case.nominal.fit.at)).all()  # a Jacobian at least
    whole, reach = told.whole()
    assert whole == pytest.approx(told.nominal + told.effects * told.each.mean())
    assert reach > 0


def test_what_was_all_refitted_is_certain() -> None:
    assert Cost(48, 10, np.array([5.0, 7.0, 9.0])).whole() == (346.0, 0.0)


def test_every_effect_more_takes_all_refits_once_more() -> None:
    cost_of_one = Cost(48, 10, np.array([5.0, 7.0, 9.0]))
    assert cost_of_one.whole(3) == (10 + 3 * 336.0, 0.0)
