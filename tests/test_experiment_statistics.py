"""Statistics over robots: intervals that hold what they should, and simple invariants."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.experiment.statistics import (
    best_so_far,
    estimate,
    mean,
    median,
    needed,
    ratio,
    share_above,
    share_true,
)

NUMBERS = st.floats(-10, 10).map(lambda x: round(x, 3))
ROWS = st.integers(1, 3).flatmap(
    lambda k: st.lists(st.lists(NUMBERS, min_size=k, max_size=k), min_size=1, max_size=8)
)


@settings(max_examples=40)
@given(ROWS)
def test_an_estimate_is_of_all_robots_and_its_interval_of_their_kind(rows):
    for statistic in (mean, median):
        told = estimate(statistic, rows)
        first = [row[0] for row in rows]
        assert told.robots == len(rows)
        assert told.value == pytest.approx(getattr(np, statistic.__name__)(first))
        if len(rows) == 1:
            assert told.document()["ci90"] is None
        else:
            assert min(first) - 1e-9 <= told.low <= told.high <= max(first) + 1e-9
            assert told == estimate(statistic, rows)  # by its seed


@settings(max_examples=40)
@given(st.lists(st.tuples(NUMBERS, NUMBERS), min_size=2, max_size=8))
def test_shares_and_ratios(rows):
    above = estimate(share_above, rows)
    assert above.value == sum(a > b for a, b in rows) / len(rows)
    assert 0 <= above.low <= above.high <= 1
    told, below = estimate(ratio, rows), float(np.mean([b for _, b in rows]))
    if below > 1e-9:
        assert told.value == pytest.approx(np.mean([a for a, _ in rows]) / below)
    elif below <= 0 < np.mean([a for a, _ in rows]):
        assert told.value == np.inf and told.document()["value"] is None
    elif below <= 0:  # neither comes anywhere
        assert told.value == 0


def test_nobody_tells_nothing():
    told = estimate(mean, []).document()
    assert told == {"value": None, "ci90": None, "robots": 0}


def test_the_interval_of_a_mean_covers_it_about_as_often_as_it_says():
    """90 % of the time with many robots, somewhat less with 12: percentile intervals are narrow."""
    rng = np.random.default_rng(0)
    inside = 0
    for _ in range(200):
        told = estimate(mean, rng.normal(1.0, 0.3, (12, 1)).tolist())
        inside += told.low <= 1.0 <= told.high
    assert 0.8 <= inside / 200 <= 0.95


def test_a_paired_ratio_is_sharper_than_its_parts():
    """Robots differ alike under two methods; what is compared of one stays together."""
    rng = np.random.default_rng(0)
    size = np.exp(rng.normal(0, 0.5, 10))
    told = estimate(ratio, np.stack([1.5 * size, size], axis=1).tolist())
    assert (told.value, told.low, told.high) == pytest.approx((1.5, 1.5, 1.5))


@given(st.lists(NUMBERS, min_size=1, max_size=30), NUMBERS)
def test_trials_that_are_needed(distances, goal):
    best, first = best_so_far(distances), needed(distances, goal)
    assert best == sorted(best) and best[-1] == max(distances)
    assert needed(best, goal) == first
    if first is None:
        assert max(distances) < goal
    else:
        assert distances[first - 1] >= goal and all(d < goal for d in distances[: first - 1])


def test_shares_of_what_is_true():
    assert estimate(share_true, [[1.0], [0.0], [1.0], [1.0]]).value == 0.75
