"""Delays and clocks against closed forms."""

import numpy as np
import pytest
from terms import (
    AT,
    BENCH,
    STEP,
    bench,
)
from test_simulator import recording


def test_late_commands_and_late_readings_are_shifts() -> None:
    """By any time: of commands the run is that of later ones, of readings that of earlier times."""
    time = np.arange(0, 1, STEP)
    target = np.where(time > 0.3, 0.4, 0.0)
    run = recording(BENCH, time, target)
    late, read, plain, read_late = bench(
        run,
        {f"command_delay/time{AT}": 0.0073},
        {f"measurement_delay/time{AT}": 0.0073},
        {},
        {f"measurement_delay/time{AT}": 5 * STEP},
    )
    switch = time[target > 0][0] + 0.0073
    at = int(np.searchsorted(time, switch))
    with_switch = np.insert(time, at, switch)
    shifted = bench(recording(BENCH, with_switch, np.where(with_switch >= switch, 0.4, 0.0)), {})
    assert late == pytest.approx(np.delete(shifted[0], at), abs=1e-9)
    assert read == pytest.approx(np.interp(time - 0.0073, time, plain), abs=1e-12)
    assert read_late[5:] == pytest.approx(plain[:-5], abs=1e-12)


def test_readings_older_than_the_recording_are_of_its_start_and_need_no_room() -> None:
    """Of 1e9 s, as of somewhat more than there is: for all of them there would be no memory."""
    time = np.arange(0, 0.4, 0.02)
    run = recording(BENCH, time, np.where(time > 0.1, 0.4, 0.0))
    rows = [{f"measurement_delay/time{AT}": old} for old in (0.1, 1e9)]
    some, none = bench(run, *rows)
    assert some.max() > 0.1
    assert not none.any()


def test_a_clock_that_goes_slow_meets_commands_early_and_ever_more_so() -> None:
    """A command told at t comes at t / (1 + share) by the encoders' clock."""
    time = np.arange(0, 10, 0.03)
    target = 0.3 * np.sign(np.sin(2.1 * time))
    skewed, plain = bench(recording(BENCH, time, target), {"clock_skew/share@robot": 0.005}, {})
    both, where = np.unique(np.concatenate([time, time / 1.005]), return_inverse=True)
    told = target[np.searchsorted(time / 1.005, both, side="right") - 1]
    early = bench(recording(BENCH, both, told), {})[0]
    assert skewed == pytest.approx(early[where[: len(time)]], abs=1e-4)
    moved = np.abs(skewed - plain)
    assert moved[time > 7].max() > 3 * moved[time < 2].max()


def test_torque_is_switched_by_the_clock_of_the_commands() -> None:
    """Let go at 4 s by a clock that is a hundredth fast, the arm falls after 4 / 1.01 s."""
    time = np.arange(0, 5.0, 0.02)
    enabled = (time < 4.0).astype(float)
    run = recording(BENCH, time, np.full(len(time), 0.5), 0.5, extras={"torque_enabled": enabled})
    late, early = bench(run, {}, {"clock_skew/share@robot": 0.01})
    falling = (time > 4.0) & (time < 4.9)
    expected = np.interp(time[falling] + 4 - 4 / 1.01, time, late)
    assert np.abs(early - late)[falling].max() > 0.03
    np.testing.assert_allclose(early[falling], expected, atol=2e-3)
