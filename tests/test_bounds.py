"""Algorithm 1: subsets, expanded ranges, and splits of parameters by contact."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pup.physics.parameters import ParameterSpace
from pup.sysid import bounds
from pup.sysid.bounds import (
    EXPANSION,
    SPLIT_LEVEL,
    contact_splits,
    draw_subsets,
    expanded_range,
    two_cluster_p,
    widened,
)

SPACE = ParameterSpace(
    ("kp", "limit", "mass"),
    ("N m/rad", "N m", "1"),
    np.array([5.0, 2.0, 1.0]),
    np.array([0.0, 1.0, 0.5]),
    np.array([10.0, 3.0, 1.5]),
)


@pytest.mark.parametrize(("low", "high"), [(0.3, 0.9), (-0.1, 0.3)])
def test_the_end_of_a_range_is_within_it(low: float, high: float) -> None:
    """A last bit beyond, a fit that stopped there would be refused as the start of another."""
    assert low + (high - low) > high
    space = ParameterSpace(("kp",), ("1",), *map(np.atleast_1d, (low, low, high)))
    assert space.denormalise(np.array([[0.0], [1.0]])).ravel().tolist() == [low, high]


def half_and_half(n: int) -> list[bool]:
    return [i < n // 2 for i in range(n)]


@given(st.integers(1, 80), st.integers(1, 12), st.floats(0, 1), st.integers(0, 2**31))
def test_subsets(count: int, subsets: int, fraction: float, seed: int) -> None:
    drawn = draw_subsets(count, subsets, fraction, seed)
    assert len(drawn) == subsets
    size = min(count, max(2, round(count * fraction)))
    for subset in drawn:
        assert list(subset) == sorted(set(subset))
        assert len(subset) == size
        assert min(subset) >= 0 and max(subset) < count
    assert drawn == draw_subsets(count, subsets, fraction, seed)
    # More subsets begin with the same ones: their fits are kept.
    assert draw_subsets(count, subsets + 3, fraction, seed)[:subsets] == drawn


@given(st.integers(1, 80), st.integers(1, 12), st.floats(0, 1), st.integers(0, 2**31))
def test_each_recording_comes_up_before_any_comes_up_twice(
    count: int, subsets: int, fraction: float, seed: int
) -> None:
    drawn = draw_subsets(count, subsets, fraction, seed)
    times = np.bincount([i for subset in drawn for i in subset], minlength=count)
    assert times.max() - times.min() <= 1


def test_subsets_are_drawn_evenly() -> None:
    drawn = np.concatenate([draw_subsets(10, 4000, 0.3, 0)])
    assert np.bincount(drawn.ravel(), minlength=10) == pytest.approx(1200, rel=0.1)
    assert draw_subsets(10, 5, 0.3, 0) != draw_subsets(10, 5, 0.3, 1)


def test_the_range_grows_by_a_tenth_and_stays_in_the_search_range() -> None:
    fits = np.array([[4.0, 1.1, 1.0], [6.0, 2.9, 1.0], [5.0, 2.0, 1.0]])
    lower, upper = expanded_range(fits, SPACE)
    assert EXPANSION == 0.1
    assert lower == pytest.approx([3.8, 1.0, 1.0])  # 1.1 - 0.18 is below the search range
    assert upper == pytest.approx([6.2, 3.0, 1.0])


def test_a_subset_that_cannot_see_a_parameter_does_not_count() -> None:
    fits = np.array([[4.0, np.nan, 1.0], [6.0, 1.5, np.nan], [np.nan, 1.7, 1.1]])
    lower, upper = expanded_range(fits, SPACE)
    assert lower == pytest.approx([3.8, 1.48, 0.99])
    assert upper == pytest.approx([6.2, 1.72, 1.11])


def singles(contact: list[bool]) -> list[tuple[int]]:
    """Subsets of one recording each, so that fits are independent."""
    return [(i,) for i in range(len(contact))]


def test_a_bipolar_parameter_is_found() -> None:
    """As in the paper: another torque limit where the robot touches the ground."""
    rng = np.random.default_rng(5)
    contact = half_and_half(16)
    fits = SPACE.nominal + rng.normal(0, [0.5, 0.1, 0.05], (16, 3))
    fits[:, 1] += np.where(contact, -0.5, 0.5)
    kp, limit, mass = contact_splits(fits, SPACE, singles(contact), contact)
    assert limit.split and not kp.split and not mass.split
    assert limit.p_value < 0.01
    assert limit.separation < -4  # with contact it is lower
    assert limit.two_clusters < 0.01
    assert kp.two_clusters > 0.05
    assert np.array_equal(limit.with_contact, fits[:8, 1])
    assert np.array_equal(limit.without, fits[8:, 1])


def test_a_split_that_only_some_subsets_can_see_is_found() -> None:
    rng = np.random.default_rng(6)
    contact = half_and_half(20)
    fits = SPACE.nominal + rng.normal(0, [0.5, 0.1, 0.05], (20, 3))
    fits[:, 1] += np.where(contact, -0.5, 0.5)
    fits[::4, 1] = np.nan
    _, limit, _ = contact_splits(fits, SPACE, singles(contact), contact)
    assert limit.split
    assert len(limit.with_contact) + len(limit.without) == 15


@pytest.mark.parametrize("contact", [[False] * 6, [True] * 6, [True] + [False] * 5])
def test_without_two_fits_on_each_side_nothing_is_tested(contact: list[bool]) -> None:
    fits = SPACE.nominal + np.random.default_rng(0).normal(0, 0.1, (6, 3))
    for split in contact_splits(fits, SPACE, singles(contact), contact):
        assert np.isnan(split.p_value)
        assert not split.split


def test_a_parameter_seen_on_one_side_alone_is_not_tested() -> None:
    """Ground friction: no subset in the air can see it."""
    contact = half_and_half(12)
    fits = SPACE.nominal + np.random.default_rng(0).normal(0, 0.1, (12, 3))
    fits[~np.array(contact), 2] = np.nan
    kp, _, mass = contact_splits(fits, SPACE, singles(contact), contact)
    assert np.isnan(mass.p_value) and not mass.split
    assert np.isfinite(kp.p_value)


def test_false_alarms_are_rare(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a split, at most one run in twenty reports any, however many parameters it tests."""
    monkeypatch.setattr(bounds, "PERMUTATIONS", 99)
    monkeypatch.setattr(bounds, "two_cluster_p", lambda *_: 1.0)
    rng = np.random.default_rng(9)
    space = ParameterSpace(
        tuple("abcdefghijklmn"), ("1",) * 14, np.full(14, 0.5), np.zeros(14), np.ones(14)
    )
    mixing = rng.normal(size=(14, 14))  # fitted parameters are correlated
    smallest = []
    for seed in range(300):
        fits = 0.5 + 0.03 * rng.standard_t(4, size=(10, 14)) @ mixing
        contact = list(rng.permutation([True] * 4 + [False] * 6))
        splits = contact_splits(fits, space, singles(contact), contact, seed)
        smallest.append(min(s.p_value for s in splits))
    # Uniform p-values: three standard errors of 300 draws around each level.
    for level in (SPLIT_LEVEL, 0.2, 0.5):
        share = np.mean(np.array(smallest) < level)
        assert share <= level + 3 * np.sqrt(level * (1 - level) / 300)
    assert np.mean(np.array(smallest) < 0.5) > 0.35  # nor is the test asleep


