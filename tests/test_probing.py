"""Limbs that share a supply feel each other, and so share no simulation."""

import numpy as np
import pytest

from pup.diagnosis.coordinates import nominal_coordinate
from pup.diagnosis.fit import Fit
from pup.diagnosis.impulses import responses
from pup.diagnosis.noise import assumed_noise
from pup.diagnosis.probing import changes, probed
from pup.diagnosis.replays import Replays
from pup.diagnosis.residuals import Measured
from pup.recording import load_recordings
from pup.recording_cuts import beginning
from pup.robot import RobotDescription
from tests.located import replays_of

OP2 = RobotDescription.load("darwin_op2")
SAG = {"voltage_sag/drop@bus": 0.1, "voltage_sag/buffer@bus": 0.02}
DAMPED = [{f"quadratic_damping/coefficient@joint:{side}_knee": 0.1} for side in "lr"]


@pytest.fixture(scope="module")
def replays() -> Replays:
    """Of a robot that hangs, and moves for a second."""
    (run,) = load_recordings([OP2.model_path.parent / "recordings/step_0.1_0.parquet"])
    return replays_of(Measured.of(OP2, [beginning(run, 1.5)]))


@pytest.mark.parametrize("here", [{}, SAG], ids=["apart", "one supply"])
def test_a_change_is_told_of_all_joints_that_feel_it(
    here: dict[str, float], replays: Replays
) -> None:
    simulated = replays([here, *({**here, **probe} for probe in DAMPED)])
    before = replays.simulated
    ((base, changed),) = probed([(here, DAMPED, DAMPED)], replays)
    assert replays.simulated - before == (3 if here else 2)
    assert base == pytest.approx(simulated[0], abs=1e-6)
    assert changed == pytest.approx(simulated[1:] - simulated[0], abs=1e-6)


def test_changes_in_the_air_are_those_of_shorter_sub_steps(replays: Replays) -> None:
    stiffer = [{f"kp/{group}": 25.0} for group in ("hip", "knee", "ankle")]
    asked = [({}, [*stiffer, *DAMPED], [*stiffer, *DAMPED])]
    ((_, fine),) = probed(asked, replays)
    (coarse,) = changes(asked, replays)
    off = np.linalg.norm(coarse - fine, axis=1)
    assert (off > 0).all()
    assert (off < 0.03 * np.linalg.norm(fine, axis=1)).all()


def test_changes_in_contact_are_those_of_the_robots_own_sub_step() -> None:
    (run,) = load_recordings([OP2.model_path.parent / "recordings/fall_forward.parquet"])
    standing = replays_of(Measured.of(OP2, [beginning(run, 0.3)]))
    asked = [({}, DAMPED, DAMPED)]
    ((_, fine),) = probed(asked, standing)
    np.testing.assert_array_equal(changes(asked, standing)[0], fine)


def test_a_push_is_told_of_all_joints_that_feel_it(replays: Replays) -> None:
    coordinate = nominal_coordinate(replays.space, "kp/hip")
    fit = Fit((coordinate,), np.array([coordinate.coordinate(20.0)]), fixed=SAG)
    told = responses(fit, replays, assumed_noise(replays.measured), budget=1)
    assert [len(part.channels) for part in told.parts] == [len(OP2.joints)]
