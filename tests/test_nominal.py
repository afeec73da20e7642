"""What the certificate of a nominal fit says of how far it may be from its minimum."""

from dataclasses import replace
from typing import Any

import pytest

from pup.diagnosis import nominal
from pup.diagnosis.document import document
from pup.diagnosis.nominal import SPARE, Certificate, Nominal, certified
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
