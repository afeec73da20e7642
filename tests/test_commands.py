"""Commands between sub-steps: those that come late, and more than one in a sub-step."""

from dataclasses import replace

import numpy as np
import pytest
from terms import BENCH, SERVO, play
from test_simulator import recording

from pup.recording import Recording

DELAY = "command_delay/time@joint:servo"


def swing(period: float) -> Recording:
    """A sine, told every so often."""
    time = np.arange(0, 1.2, period)
    return recording(BENCH, time, 0.3 * np.sin(12 * time), 0.0)


@pytest.mark.parametrize("period", [0.0005, 0.00083, 0.004])
def test_commands_faster_than_sub_steps_come_in_time(period: float) -> None:
    run = swing(period)
    seen, fine = (
        play(replace(BENCH, timestep=step), run, [SERVO]).position[0, :, 0] for step in (2e-3, 1e-4)
    )
    speed = np.gradient(fine, run.time)
    late = (fine - seen) @ speed / (speed @ speed)
    assert abs(late) < 1e-5
    assert np.abs(seen - fine).max() < 1e-4


def test_no_delay_in_the_company_of_one_changes_no_bit() -> None:
    run = swing(0.0005)
    alone = play(BENCH, run, [SERVO]).position
    among = play(BENCH, run, [SERVO, SERVO | {DELAY: 0.0103}]).position
    np.testing.assert_array_equal(among[:1], alone)


def test_a_delay_of_commands_faster_than_sub_steps_is_a_shift() -> None:
    run, lag = swing(0.0005), 0.0103
    late, fine = (
        play(replace(BENCH, timestep=step), run, [SERVO | {DELAY: lag}]).position[0, :, 0]
        for step in (2e-3, 1e-4)
    )
    assert np.abs(late - fine).max() < 1e-4
