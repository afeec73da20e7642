"""The last stretch of a fit: it lowers a sum of norms, and simulates no point twice."""

import numpy as np
import pytest
from numpy.typing import NDArray

from pup.sysid.fit import W_REG
from pup.sysid.polish import polish

Array = NDArray[np.float64]
BLOCKS = np.arange(0, 300, 3)
TRUTH = np.array([0.6, 0.45, 0.7])


class Bent:
    """Errors of a model that bends, read with noise; remembers which points were asked for."""

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self.matrix = rng.normal(size=(300, 3))
        self.noise = 0.02 * rng.standard_t(3, size=300)
        self.asked: list[bytes] = []

    def __call__(self, units: Array) -> tuple[Array, NDArray[np.int64]]:
        self.asked += [unit.tobytes() for unit in units]
        model = np.sin(2 * units) @ self.matrix.T
        return model - self.matrix @ np.sin(2 * TRUTH) + self.noise, BLOCKS

    def objective(self, unit: Array, anchor: Array | None) -> float:
        error = self(unit[None])[0][0]
        pull = 0.0 if anchor is None else W_REG * ((unit - anchor) ** 2).sum()
        return float(np.linalg.norm(error.reshape(-1, 3), axis=1).sum() + pull)


@pytest.mark.parametrize("anchor", [None, np.full(3, 0.5)])
def test_no_point_is_simulated_twice(anchor: Array | None) -> None:
    errors, start = Bent(), np.full(3, 0.5)
    polish(errors, start, anchor)
    assert len(errors.asked) > 50
    assert len(set(errors.asked)) == len(errors.asked)


@pytest.mark.parametrize("anchor", [None, np.full(3, 0.5)])
def test_it_ends_where_the_sum_of_norms_is_least(anchor: Array | None) -> None:
    errors = Bent()
    found = polish(errors, np.full(3, 0.5), anchor)
    least = errors.objective(found, anchor)
    assert found == pytest.approx(TRUTH, abs=0.01)
    around = found + 0.01 * np.vstack([np.eye(3), -np.eye(3)])
    assert all(errors.objective(unit, anchor) > least for unit in around)


def test_a_minimum_is_left_alone() -> None:
    errors = Bent()
    errors.noise[:] = 0
    assert np.array_equal(polish(errors, TRUTH), TRUTH)
