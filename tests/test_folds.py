"""What is left out together, and what that says of a fit."""

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy import stats

from pup.diagnosis.folds import folds, scatter
from pup.diagnosis.held_out import held_out
from pup.diagnosis.residuals import Measured
from pup.recording import Recording
from pup.recording_cuts import beginning
from pup.robot import RobotDescription
from tests.diagnoses import Maker
from tests.diagnosis_cases import BENCH, recordings

RUNS = recordings({})
"""The second one does the first again."""


def left_out(runs: Sequence[Recording]) -> list[list[int]]:
    replays: Any = SimpleNamespace(measured=Measured.of(BENCH, runs))
    return folds(replays)


def test_a_motion_done_again_is_left_out_with_it() -> None:
    """A fit that has seen the one has seen the other."""
    assert left_out(RUNS) == [[0, 1], [2], [3], [4]]
    alike = [replace(run, motion="step") for run in RUNS]
    assert left_out(alike) == [[0, 1], [2], [3], [4]]
    assert left_out(alike[:2]) == [[0], [1]]  # there is nothing else


def test_what_has_no_sample_is_not_left_out() -> None:
    """A motion that is over before anything is told would be one of two folds, and empty."""
    over = beginning(RUNS[2], 0.0)
    assert left_out([*RUNS[:2], over, RUNS[3]]) == [[0, 1], [3]]


def test_who_repeats_a_repeat_repeats_the_first() -> None:
    def families(*told: tuple[str, str | None]) -> list[list[int]]:
        runs = [replace(RUNS[0], id=name, repeat_of=before) for name, before in told]
        return list(Measured.of(BENCH, runs).families().values())

    assert families(("a", None), ("b", "a"), ("c", "b"), ("d", None)) == [[0, 1, 2], [3]]
    assert families(("b", "absent"), ("c", "b"), ("d", "absent")) == [[0, 1, 2]]
    assert families(("a", "c"), ("b", "a"), ("c", "b"), ("d", "d"), ("e", "a")) == [
        [0, 1, 2, 4],
        [3],
    ]


def test_joints_may_be_called_as_the_torso_turns() -> None:
    maker = Maker(RobotDescription.load("darwin_leg"))
    joints = [
        replace(j, name=n)
        for j, n in zip(maker.robot.joints, ("pitch", "roll", "a", "b", "c", "d"), strict=False)
    ]
    measured = replace(maker.measured, robot=replace(maker.robot, joints=tuple(joints)))
    told = held_out(measured, maker.model(None, 2.0), maker.model(None, 1.0), 0)
    assert list(told.per_joint) == [j.name for j in joints] and not told.per_tilt


def test_a_motion_done_often_makes_no_interval_narrower() -> None:
    """Of two motions one is predicted worse, however often it is done."""
    maker = Maker(RobotDescription.load("servo_bench"), motions=["step"] * 9)
    runs = maker.measured.recordings
    again = [replace(run, repeat_of=runs[1].id) for run in runs[2:]]
    measured = replace(maker.measured, recordings=(*runs[:2], *again))
    before, after = maker.model(None, 2.0), maker.model(None, 2.0)
    worse = np.where(measured.recording == 0, 1.0, 3.0)
    after = replace(after, predicted=measured.values + worse * (before.predicted - measured.values))
    low, high = held_out(measured, before, after, 0).interval
    assert (low, high) == (1 - 3.0, 0.0)


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