def test_two_clusters() -> None:
    rng = np.random.default_rng(2)
    apart = np.concatenate([rng.normal(0, 0.02, 6), rng.normal(0.5, 0.02, 6)])
    assert two_cluster_p(apart, rng) < 0.01
    assert two_cluster_p(np.full(10, 0.3), rng) == 1.0
    assert two_cluster_p(np.array([0.1, 0.9, 0.5]), rng) == 1.0


def test_one_cluster_is_seldom_taken_for_two() -> None:
    rng = np.random.default_rng(3)
    p_values = np.array([two_cluster_p(rng.normal(size=12), rng, draws=199) for _ in range(200)])
    assert np.mean(p_values < 0.05) < 0.05 + 3 * np.sqrt(0.05 * 0.95 / 200)
    assert 0.3 < np.mean(p_values < 0.5) < 0.7


def test_recordings_shared_by_subsets_raise_no_alarm(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fits of subsets that share recordings agree for that reason, not for contact."""
    monkeypatch.setattr(bounds, "PERMUTATIONS", 199)
    monkeypatch.setattr(bounds, "two_cluster_p", lambda *_: 1.0)
    rng = np.random.default_rng(10)
    ground = [True] * 4 + [False] * 9
    alarms = 0
    for seed in range(200):
        subsets = draw_subsets(13, 30, 0.15, seed)
        optima = SPACE.nominal + rng.normal(0, [0.5, 0.1, 0.05], (13, 3))
        fits = np.array([optima[list(subset)].mean(axis=0) for subset in subsets])
        alarms += any(s.split for s in contact_splits(fits, SPACE, subsets, ground, seed))
    assert alarms / 200 <= SPLIT_LEVEL + 3 * np.sqrt(SPLIT_LEVEL * (1 - SPLIT_LEVEL) / 200)


def test_an_interval_widens_a_range_but_not_without_end() -> None:
    """By at most a twentieth of the search range at each end; and it never narrows one."""
    space = ParameterSpace(("a", "b", "c"), ("1",) * 3, np.ones(3), np.zeros(3), np.full(3, 10.0))
    low, high = np.full(3, 1.0), np.full(3, 2.0)
    interval = np.array([0.8, -8.0, 1.2]), np.array([1.5, 9.0, 1.4])
    found = widened(low, high, interval, space)
    np.testing.assert_allclose(found, [[0.8, 0.5, 1.0], [2.0, 2.5, 2.0]])
    found = widened(low, high, interval, space, np.array([0.0, 1.0, 1.0]))
    np.testing.assert_allclose(found, [[1.0, -8.0, 1.0], [2.0, 9.0, 2.0]])
