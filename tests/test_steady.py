"""What a model leaves, where nothing was recorded twice: noise with a memory, or something else."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter

from pup.diagnosis.engine import diagnose
from pup.diagnosis.noise import assumed_noise, told_anew
from pup.diagnosis.replays import Bench, threads
from pup.diagnosis.residuals import Measured, Noise
from pup.diagnosis.result import Diagnosis
from pup.diagnosis.steady import steady
from pup.robot import RobotDescription
from tests.diagnoses import Maker
from tests.diagnosis_cases import BENCH, recordings

Array = NDArray[np.float64]

MEASURED = Measured.of(BENCH, recordings({}))


def thought(measured: Measured, sigma: float) -> Noise:
    """Noise as a model was fitted by it."""
    before = assumed_noise(measured)
    return replace(before, sigma=np.r_[np.full(measured.channels - 2, sigma), before.sigma[-2:]])


def remembering(measured: Measured, sigma: Sequence[float], rho: float) -> Array:
    """Errors of some size at each joint, each of which remembers the one before."""
    rng, errors = np.random.default_rng(0), np.zeros(len(measured.values))
    for number, channel in product(range(len(measured.recordings)), range(len(sigma))):
        own = (measured.recording == number) & (measured.channel == channel)
        fresh = sigma[channel] * np.sqrt(1 - rho**2) * rng.normal(size=own.sum() + 50)
        errors[own] = lfilter([1.0], [1.0, -rho], fresh)[50:]
    return errors


@pytest.mark.parametrize(
    ("sigma", "rho", "told"),
    [
        (2.1e-3, 0.0, None),  # the same
        (4e-3, 0.0, None),  # wrong at every joint: how it flickers would have told that noise
        (3e-3, 0.0, (3e-3, 0.0)),
        (2e-3, 0.4, (2e-3, 0.4)),
        (6e-3, 0.8, (6e-3, 0.8)),  # which flickers by less than a third of that
    ],
)
def test_noise_is_told_anew_by_what_a_model_leaves(
    sigma: float, rho: float, told: tuple[float, float] | None
) -> None:
    after = told_anew(thought(MEASURED, 2e-3), MEASURED, remembering(MEASURED, [sigma], rho))
    assert (after is None) == (told is None)
    if after and told:
        assert after.sigma[0] == pytest.approx(told[0], rel=0.15)
        assert after.rho[0] == pytest.approx(told[1], abs=0.12)


@pytest.mark.parametrize("wave", [0.7, 2.3, 4.0])
def test_what_a_model_is_wrong_at_is_no_noise(wave: float) -> None:
    """However even: what it lacks is slow, or swings."""
    errors = 8e-3 * np.sin(2 * np.pi * wave * MEASURED.time) + remembering(MEASURED, [1e-3], 0.0)
    assert not steady(MEASURED, errors).any()
    assert told_anew(thought(MEASURED, 2e-3), MEASURED, errors) is None


def test_noise_is_as_large_in_every_motion() -> None:
    errors = remembering(MEASURED, [6e-3], 0.7)
    assert steady(MEASURED, errors)[0]
    assert not steady(MEASURED, np.where(MEASURED.recording == 1, 2 * errors, errors)).any()


def test_one_joint_astray_keeps_its_noise_and_stops_nothing() -> None:
    measured = Maker(RobotDescription.load("darwin_leg"), ticks=600).measured
    before = thought(measured, 2e-3)
    after = told_anew(before, measured, remembering(measured, [8e-3, 3e-3, *[2e-3] * 4], 0.0))
    assert after is not None
    assert (after.sigma[0], after.rho[0]) == (2e-3, before.rho[0])
    assert after.sigma[1:6] == pytest.approx([3e-3, *[2e-3] * 4], rel=0.2)


def rough(seed: int, loud: Mapping[str, float], rho: float) -> Diagnosis:
    """A diagnosis where nothing is missing, of motions without rest, none of them done again."""
    rng = np.random.default_rng(seed)
    runs = []
    for run in recordings({}, seed, 0.0003):
        if run.motion in loud:
            fresh = loud[run.motion] * np.sqrt(1 - rho**2) * rng.normal(size=run.position.shape)
            runs.append(replace(run, position=run.position + lfilter([1], [1, -rho], fresh, 0)))
    return diagnose(BENCH, runs, lambda m: threads(Bench(m), 1), 1, lambda stage, share: None)


@pytest.mark.parametrize("rho", [0.7, 0.8])
def test_a_rough_sensor_is_no_mismatch(rho: float) -> None:
    told = rough(4, {"chirp": 0.003, "triangle": 0.003}, rho)
    assert told.verdict == "none"
    assert told.nominal.noise.rho[0] == pytest.approx(rho, abs=0.15)


def test_errors_that_may_be_noise_are_to_be_told_from_it_by_repeats() -> None:
    """They drift, which no noise does by its looks, and no effect and no law foretells."""
    told = rough(0, {"chirp": 0.004, "triangle": 0.004}, 0.97)
    assert told.verdict == "undetermined"
    assert "nothing recorded twice" in told.reason
    assert told.ask is not None and "twice" in told.ask.words
