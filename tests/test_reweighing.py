"""A search goes on by another noise without anything being simulated again for it."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pup.diagnosis.fit import Fit
from pup.diagnosis.fitting import fit_together
from pup.diagnosis.noise import assumed_noise
from pup.diagnosis.nominal import Nominal, certified, fit_nominal
from pup.diagnosis.replays import Bench, Replays, threads
from pup.diagnosis.residuals import Measured, Noise
from pup.diagnosis.reweighing import Reweighing
from pup.diagnosis.search import Search, search, search_on
from pup.physics.parameters import robot_space
from tests.diagnosis_cases import BENCH, recordings

MISSING = {"coulomb_friction/torque@joint:servo": 0.03}


def quiet(stage: str, share: float) -> None:
    """Nobody watches."""


@lru_cache
def bench() -> Replays:
    measured = Measured.of(BENCH, recordings(MISSING))
    return Replays(measured, robot_space(BENCH, "pd"), threads(Bench(measured), 1), 1)


def noise(sigma: float, rho: float, late: float = 0.0) -> Noise:
    channels = bench().measured.channels
    return Noise(np.full(channels, sigma), np.full(channels, rho), "assumed", 0, late, rho / 2)


noises = st.builds(
    noise, st.floats(1e-4, 1e-2), st.floats(0.0, 0.9), st.sampled_from([0.0, 0.001, 0.01])
)


@settings(max_examples=30)
@given(noises, st.integers(0, 100))
def test_what_is_whitened_can_be_coloured_again(told: Noise, seed: int) -> None:
    measured = bench().measured
    errors = 0.01 * np.random.default_rng(seed).normal(size=(3, len(measured.values)))
    white = measured.whiten(errors, told)
    assert measured.coloured(white, told) == pytest.approx(errors, abs=1e-12)
    assert measured.coloured(white[0], told) == pytest.approx(errors[0], abs=1e-12)


@settings(max_examples=30)
@given(noises, noises, st.integers(0, 100))
def test_turned_is_whitened_by_the_other_noise(first: Noise, second: Noise, seed: int) -> None:
    measured = bench().measured
    errors = 0.01 * np.random.default_rng(seed).normal(size=len(measured.values))
    turned = Reweighing(measured, first, second).turned(measured.whiten(errors, first))
    expected = measured.whiten(errors, second)
    assert turned == pytest.approx(expected, abs=1e-9 * np.abs(expected).max())


@pytest.fixture(scope="module")
def nominal() -> Nominal:
    replays, rng = bench(), np.random.default_rng(0)
    return certified(fit_nominal(replays, assumed_noise(replays.measured), rng), replays, rng)


def weighed(nominal: Nominal, by: Noise) -> Nominal:
    fit = Fit(nominal.fit.coordinates, nominal.fit.at)
    fit_together([fit], bench(), by)
    return replace(nominal, fit=fit, noise=by)


@pytest.fixture(scope="module")
def searched(nominal: Nominal) -> tuple[Search, int]:
    """A search, and how many replays it took."""
    before = bench().simulated
    done = search(bench(), nominal, np.random.default_rng(1), quiet)
    assert done is not None
    return done, bench().simulated - before


def test_a_search_goes_on_to_where_one_anew_leads(
    nominal: Nominal, searched: tuple[Search, int]
) -> None:
    replays, right = bench(), nominal.noise
    anew, spent = searched
    wrong = replace(right, sigma=1.4 * right.sigma, rho=np.full_like(right.rho, 0.3))
    done = search(replays, weighed(nominal, wrong), np.random.default_rng(1), quiet)
    assert done is not None
    between = replays.simulated
    further = search_on(done, replays, nominal, np.random.default_rng(1), quiet)
    assert [h.key for h in further.model.hypotheses] == [h.key for h in anew.model.hypotheses]
    assert [h.effect for h in further.model.hypotheses] == ["coulomb_friction"]
    assert further.model.fit.chi2 == pytest.approx(anew.model.fit.chi2, rel=2e-3)
    assert further.enough == pytest.approx(anew.enough, rel=0.3)
    assert replays.simulated - between < spent / 2
    (chosen,) = (r for r in further.rounds if r.accepted)
    assert chosen.before is further.selector.nominal
    assert chosen.chosen.effect == "coulomb_friction"
    fits = [m.fit for m in chosen.finalists]
    errors = replays([fit.row() for fit in fits])
    for fit, told in zip(fits, replays.measured.values - errors, strict=True):
        white = replays.measured.whiten(told, right)
        assert fit.chi2 == pytest.approx(float(white @ white), rel=1e-6)


def test_what_was_found_by_too_little_noise_is_given_up(
    nominal: Nominal, searched: tuple[Search, int]
) -> None:
    """Where the noise turns out to be a hundred times as large, nothing stands out any more."""
    replays, right = bench(), nominal.noise
    loud = replace(right, sigma=100 * right.sigma)
    done, _ = searched
    assert done.model.hypotheses
    further = search_on(done, replays, weighed(nominal, loud), np.random.default_rng(1), quiet)
    assert not further.model.hypotheses
    assert further.model is further.selector.nominal
