"""Robots that take some parameters of another one take them from another one."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.projection import average, exchanged


@given(st.integers(2, 50), st.integers(0, 1000), st.sets(st.integers(0, 4)))
def test_nobody_keeps_what_is_exchanged_and_nothing_is_lost(
    n: int, seed: int, chosen: set[int]
) -> None:
    rng = np.random.default_rng(seed)
    mu = rng.uniform(size=(n, 5))
    columns = np.isin(np.arange(5), list(chosen))
    out = exchanged(mu, columns, rng)
    assert np.array_equal(out[:, ~columns], mu[:, ~columns])
    assert (out[:, columns] != mu[:, columns]).all()
    assert np.array_equal(np.sort(out, axis=0), np.sort(mu, axis=0))
    several = out[:, columns]
    assert {tuple(row) for row in several} == {tuple(row) for row in mu[:, columns]}


def test_the_interval_of_a_mean_is_as_wide_as_it_should_be() -> None:
    rng = np.random.default_rng(0)
    told = average(rng.normal(0.5, 1.0, 400))
    low, high = told.low, told.high
    assert high - low == np.clip(high - low, 0.14, 0.19)  # 2 * 1.645 / sqrt(400) = 0.1645
    assert low < 0.6 and high > 0.4
