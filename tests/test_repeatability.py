"""What does not repeat itself: told apart from noise by how little readings flutter."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from pup.diagnosis.engine import diagnose
from pup.diagnosis.noise import flutter, noise_floor, repeats
from pup.diagnosis.repeatability import unrepeated
from pup.diagnosis.replays import Bench, threads
from pup.diagnosis.residuals import Measured
from pup.diagnosis.verdict import Finding
from pup.recording import Recording
from tests.diagnosis_cases import BENCH, recordings

NONE: Mapping[str, float] = {}
STUCK = (1.6, 2.6)
"""When the servo sticks in one of two repeats, s."""


def told(errors: np.ndarray, runs: tuple[Recording, ...]) -> Finding | None:
    measured = Measured.of(BENCH, runs)
    return unrepeated(measured, errors, noise_floor(measured, errors), [])


def noise_of(runs: tuple[Recording, ...], memory: float = 0.0, seed: int = 0) -> np.ndarray:
    """Noise of 2 mrad with a memory from tick to tick, shape (n_samples,)."""
    noise = 0.002 * np.random.default_rng(seed).normal(size=len(Measured.of(BENCH, runs).values))
    for i in range(1, len(noise)):
        noise[i] = memory * noise[i - 1] + np.sqrt(1 - memory**2) * noise[i]
    return noise


def stuck(runs: tuple[Recording, ...]) -> np.ndarray:
    """Where the readings of the motion done again were taken while the servo stuck."""
    measured = Measured.of(BENCH, runs)
    inside = (measured.time > STUCK[0]) & (measured.time < STUCK[1])
    return inside & (measured.recording == 1) & (measured.channel == 0)


def sticking(runs: tuple[Recording, ...]) -> tuple[Recording, ...]:
    """The same recordings, of a servo that stands still for a while when it does a motion again."""
    again = runs[1]
    elapsed = again.time - again.time[0]
    inside = (elapsed > STUCK[0]) & (elapsed < STUCK[1])
    position = again.position.copy()
    position[inside] = position[inside][0] + 0.002 * np.random.default_rng(1).normal(
        size=(inside.sum(), 1)
    )
    return (runs[0], replace(again, position=position), *runs[2:])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("memory", [0.0, 0.5, 0.8])
def test_noise_repeats_as_noise(seed: int, memory: float) -> None:
    runs = recordings(NONE)
    assert told(noise_of(runs, memory, seed), runs) is None


def test_what_happens_in_one_of_two_repeats_is_found_where_and_when_it_does() -> None:
    runs = recordings(NONE)
    finding = told(noise_of(runs) + 0.03 * stuck(runs), runs)
    assert finding is not None
    assert (finding.effect, str(finding.place)) == ("unknown", "joint:servo")
    assert finding.parameters["flutter"].value == pytest.approx(0.002, rel=0.25)
    assert finding.parameters["spread"].value > 4 * finding.parameters["flutter"].value
    assert finding.probability > 0.9
    assert finding.when
    for window in finding.when:
        assert window.end > STUCK[0]
        assert window.start < STUCK[1]


def test_what_a_model_foretells_of_it_repeats_as_noise() -> None:
    """A noise floor by a model that foretold less is no reason to say that a joint does not."""
    runs = recordings(NONE)
    measured = Measured.of(BENCH, runs)
    far_off = noise_floor(measured, noise_of(runs) + 0.03 * stuck(runs))
    assert far_off.sigma[0] > 0.01
    assert unrepeated(measured, noise_of(runs), far_off, []) is None


def test_a_joint_that_is_still_on_its_way_flutters_no_more() -> None:
    """It swings for a quarter of the time, command or not."""
    runs = recordings(NONE)
    measured = Measured.of(BENCH, runs)
    swings = 0.03 * np.sin(60 * measured.time) * (measured.time % 2 < 0.5)
    assert flutter(measured, noise_of(runs) + swings, 0) == pytest.approx(0.002, rel=0.5)


def test_without_repeats_or_with_impacts_nothing_is_said() -> None:
    runs = recordings(NONE)
    errors = noise_of(runs) + 0.03 * stuck(runs)
    alone = tuple(replace(r, repeat_of=None) for r in runs)
    assert told(errors, alone) is None
    noise = noise_floor(Measured.of(BENCH, runs), errors)
    ground = Measured.of(BENCH, runs)
    ground = replace(ground, recordings=tuple(replace(r, support="ground") for r in runs))
    assert unrepeated(ground, errors, noise, []) is None


def test_a_motion_done_again_with_something_changed_is_no_repeat() -> None:
    runs = recordings(NONE)
    third = replace(runs[1], id="step_again")
    told = [repeats(Measured.of(BENCH, [*runs[:2], again, third])) for again in changed(runs[1])]
    assert told == [[(0, 1), (1, 3)]] * 2


def changed(run: Recording) -> list[Recording]:
    """A recording with another setup, and with another support."""
    other = replace(run, id="step_changed")
    return [replace(other, setup={"payload": 0.5}), replace(other, support="suspended")]


def test_a_servo_that_sticks_now_and_then_is_no_noisy_encoder() -> None:
    """Weighed by what differs between repeats nothing else stands out, and `none` would be told."""
    runs = sticking(recordings(NONE))
    found = diagnose(BENCH, runs, lambda m: threads(Bench(m), 1), 1, lambda stage, share: None)
    assert found.verdict == "mismatch"
    finding = next(f for f in found.findings if f.effect == "unknown")
    assert "spread" in finding.parameters
    assert finding.probability > 0.9
