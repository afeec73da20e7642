"""Batches of replays: parts of them are what the whole has, and what was kept is read again."""

from pathlib import Path

import numpy as np
import pytest

from pup.diagnosis.fitting import _jacobian
from pup.diagnosis.replays import BATCH, Batch, Bench, Replays, threads, union
from pup.diagnosis.residuals import Measured, Noise
from pup.diagnosis.store import Store
from pup.physics.parameters import robot_space
from pup.physics.push import Push
from pup.physics.terms import Place, column
from pup.recording_cuts import beginning
from tests.diagnosis_cases import BENCH, recordings

ROWS = [{"kp/servo": 8.0}, {"kp/servo": 9.0}]
KNOTS = 5


@pytest.fixture(scope="module")
def measured() -> Measured:
    """A servo with friction."""
    return Measured.of(BENCH, recordings({"coulomb_friction/torque@joint:servo": 0.03}))


def bench(measured: Measured) -> Replays:
    """Replays in this process."""
    space = robot_space(BENCH, "pd")
    return Replays(measured, space, threads(Bench(measured), 1), 1)


def test_how_recordings_begin_is_the_beginning_of_the_whole(measured: Measured) -> None:
    whole, short = bench(measured), bench(measured).shortened(1.5)
    inside = measured.time < 1.5
    np.testing.assert_array_equal(short.measured.values, measured.values[inside])
    np.testing.assert_allclose(short(ROWS), whole(ROWS)[:, inside], atol=1e-9)


def test_a_beginning_holds_two_rows_at_least(measured: Measured) -> None:
    recording = measured.recordings[0]
    assert len(beginning(recording, 0.0).time) == 2
    assert len(beginning(recording, 1e9).time) == len(recording.time)


def test_what_was_kept_is_read_again_and_nothing_else(measured: Measured, tmp_path: Path) -> None:
    """A stopped diagnosis pushes the same model in many ways; each answer is its own."""
    asked: list[Batch] = []
    runner = threads(Bench(measured), 1)

    def counted(batches: list[Batch]) -> list[np.ndarray]:
        asked.extend(batches)
        return runner(batches)

    def pushed(torque: float) -> np.ndarray:
        joints = len(BENCH.joints)
        values = np.zeros((1, len(measured.recordings), KNOTS, joints + 6))
        values[..., :joints] = torque
        replays = Replays(
            measured, robot_space(BENCH, "pd"), Store(tmp_path, "it").around(counted), 1
        )
        return replays(ROWS[:1], push=Push(0.2, values))

    first, second = pushed(0.0), pushed(0.05)
    assert np.abs(second - first).max() > 1e-3
    np.testing.assert_array_equal(pushed(0.05), second)
    np.testing.assert_array_equal(pushed(0.0), first)
    assert len(asked) == 2
    short = Replays(measured, robot_space(BENCH, "pd"), Store(tmp_path, "it").around(counted), 1)
    assert short.shortened(1.0)(ROWS[:1]).shape[1] < short(ROWS[:1]).shape[1]


def test_where_places_overlap_the_shape_of_the_narrower_counts(measured: Measured) -> None:
    """Whichever rows come first in a batch."""
    robot, joint = Place("robot"), Place("joint", "servo")
    narrow = {column("stribeck_friction", "speed", joint): 2.0}
    wide = {column("stribeck_friction", "speed", robot): 0.1}
    space = robot_space(BENCH, "pd")
    for rows in ([narrow, wide], [wide, narrow]):
        names = union(space, rows).names
        assert names.index(next(iter(wide))) < names.index(next(iter(narrow)))


def test_samples_that_are_lost_say_nothing_and_others_do(measured: Measured) -> None:
    """A simulation that breaks down in one recording is still told apart by the rest."""
    noise = Noise(np.full(measured.channels, 0.002), np.zeros(measured.channels), "assumed")
    changed = np.ones((1, len(measured.values)))
    changed[0, measured.only([0])] = np.nan
    jacobian = _jacobian(np.array([0.5]), changed, bench(measured), noise)
    assert not jacobian[measured.only([0])].any()
    assert (jacobian[~measured.only([0])] == 2.0 / 0.002).all()


def test_all_lanes_have_as_many_batches(measured: Measured) -> None:
    """Of three, one of two lanes would do two."""
    count = 2 * (BATCH // len(measured.recordings)) + 1
    rows = [{"kp/servo": 8.0 + i / count} for i in range(count)]

    def sizes(lanes: int) -> list[int]:
        asked: list[Batch] = []

        def run(batches: list[Batch]) -> list[np.ndarray]:
            asked.extend(batches)
            return [np.zeros((len(b.rows), len(measured.values))) for b in batches]

        Replays(measured, robot_space(BENCH, "pd"), run, lanes)(rows)
        return [len(batch.rows) for batch in asked]

    assert [len(sizes(lanes)) for lanes in (1, 2, 3)] == [3, 4, 3]
    assert max(sizes(2)) - min(sizes(2)) <= 1
    assert sum(sizes(2)) == count
