"""Servos that are read one after the other."""

import numpy as np
import pytest
from terms import LEG, LEG_POSE, play
from test_simulator import recording

STEP = LEG.timestep


@pytest.mark.parametrize("whole", [0.012, -0.012])
def test_servos_read_in_turn_are_the_older_the_later_their_turn(whole: float) -> None:
    """Of six joints the k-th is read k sixths of the scan ago, from whichever end it begins."""
    time = np.arange(0, 0.8, STEP)
    target = LEG_POSE + 0.2 * np.sin(4 * time)[:, None]
    run = recording(LEG, time, target, LEG_POSE, "suspended")
    plain, read = play(LEG, run, [{}, {"scan_delay/time@bus": whole}]).position
    turns = np.arange(1, 7) if whole > 0 else np.arange(6, 0, -1)
    for joint, turn in enumerate(turns):
        expected = np.interp(time - 0.012 * turn / 6, time, plain[:, joint])
        assert read[:, joint] == pytest.approx(expected, abs=1e-12)
