"""The jitter of a delay: told from errors that a delay makes and that do not repeat."""

import numpy as np
import pytest

from pup.diagnosis.coordinates import term_coordinate
from pup.diagnosis.doubts import unexplained_errors
from pup.diagnosis.fit import Fit
from pup.diagnosis.hypotheses import hypotheses
from pup.diagnosis.jitter import jitter
from pup.diagnosis.lacks import repeated
from pup.diagnosis.models import Model
from pup.diagnosis.residuals import Measured
from tests.diagnosis_cases import BENCH, recordings

MEASURED = Measured.of(BENCH, recordings({}))
SPREAD = 0.005


def left(errors: np.ndarray, effect: str = "command_delay") -> Model:
    """A model with one effect, the slope of a delay of 1 s, and what it leaves."""
    hypothesis = next(h for h in hypotheses(MEASURED) if h.effect == effect)
    coordinate = term_coordinate(hypothesis.magnitudes[0], hypothesis.scale)
    fit = Fit(
        (coordinate,),
        np.array([1.0]),
        residual=errors,
        jacobian=(answer() * coordinate.slope(1.0))[:, None],
        chi2=float(errors @ errors),
    )
    return Model((hypothesis,), 1, fit, np.zeros(1), MEASURED)


def answer() -> np.ndarray:
    """What a delay of 1 s does to the samples, in units of the noise: uneven, as motions are."""
    return 400 * np.maximum(np.sin(3 * MEASURED.time), 0)


def test_errors_that_grow_with_what_a_delay_does_are_its_jitter() -> None:
    rng = np.random.default_rng(0)
    noise, uneven = rng.normal(size=(2, len(MEASURED.values)))
    model = left(noise + SPREAD * answer() * uneven)
    found = jitter(model)
    assert found is not None
    assert found.spread == pytest.approx(SPREAD, rel=0.1)
    assert found.lower < SPREAD < found.upper
    assert np.mean(unexplained_errors(model) ** 2) == pytest.approx(1, abs=0.1)


def test_noise_is_no_jitter() -> None:
    noise = np.random.default_rng(1).normal(size=len(MEASURED.values))
    assert jitter(left(noise)) is None


def test_what_repeats_is_no_jitter() -> None:
    """The same errors whenever the motion is the same: physics that is missing."""
    noise = np.random.default_rng(2).normal(size=len(MEASURED.values))
    missing = 3 * np.sign(np.sin(20 * MEASURED.time)) * (answer() > 200)
    model = left(noise + missing)
    assert jitter(model) is None
    assert np.array_equal(unexplained_errors(model), noise + missing)


def test_uneven_noise_repeats_no_more_than_even_noise() -> None:
    """Errors that both repeats have at the same times, large ones among small, are no surprise."""
    rng = np.random.default_rng(5)
    size = np.where(np.sin(9 * MEASURED.time) > 0.9, 20.0, 1.0)
    told = [repeated(MEASURED, size * rng.normal(size=len(size)))[0] for _ in range(200)]
    assert np.std([one.surprise for one in told]) == pytest.approx(1, abs=0.2)


def test_without_a_delay_there_is_nothing_to_jitter() -> None:
    rng = np.random.default_rng(3)
    noise, uneven = rng.normal(size=(2, len(MEASURED.values)))
    model = left(noise + SPREAD * answer() * uneven, "coulomb_friction")
    assert jitter(model) is None
