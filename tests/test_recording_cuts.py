"""Parts of recordings."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from recordings import make

from pup.errors import InputError
from pup.physics.simulator import schedule
from pup.recording import Recording
from pup.recording_cuts import beginning, cut, thinned

WHOLE = Recording(
    id="whole",
    robot="servo_bench",
    motion="step",
    support="bench",
    source="hardware",
    joints=("servo",),
    time=2.0 + 0.1 * np.arange(10),
    target=np.arange(10.0)[:, None],
    position=0.5 * np.arange(10.0)[:, None],
    extras={"voltage": 6.0 + 0.1 * np.arange(10)},
    setup={"kp": 8.0},
    repeat_of="another",
)


def test_a_stretch_has_the_rows_between_its_ends() -> None:
    part = cut(WHOLE, 0.25, 0.75)
    assert part.id == "whole_0.25s"
    assert part.time == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    assert part.target[:, 0].tolist() == [3, 4, 5, 6, 7]
    assert part.position[:, 0].tolist() == [1.5, 2, 2.5, 3, 3.5]
    assert part.extras["voltage"] == pytest.approx([6.3, 6.4, 6.5, 6.6, 6.7])
    assert (part.setup, part.motion, part.repeat_of) == ({"kp": 8.0}, "step", None)


def test_stretches_side_by_side_are_the_whole() -> None:
    parts = [cut(WHOLE, start, stop, id=f"p{start}") for start, stop in ((0, 0.45), (0.45, 2))]
    assert [part.id for part in parts] == ["p0", "p0.45"]
    assert np.concatenate([p.target for p in parts]).tolist() == WHOLE.target.tolist()


def test_a_stretch_knows_the_commands_that_were_held_when_it_began() -> None:
    """Logs may have commands only where they change."""
    nan = np.nan
    sparse = replace(
        WHOLE,
        target=np.array([[nan, 0, nan, nan, nan, nan, 1, nan, nan, nan]]).T,
        extras={"torque_enabled": np.array([1, nan, 0, nan, nan, nan, nan, 1, nan, nan])},
    )
    part = cut(sparse, 0.35, 0.85)
    assert part.target[:, 0].tolist() == [0, 0, 1, 1, 1]
    assert part.extras["torque_enabled"].tolist() == [0, 0, 0, 1, 1]
    np.testing.assert_array_equal(cut(sparse, 0, 0.15).target[:, 0], [nan, 0])


@pytest.mark.parametrize("part", [lambda r: cut(r, 0, 0.25), lambda r: beginning(r, 0.25)])
def test_a_part_before_the_first_word_on_the_torque_has_it_as_a_replay_does(
    part: Callable[[Recording], Recording],
) -> None:
    nan = np.nan
    late = replace(WHOLE, extras={"torque_enabled": np.array([nan] * 4 + [0] + [nan] * 4 + [1])})
    assert part(late).extras["torque_enabled"].tolist() == [0, 0, 0]
    assert not schedule(late, late.joints, 0.01).power[:50].any()


def test_a_stretch_without_rows_is_refused() -> None:
    with pytest.raises(InputError, match=r"'whole': 5 to 6 s holds 0 rows; it lasts 0\.9 s"):
        cut(WHOLE, 5, 6)


def test_thinned_keeps_all_commands_and_some_readings() -> None:
    thin = thinned(WHOLE, 4)
    assert thin.target.tolist() == WHOLE.target.tolist()
    assert np.flatnonzero(~np.isnan(thin.position[:, 0])).tolist() == [0, 4, 8]


def test_thinning_counts_readings_and_not_rows_of_commands() -> None:
    time = np.arange(8) / 100
    position = np.where(np.arange(8) % 2, np.arange(8.0), np.nan)[:, None]
    log = make(joints=("a",), time=time, target=np.zeros((8, 1)), position=position)
    assert np.flatnonzero(~np.isnan(thinned(log, 2).position[:, 0])).tolist() == [1, 5]
    assert thinned(log, 1).digest == log.digest
    with pytest.raises(InputError, match="give 1 or more"):
        thinned(log, 0)
