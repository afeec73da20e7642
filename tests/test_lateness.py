"""Motions that come at another time each time are noisy where they are fast."""

from dataclasses import replace

import numpy as np
import pytest

from pup.diagnosis.noise import noise_floor
from pup.diagnosis.residuals import Measured, Noise
from tests.diagnosis_cases import BENCH, recordings

SIGMA, SPREAD = 0.003, 0.02


def late_by(measured: Measured, seed: int) -> np.ndarray:
    """Errors of motions that are late by another time every 0.3 s, of readings with noise."""
    rng = np.random.default_rng(seed)
    moments = (measured.time / 0.3).astype(int)
    late = SPREAD * rng.normal(size=(len(measured.recordings), moments.max() + 1))
    noise = SIGMA * rng.normal(size=len(measured.values))
    return noise + late[measured.recording, moments] * measured.speed


def test_lateness_and_noise_are_told_apart() -> None:
    measured = Measured.of(BENCH, recordings({}, noise=SIGMA))
    told = [noise_floor(measured, late_by(measured, seed)) for seed in range(8)]
    assert np.mean([n.sigma[0] for n in told]) == pytest.approx(SIGMA, rel=0.2)
    assert np.mean([n.late for n in told]) == pytest.approx(SPREAD, rel=0.25)
    assert np.mean([n.rho[0] for n in told]) < 0.2
    assert np.mean([n.rho_late for n in told]) > 0.6  # for nine ticks each


def test_noise_is_as_white_at_rest_as_it_is_in_motion() -> None:
    measured = Measured.of(BENCH, recordings({}, noise=SIGMA))
    fast = SPREAD * measured.speed > SIGMA
    told = []
    for seed in range(8):
        errors = late_by(measured, seed)
        squares = measured.whiten(errors, noise_floor(measured, errors)) ** 2
        told.append((squares[fast].mean(), squares[~fast].mean()))
    # The repeats are at rest for 13 readings: now and then these are all small.
    assert np.median(told, axis=0) == pytest.approx([1, 1], abs=0.3)


def test_readings_alone_are_not_late() -> None:
    measured = Measured.of(BENCH, recordings({}, noise=SIGMA))
    errors = SIGMA * np.random.default_rng(0).normal(size=len(measured.values))
    assert noise_floor(measured, errors).late == 0


def test_repeats_that_are_the_same_to_the_last_digit_have_the_least_noise() -> None:
    measured = Measured.of(BENCH, recordings({}, noise=0.0))
    noise = noise_floor(measured, np.zeros(len(measured.values)))
    assert 0 < noise.sigma[0] < 0.001
    assert noise.late == 0


def test_a_coarse_encoder_is_not_late() -> None:
    """At rest it tells the same each time, in motion it is off by half a step."""
    measured = Measured.of(BENCH, recordings({}, noise=0.0))
    step = 0.005
    read = replace(measured, values=step * np.round(measured.values / step))
    noise = noise_floor(read, read.values - measured.values)
    assert noise.late < 1e-3
    assert noise.sigma[0] >= 0.9 * step / np.sqrt(12)


def test_commands_that_jitter_are_late_motions() -> None:
    """What is left when the delay's mean is known, by the simulation without jitter."""
    jittered = recordings({}, seed=4, late=(0.015, 0.006))
    on_time = recordings({}, seed=4, late=(0.015, 0.0), noise=0.0)
    measured = Measured.of(BENCH, jittered)
    noise = noise_floor(measured, measured.values - Measured.of(BENCH, on_time).values)
    assert noise.sigma[0] < 0.0035  # of 117 differences; their mean square is 0.021
    assert noise.late == pytest.approx(0.006, rel=0.4)


def test_what_was_lost_between_readings_is_no_difference() -> None:
    whole = recordings({}, noise=SIGMA)
    kept = np.arange(len(whole[1].time)) % 6 != 5
    kept &= np.random.default_rng(0).random(len(kept)) > 0.1
    kept[0] = True  # times count from there
    thin = replace(
        whole[1],
        time=whole[1].time[kept],
        target=whole[1].target[kept],
        position=whole[1].position[kept],
    )
    measured = Measured.of(BENCH, (whole[0], thin, *whole[2:]))
    assert noise_floor(measured, measured.values).sigma[0] == pytest.approx(SIGMA, rel=0.25)


@pytest.mark.parametrize("rate", [30, 100, 500])
def test_speed_is_that_of_the_motion_and_not_of_its_noise(rate: int) -> None:
    rng = np.random.default_rng(0)
    time = np.arange(0, 4, 1 / rate)
    moving = 0.7 * time + 0.002 * rng.normal(size=len(time))
    resting = 0.002 * rng.normal(size=len(time))
    whole = Measured.of(BENCH, recordings({}))
    for values, speed in ((moving, 0.7), (resting, 0.0)):
        none = np.zeros(len(time), dtype=np.int64)
        run = replace(whole, values=values, time=time, recording=none, channel=none, index=none)
        assert np.sqrt(np.mean((run.speed - speed) ** 2)) < 0.06


def test_noise_without_lateness_is_what_it_was() -> None:
    measured = Measured.of(BENCH, recordings({}))
    noise = Noise(np.full(3, SIGMA), np.full(3, 0.5), "repeats")
    white = measured.whiten(measured.values, noise)
    inside = np.flatnonzero(np.diff(measured.recording) == 0) + 1
    known = (measured.values[inside] - 0.5 * measured.values[inside - 1]) / (SIGMA * np.sqrt(0.75))
    np.testing.assert_allclose(white[inside], known)
