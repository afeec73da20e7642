"""Fits that begin where the beginnings of recordings lead, and slopes across contact."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pup.diagnosis import fitting
from pup.diagnosis.beginnings import begun, nearer
from pup.diagnosis.coordinates import nominal_coordinate
from pup.diagnosis.fit import WIDE, Fit
from pup.diagnosis.fitting import STEP, difference, differentiate, fit_together
from pup.diagnosis.noise import assumed_noise
from pup.diagnosis.replays import Bench, Replays, threads
from pup.diagnosis.residuals import Measured
from pup.physics.parameters import robot_space
from pup.recording import load_recordings
from pup.robot import RobotDescription
from tests.diagnosis_cases import BENCH, recordings

Array = NDArray[np.float64]

OP2 = RobotDescription.load("darwin_op2")
AWAY = 0.4
"""Of a gain, in logarithms."""


def made(*names: str) -> Replays:
    shipped = [OP2.folder / "recordings" / f"{name}.parquet" for name in names]
    measured = Measured.of(OP2, load_recordings(shipped))
    return Replays(measured, robot_space(OP2, "pd"), threads(Bench(measured), 1), 1)


def fit_of_itself(replays: Replays, away: float) -> tuple[Fit, float]:
    """A fit of one gain to the described robot's own motion, and where it should end."""
    coordinate = nominal_coordinate(replays.space, "kp/ankle")
    described = replays.space.nominal[replays.space.names.index("kp/ankle")]
    there = coordinate.coordinate(float(described))
    simulated = replays([{coordinate.name: float(described)}])[0]
    fit = Fit((coordinate,), np.array([there + away]), data=simulated)
    fit_together([fit], replays, assumed_noise(replays.measured), iterations=0)
    return fit, there


def test_on_the_ground_a_fit_goes_where_beginnings_lead() -> None:
    replays = made("standup_2")
    fit, there = fit_of_itself(replays, AWAY)
    before = fit.chi2
    nearer([fit], replays, assumed_noise(replays.measured))
    assert fit.chi2 < 0.1 * before
    assert fit.at[0] == pytest.approx(there, abs=0.1 * AWAY)
    assert fit.jacobian is None and not fit.done


@pytest.mark.parametrize(("name", "away"), [("step_0.1_0", AWAY), ("standup_2", 0.0)])
def test_what_hangs_and_what_is_noise_alone_stays(name: str, away: float) -> None:
    replays = made(name)
    fit, _ = fit_of_itself(replays, away)
    at, simulated = fit.at.copy(), replays.simulated
    nearer([fit], replays, assumed_noise(replays.measured))
    assert np.array_equal(fit.at, at) and replays.simulated == simulated


def test_a_fit_in_contact_ends_on_narrow_slopes_and_forgets_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Wide ones lead over jumps, and tell what a fit can imitate; only narrow ones end it."""
    asked: list[float] = []

    def told(fit: Fit, i: int, at: Array, width: float) -> float:
        asked.append(width)
        return difference(fit, i, at, width)

    monkeypatch.setattr(fitting, "difference", told)
    replays = made("standup_2")
    noise = assumed_noise(replays.measured)
    fit, there = fit_of_itself(replays, 0.1)
    fit.narrow = True
    fit_together([fit], replays, noise)
    in_contact = asked[1::2]  # each time in the air first
    assert in_contact[0] == WIDE and in_contact[-1] == 1.0
    assert in_contact == sorted(in_contact, reverse=True)
    assert fit.done and fit.at[0] == pytest.approx(there, abs=0.005)
    assert fit.jacobian is None
    asked.clear()
    differentiate([fit], replays, noise)
    assert asked[1::2] == [WIDE]


def test_another_keeps_to_wide_slopes() -> None:
    replays = made("standup_2")
    fit, _ = fit_of_itself(replays, 0.1)
    fit_together([fit], replays, assumed_noise(replays.measured))
    assert fit.done and fit.jacobian is not None


def test_slopes_in_contact_are_told_across_two_percent() -> None:
    """And in the air across a hair, whatever else is fitted with it."""
    replays = made("step_0.1_0", "standup_2")
    noise = assumed_noise(replays.measured)
    fit, there = fit_of_itself(replays, 0.0)
    differentiate([fit], replays, noise)
    (coordinate,) = fit.coordinates
    grounded = replays.measured.grounded
    for some, step in ((~grounded, STEP), (grounded, 0.02)):
        rows = [{coordinate.name: coordinate.value(x)} for x in (there, there + step)]
        here, moved = replays(rows)
        slope = replays.measured.whiten((moved - here)[None], noise)[0] / step
        assert fit.jacobian is not None and some.any()
        np.testing.assert_allclose(fit.jacobian[some, 0], slope[some], rtol=1e-6, atol=1e-6)


def test_a_log_that_pauses_after_its_first_row_has_no_beginning() -> None:
    """The two rows that are its first second alone would pass for a clock in ms."""
    first, second, *_ = recordings({})
    paused = replace(first, time=np.r_[0.0, 1.6 + second.time[1:]])
    measured = Measured.of(BENCH, [paused, replace(second, repeat_of=None)])
    replays = Replays(measured, robot_space(BENCH, "pd"), threads(Bench(measured), 1), 1)
    stiffness = nominal_coordinate(replays.space, "kp/servo")
    described = float(replays.space.nominal[replays.space.names.index("kp/servo")])
    fit = Fit((stiffness,), np.array([stiffness.coordinate(described)]))
    begun([fit], replays, assumed_noise(measured))
    assert stiffness.lower < fit.at[0] < stiffness.upper
