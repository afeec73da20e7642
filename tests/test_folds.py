"""What leaving out types of motion says of a fit."""

import numpy as np
from scipy import stats

from pup.diagnosis.folds import scatter


def test_the_scatter_of_a_mean_is_its_students_interval() -> None:
    rng = np.random.default_rng(4)
    groups = rng.normal(2.0, 0.3, size=(5, 2))
    refits = np.array([np.delete(groups, i, axis=0).mean(axis=0) for i in range(5)])

    students = stats.t.ppf(0.95, 4) * groups.std(axis=0, ddof=1) / np.sqrt(5)
    np.testing.assert_allclose(scatter(refits), students, rtol=1e-12)


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    rng = np.random.default_rng(5)
    held = []
    for _ in range(2000):
        motions = rng.normal(1.0, 0.2, size=(4, 1))
        refits = np.array([np.delete(motions, i, axis=0).mean(axis=0) for i in range(4)])
        held.append(abs(motions.mean() - 1.0) < scatter(refits)[0])

    assert 0.88 < np.mean(held) < 0.92


def test_what_does_not_depend_on_the_motions_has_no_scatter() -> None:
    assert (scatter(np.tile([0.3, -1.0], (3, 1))) == 0).all()
