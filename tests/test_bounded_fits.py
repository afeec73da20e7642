"""Coordinates at the ends of their ranges: what they can imitate, and what they cannot."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from pup.diagnosis.coordinates import Belief, Coordinate
from pup.diagnosis.evidence import Projector
from pup.diagnosis.fit import Fit
from pup.diagnosis.folds import left_out

SAMPLES = 60


def linear_fit(
    jacobian: np.ndarray, data: np.ndarray, reach: float = 1.0
) -> tuple[Fit, np.ndarray]:
    """A linear model fitted within a box, and which of its coordinates hit a wall."""
    n = jacobian.shape[1]
    told = lsq_linear(jacobian, data, (-reach, reach), method="bvls", tol=1e-14)
    coordinates = tuple(Coordinate(f"c{i}", 1.0, -reach, reach) for i in range(n))
    at, residual = told.x, data - jacobian @ told.x
    chi2 = float(residual @ residual)
    fit = Fit(coordinates, at, residual=residual, jacobian=jacobian, chi2=chi2)
    return fit, told.active_mask != 0


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 8))
def test_what_a_wall_holds_is_what_cannot_move(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    fit, held = linear_fit(rng.normal(size=(SAMPLES, n)), 4 * rng.normal(size=SAMPLES), 0.3)
    assert np.array_equal(fit.movable, ~held)
    assert fit.slopes.shape == (SAMPLES, n - held.sum())
    # At its minimum a fit leaves nothing that what can still move would imitate.
    residual = fit.residual[:, None]
    assert Projector(fit.slopes)(residual) == pytest.approx(residual, abs=1e-6)


def test_an_effect_that_asks_for_more_than_a_range_allows_is_seen() -> None:
    """A gain at its end explains nothing beyond it; an effect alike does."""
    rng = np.random.default_rng(3)
    jacobian = rng.normal(size=(SAMPLES, 2))
    alike = jacobian[:, :1] + 0.01 * rng.normal(size=(SAMPLES, 1))
    fit, held = linear_fit(jacobian, jacobian @ [5.0, 0.2])
    assert held.tolist() == [True, False]
    left = Projector(fit.slopes)(alike)
    assert left[:, 0] @ fit.residual == pytest.approx(4 * left[:, 0] @ left[:, 0], rel=0.05)
    free, _ = linear_fit(jacobian, jacobian @ [0.5, 0.2])
    assert np.linalg.norm(Projector(free.slopes)(alike)) < 0.02 * np.linalg.norm(left)


def test_one_at_an_end_that_would_rather_leave_it_can_move() -> None:
    jacobian = np.eye(SAMPLES)[:, :1]
    end = Coordinate("c", 1.0, -1.0, 1.0)
    for residual, movable in ((-1.0, True), (1.0, False)):
        fit = Fit((end,), np.ones(1), residual=residual * jacobian[:, 0], jacobian=jacobian)
        assert fit.movable.tolist() == [movable]


@given(st.integers(0, 2**32 - 1), st.integers(1, 8))
def test_a_belief_pulls_to_where_it_costs_least(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    belief, at = Belief(rng.normal(size=n), rng.uniform(0.1, 9, n)), rng.normal(size=n)
    step = 1e-4 * np.eye(n)
    slope = [(belief.cost(at + s) - belief.cost(at - s)) / 2e-4 for s in step]
    assert belief.pull(at) == pytest.approx(-np.array(slope) / 2, abs=1e-6)
    assert belief.cost(belief.at) == 0 <= belief.cost(at)


def test_leaving_out_samples_moves_nothing_through_a_wall() -> None:
    """What a wall holds costs samples left out neither more errors nor more freedom."""
    rng = np.random.default_rng(5)
    jacobian = rng.normal(size=(SAMPLES, 2))
    data = jacobian @ [5.0, 0.2] + rng.normal(size=SAMPLES)
    fit, _ = linear_fit(jacobian, data)
    inside = np.arange(SAMPLES) < SAMPLES // 3
    alone = Fit(
        fit.coordinates[1:],
        fit.at[1:],
        residual=fit.residual,
        jacobian=jacobian[:, 1:],
        chi2=fit.chi2,
    )
    assert left_out(fit, inside) == pytest.approx(left_out(alone, inside))
