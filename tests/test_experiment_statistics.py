"""Statistics over robots: intervals that hold what they should, and simple invariants."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.experiment.statistics import (
    best_so_far,
    farther,
    mean,
    median,
    needed,
    ratio,
    share,
)

NUMBERS = st.floats(-10, 10).map(lambda x: round(x, 3))
DRAWS = 1500


@settings(max_examples=40)
@given(st.lists(NUMBERS, min_size=1, max_size=8))
def test_an_estimate_is_of_all_robots_and_within_its_interval(values):
    for statistic in (mean, median):
        told = statistic(values)
        assert told.robots == len(values)
        assert told.value == pytest.approx(getattr(np, statistic.__name__)(values))
        if told.document()["ci90"] is not None:
            assert told.low - 1e-9 <= told.value <= told.high + 1e-9
    assert (mean(values).document()["ci90"] is None) == (len(values) == 1)
    assert (median(values).document()["ci90"] is None) == (len(values) < 5)


@settings(max_examples=60)
@given(st.lists(st.tuples(NUMBERS, NUMBERS), min_size=1, max_size=8))
def test_a_ratio_is_within_its_interval_and_none_is_to_a_mean_of_nothing(pairs):
    told, above, below = ratio(pairs), *np.mean(pairs, axis=0)
    if below <= 0:
        assert told.document() == {"value": None, "ci90": None, "robots": len(pairs)}
        return
    assert told.value == pytest.approx(above / below)
    if len(pairs) > 1:
        slack = 1e-6 * (1 + abs(told.value))
        assert told.low - slack <= told.value <= told.high + slack


def test_nobody_tells_nothing():
    for statistic in (mean, median, share, ratio):
        assert statistic([]).document() == {"value": None, "ci90": None, "robots": 0}


def covered(statistic, draw, truth):
    """How often intervals of samples of robots hold the truth."""
    told = [statistic(draw()) for _ in range(DRAWS)]
    return np.mean([one.low <= truth <= one.high for one in told])


@pytest.mark.parametrize("robots", [2, 4, 10])
def test_the_interval_of_a_mean_covers_it_as_often_as_it_says(robots):
    """Percentiles of robots drawn with replacement did so 50, 76 and 85 % of the time."""
    rng = np.random.default_rng(0)
    assert covered(mean, lambda: rng.normal(1.0, 0.3, robots), 1.0) == pytest.approx(0.9, abs=0.03)


@pytest.mark.parametrize("robots", [5, 10])
def test_the_interval_of_a_median_covers_it_at_least_as_often_as_it_says(robots):
    rng = np.random.default_rng(0)
    assert covered(median, lambda: rng.lognormal(0, 0.5, robots), 1.0) >= 0.88


@pytest.mark.parametrize("robots", [4, 10])
def test_the_interval_of_a_ratio_covers_it_as_often_as_it_says(robots):
    rng = np.random.default_rng(0)

    def alike():
        """Robots that differ alike under both, and besides."""
        size, own = rng.lognormal(0, 0.3, (robots, 1)), rng.lognormal(0, 0.3, (robots, 2))
        return size * own * [1.5, 1.0]

    def falling():
        """3 m, or a fall on 10 and on 50 % of the robots."""
        walks = rng.random((robots, 2)) < [0.9, 0.5]
        return 3.0 * walks + rng.normal(0.05, 0.1, (robots, 2))

    for draw, truth in ((alike, 1.5), (falling, 2.75 / 1.55)):
        # Nothing is told of the few samples in which all rivals fall.
        told = [one for one in (ratio(draw()) for _ in range(DRAWS)) if not np.isnan(one.low)]
        assert len(told) > 0.9 * DRAWS
        inside = np.mean([one.low <= truth <= one.high for one in told])
        assert 0.84 <= inside <= 0.93
        assert np.mean([one.low > truth for one in told]) <= 0.07  # so often a bar would hold


@pytest.mark.parametrize(("robots", "true"), [(4, 0.8), (10, 0.8), (10, 0.95)])
def test_the_interval_of_a_share_covers_it_at_least_as_often_as_it_says(robots, true):
    rng = np.random.default_rng(0)
    assert covered(share, lambda: rng.random(robots) < true, true) >= 0.9


def test_a_share_of_all_robots_is_no_certainty():
    told = share([True] * 4)
    assert (told.value, told.high) == (1.0, 1.0)
    assert told.low == pytest.approx(0.05**0.25)  # 0.47
    none = share([False] * 4)
    assert (none.low, none.high) == pytest.approx((0.0, 1 - told.low))
    assert share([True, False, True, True]).value == 0.75


def test_a_paired_ratio_is_sharper_than_its_parts():
    """Robots differ alike under two methods; what is compared of one stays together."""
    rng = np.random.default_rng(0)
    size = np.exp(rng.normal(0, 0.5, 10))
    told = ratio(np.stack([1.5 * size, size], axis=1).tolist())
    assert (told.value, told.low, told.high) == pytest.approx((1.5, 1.5, 1.5))


def test_a_ratio_to_what_may_be_nothing_has_no_upper_end():
    told = ratio([(3.0, 0.4), (3.1, -0.1), (2.9, 0.1), (3.0, -0.2)])
    assert told.document()["ci90"][1] is None and 5 < told.low < told.value
    both = ratio([(1.0, 0.4), (-1.0, -0.1), (0.5, 0.1), (-0.3, -0.2)])
    assert both.document()["ci90"] == [None, None]


def test_infeasible_trials_count_and_come_nowhere():
    assert best_so_far([None, -0.3, None, 0.5]) == [-np.inf, -0.3, -0.3, 0.5]
    assert needed(best_so_far([None, -0.3, None, 0.5]), -1.0) == 2


@given(st.lists(NUMBERS, min_size=1, max_size=30), NUMBERS)
def test_trials_that_are_needed(distances, goal):
    best, first = best_so_far(distances), needed(distances, goal)
    assert best == sorted(best) and best[-1] == max(distances)
    assert needed(best, goal) == first
    if first is None:
        assert max(distances) < goal
    else:
        assert distances[first - 1] >= goal and all(d < goal for d in distances[: first - 1])


def test_farther_is_by_more_than_walks_differ_by():
    """Two standard errors of the difference; here 0.1 each, so 0.283."""
    others = [1.0 - 0.2**0.5, 1.0, 1.0 + 0.2**0.5, 1.0, 1.0]
    assert np.std(others, ddof=1) == pytest.approx(0.1**0.5)
    error = 2 * (2 * 0.1 / 5) ** 0.5
    assert farther([d + 1.01 * error for d in others], others)
    assert not farther([d + 0.99 * error for d in others], others)
    assert farther([1.1], [1.0]) and not farther([1.0], [1.0])  # what they differ by is not known


def test_falling_less_far_back_is_not_farther():
    assert not farther([-0.01, -0.011], [-0.15, -0.151])
    assert farther([2.0, 2.1], [-0.15, -0.151])
