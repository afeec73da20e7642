"""What follows the meeting of a mechanical stop is left out, and nothing else."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pup.diagnosis.knocks import SHAKEN, knocked
from pup.diagnosis.replays import some
from pup.diagnosis.residuals import SETTLING, Measured
from pup.physics.model import compile_model
from pup.recording import Recording
from pup.robot import RobotDescription

LEG = RobotDescription.load("darwin_leg")
KNEE = LEG.joint_names.index("l_knee")
END = float(compile_model(LEG, "bench").compiled.joint("l_knee").range[1])
PERIOD = 0.03


def recording(knee: np.ndarray) -> Recording:
    ticks = len(knee)
    position = np.zeros((ticks, len(LEG.joints)))
    position[:, KNEE] = knee
    return Recording(
        id="r",
        robot=LEG.name,
        motion="drop",
        support="bench",
        source="simulation",
        joints=LEG.joint_names,
        time=PERIOD * np.arange(ticks),
        target=np.zeros_like(position),
        position=position,
    )


def test_a_third_of_a_second_after_a_blow_is_left_out() -> None:
    knee = np.full(200, END - 0.5)
    knee[100:] = END + 0.05
    fallen = recording(knee)
    left_out = knocked(LEG, fallen)
    assert left_out[99:110].all() and left_out.sum() <= 2 + SHAKEN / PERIOD + 1
    assert not left_out[:99].any() and not left_out[112:].any()
    kept = Measured.of(LEG, [fallen])
    counted = int((~left_out & (fallen.time >= SETTLING)).sum())
    assert (np.bincount(kept.channel)[: len(LEG.joints)] == counted).all()


def test_how_a_recording_begins_leaves_out_what_the_whole_does() -> None:
    """A blow in the first second shakes much of that second, and little of the recording."""
    knee = np.full(200, END - 0.5)
    knee[15:] = END + 0.05
    whole = Measured.of(LEG, [recording(knee)])
    begun = some(whole, [0], 1.0)
    assert np.array_equal(begun.values, whole.values[whole.time < 1.0])
    assert np.array_equal(begun.time, whole.time[whole.time < 1.0])


def test_a_blow_between_readings_is_left_out_too() -> None:
    knee = np.full(200, END - 0.5)
    knee[100:] = END + 0.05
    knee[1::2] = np.nan
    assert knocked(LEG, recording(knee))[100:108].all()


def test_who_leans_on_a_stop_or_comes_to_it_slowly_loses_nothing() -> None:
    slow = np.linspace(END - 0.5, END + 0.05, 200)
    assert not knocked(LEG, recording(slow)).any()
    assert not knocked(LEG, recording(np.full(200, END + 0.05))).any()


def test_a_range_that_is_met_all_the_time_is_no_stop() -> None:
    swings = END - 0.1 + 0.3 * np.sin(2 * np.pi * 2.0 * PERIOD * np.arange(400))
    assert not knocked(LEG, recording(swings)).any()


@given(st.lists(st.floats(-2.0, END), min_size=3, max_size=60))
def test_motions_within_their_range_are_whole(knee: list[float]) -> None:
    assert not knocked(LEG, recording(np.array(knee))).any()
