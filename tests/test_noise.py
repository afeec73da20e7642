"""Noise that is told from errors of simulations of which some have diverged."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from pup.diagnosis.noise import noise_floor, quiet_noise
from pup.diagnosis.residuals import Measured, Noise
from pup.recording import load_recordings
from pup.robot import RobotDescription
from tests.diagnoses import Maker
from tests.diagnosis_cases import BENCH, recordings

SIGMA = 0.003
REPEATED = Measured.of(BENCH, recordings({}))
ALONE = replace(
    REPEATED, recordings=tuple(replace(run, repeat_of=None) for run in REPEATED.recordings)
)


def errors(measured: Measured) -> np.ndarray:
    return SIGMA * np.random.default_rng(0).normal(size=len(measured.values))


@pytest.mark.parametrize("measured", [REPEATED, ALONE], ids=["repeated", "alone"])
@pytest.mark.parametrize("tell", [noise_floor, quiet_noise])
@pytest.mark.parametrize("lost", [1, 4])
def test_what_diverged_says_nothing_of_noise(
    measured: Measured, tell: Callable[[Measured, np.ndarray], Noise], lost: int
) -> None:
    diverged = (measured.recording == lost) & (measured.time > 1.0)
    told = tell(measured, np.where(diverged, np.nan, errors(measured)))
    assert told.sigma[0] == pytest.approx(SIGMA, rel=0.25)


def test_a_joint_that_diverged_is_as_noisy_as_the_others() -> None:
    measured = Maker(RobotDescription.load("darwin_leg")).measured
    told = noise_floor(measured, np.where(measured.channel == 2, np.nan, errors(measured)))
    assert told.sigma[: len(measured.robot.joints)] == pytest.approx(SIGMA, rel=0.35)


def test_a_joint_that_rests_as_it_is_simulated_is_not_free_of_noise() -> None:
    """One that nothing moves is simulated to the last digit of what its encoder tells."""
    measured = Maker(RobotDescription.load("darwin_leg")).measured
    told = quiet_noise(measured, np.where(measured.channel == 2, 0.0, errors(measured)))
    assert told.sigma[2] == pytest.approx(SIGMA / np.sqrt(2), rel=0.25)


@pytest.mark.parametrize("joint", [0, 3])
def test_a_noisier_joint_is_believed_and_a_quieter_one_by_half(joint: int) -> None:
    """A joint that friction holds flickers less at rest than it does in motion."""
    assert times_as_noisy(joint, 4.0) == pytest.approx(4.0, rel=0.15)
    assert times_as_noisy(joint, 0.25) == pytest.approx(np.sqrt((1 + 1 / 16) / 2), rel=0.15)


def test_a_joint_that_hardly_says_anything_is_nearly_as_noisy_as_the_others() -> None:
    assert times_as_noisy(2, 4.0, readings=8) == pytest.approx(np.sqrt((16 + 1) / 2), rel=0.3)


def test_tilts_flicker_where_only_what_hangs_was_done_again() -> None:
    robot = RobotDescription.load("darwin_op2")
    shipped = [robot.folder / "recordings" / f"{n}.parquet" for n in ("step_0.1_0", "standup_2")]
    runs = load_recordings(shipped)
    hanging, standing = sorted(runs, key=lambda run: run.support != "suspended")
    again = replace(hanging, id="again", repeat_of=hanging.id)
    measured = Measured.of(robot, [hanging, again, standing])
    told = noise_floor(measured, errors(measured))
    assert told.source == "repeats"
    assert told.sigma == pytest.approx(SIGMA, rel=0.35)


def times_as_noisy(joint: int, factor: float, readings: int = 1_000) -> float:
    """How a joint of a leg is told, in the noise of the others, if it has another noise."""
    alone = Maker(RobotDescription.load("darwin_leg")).measured
    first, *others = alone.recordings
    again = (replace(run, repeat_of=first.id, motion=first.motion) for run in others)
    measured = replace(alone, recordings=(first, *again))
    own = np.flatnonzero(measured.channel == joint)
    made = errors(measured)
    made[own] *= factor
    for run in range(len(measured.recordings)):
        made[own[measured.recording[own] == run][readings:]] = np.nan
    told = noise_floor(measured, made).sigma[: len(measured.robot.joints)]
    return float(told[joint] / np.median(np.delete(told, joint)))
