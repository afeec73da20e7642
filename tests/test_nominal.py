"""What the certificate of a nominal fit says of how far it may be from its minimum."""

from dataclasses import replace
from typing import Any

import pytest
from diagnosis_cases import BENCH, recordings

from pup.diagnosis import nominal
from pup.diagnosis.coordinates import described_at
from pup.diagnosis.document import document
from pup.diagnosis.fit import Fit
from pup.diagnosis.fitting import fit_together
from pup.diagnosis.noise import assumed_noise
from pup.diagnosis.nominal import (
    SPARE,
    Certificate,
    Nominal,
    certified,
    free_names,
    nominal_coordinate,
    otherwise_limited,
)
from pup.diagnosis.replays import Bench, Replays, threads
from pup.diagnosis.residuals import Measured
from pup.physics.parameters import robot_space
from pup.robot import RobotDescription
from tests.diagnoses import Maker

MAKER = Maker(RobotDescription.load("servo_bench"))
SHORT = 3.0
"""Chi-squared by which a refit of its own simulation stops short."""


@pytest.mark.parametrize(
    ("apart", "left"),
    [
        (0.001, SHORT),  # shares of the samples
        (0.015, 0.015 * MAKER.samples),
        (0.3, SPARE * MAKER.samples),  # it has not that much to gain
        (0.9, SHORT),  # elsewhere
    ],
)
def test_a_fit_to_the_noise_may_have_left_a_little_of_it(
    apart: float, left: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(nominal, "_refit_of_itself", lambda *asked: (1.0, SHORT))
    count = float(MAKER.samples)
    fit = replace(MAKER.fit(None, 1.0), chi2=count)
    told = Certificate((count, (1 + apart) * count), True, samples=MAKER.samples)
    nothing: Any = None  # what a refit would need
    done = certified(Nominal(fit, MAKER.noise, told), nothing, nothing)
    assert done.certificate.left == pytest.approx(left)


def test_what_does_not_settle_is_not_asked_to_find_itself_again() -> None:
    base = MAKER.nothing()
    apart = replace(base.nominal, certificate=Certificate((1.0, 2.0), False))
    nothing: Any = None
    told = certified(apart, nothing, nothing)
    assert not told.certificate.holds
    assert document(replace(base, nominal=told), "")["certificate"] == {
        "chi2": [1.0, 2.0],
        "recovered": None,
    }


@pytest.mark.parametrize("recovered", [0.1, 5.0])
@pytest.mark.parametrize(
    ("whole", "left"),
    [(0.01, SHORT), (100.0, 100.0), (857.0, 0.06 * 6604), (float("inf"), 0.06 * 6604)],
)
def test_after_a_first_look_effects_must_gain_what_fits_to_all_stop_short_by(
    whole: float, left: float, recovered: float
) -> None:
    """In contact: in the air they stop nowhere, and a spurious effect may gain hundreds."""
    some = Certificate((9.0, 9.0), True, recovered, left=SHORT, samples=1904)
    all_of_them = Certificate((9.0, 9.0), True, recovered=20.0, left=whole, samples=6604)
    told = some.beside(all_of_them)
    assert told.left == pytest.approx(left)
    assert some.holds and told.holds


def test_a_limit_above_all_that_is_asked_for_is_not_the_end() -> None:
    """There it has no slope; a fit that is at its minimum stays as it is."""
    measured = Measured.of(BENCH, recordings({"tau_max/servo": 0.12}))
    space, noise = robot_space(BENCH, "pd"), assumed_noise(measured)
    replays = Replays(measured, space, threads(Bench(measured), 1), 1)
    free = tuple(nominal_coordinate(space, name) for name in free_names(space, ground=False))
    stuck, there = fits = [
        Fit(free, described_at(free, space.at({"tau_max/servo": limit}))) for limit in (3.0, 0.12)
    ]
    fit_together(fits, replays, noise)
    assert stuck.chi2 > 1000 * there.chi2, "it leads nowhere from above"
    found, same = otherwise_limited(fits, replays, noise)
    assert found.values["tau_max/servo"] == pytest.approx(0.12, rel=0.01)
    assert found.chi2 < 1.1 * len(measured.values)
    assert same is there
