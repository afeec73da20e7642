"""What matters, of what was found: by the error that falls, or by a size that shows."""

from dataclasses import replace

import numpy as np
import pytest

from pup.diagnosis.held_out import HeldOut
from pup.diagnosis.hypotheses import Hypothesis
from pup.diagnosis.materiality import astray, little, matters
from pup.diagnosis.models import Model
from pup.physics.terms import Place
from pup.robot import RobotDescription
from tests.diagnoses import SIGMA, Maker

MAKER = Maker(RobotDescription.load("servo_bench"))
FRICTION = Hypothesis("coulomb_friction", Place("joint", "servo"), MAKER.scale)


def model(known: Hypothesis | None, error: float, size: float = 0.0) -> Model:
    """A model that leaves exactly so much of each joint, in its noise."""
    made = MAKER.model(known, error)
    fit = made.fit
    assert fit.residual is not None
    residual = fit.residual * error / np.sqrt(np.mean(fit.residual**2))
    at = fit.at.copy()
    if known is not None:
        at[-1] = size
    chi2 = float(residual @ residual)
    return replace(made, fit=replace(fit, residual=residual, at=at, chi2=chi2))


def shown(gain: float) -> HeldOut:
    """Errors on motions left out that fall by so much of the noise."""
    ends = SIGMA * (1 + gain), SIGMA
    return HeldOut(("a", "b"), *ends, (0.0, 0.1), {"servo": ends}, {})


@pytest.mark.parametrize(
    ("fitted", "foreseen", "size", "told"),
    [
        (0.35, 0.01, 0.01, True),  # explains much of what was fitted
        (0.05, 0.65, 0.01, True),  # predicts much of what was not
        (0.25, 0.55, 0.20, False),  # a little of everything
        (0.12, 0.05, 0.30, True),  # small in its error, of a usual size
        (0.03, 0.05, 3.00, False),  # of any size, but it hardly shows
        (0.03, 0.15, 3.00, True),  # hidden by a fit to all, and motions left out show it
        (0.03, 0.15, 0.20, False),  # the same of something small
        (0.12, 0.01, 3.00, False),  # predicts nothing
    ],
)
def test_an_effect_matters_by_its_error_or_its_size(
    fitted: float, foreseen: float, size: float, told: bool
) -> None:
    nominal, found = model(None, 1 + fitted), model(FRICTION, 1.0, size)
    assert matters(nominal, found, shown(foreseen), MAKER.noise) is told


def test_why_it_does_not_matter_is_told() -> None:
    found = model(FRICTION, 1.0, 0.2)
    assert "below 0.25 of its typical size" in little(found, shown(0.2))
    assert "hardly changes what is predicted" in little(found, shown(-0.1))
    assert little(model(None, 1.0), shown(0.0)) == ""


@pytest.mark.parametrize(
    ("joints", "torso", "told"),
    [
        ((1.0, 0.9), (1.0, 1.2), True),
        ((1.0, 1.0), (1.0, 0.9), True),  # such as an IMU that tells late
        ((1.0, 1.0), (1.0, 1.0), False),
        ((1.0, 1.1), (1.0, 0.1), False),
    ],
)
def test_better_are_joints_or_else_the_torso(
    joints: tuple[float, float], torso: tuple[float, float], told: bool
) -> None:
    held = HeldOut(("a",), *joints, (0.0, 0.0), per_tilt={"roll": (0.1, 0.1), "pitch": torso})
    assert held.better is told


@pytest.mark.parametrize(
    ("after", "told"),
    [
        ((1.0, 1.0, 1.0, 9.0), True),  # what only drops show is guessed where they are left out
        ((1.0, 1.0, 3.0, 9.0), False),
    ],
)
def test_better_are_most_types_of_motion(after: tuple[float, ...], told: bool) -> None:
    motions = dict(zip("abcd", ((2.0, value) for value in after), strict=True))
    held = HeldOut(("a",), 1.0, 2.0, (0.0, 0.0), per_motion=motions)
    assert held.better is told


@pytest.mark.parametrize(
    ("share", "noises", "far"), [(0.1, 0.0, False), (0.7, 0.0, True), (0.0, 2.0, False)]
)
def test_a_joint_that_is_not_foretold_at_all_is_told(
    share: float, noises: float, far: bool
) -> None:
    """A servo that swings by itself was followed where it was fitted, and told to lack nothing."""
    nominal = model(None, 1.0)
    swing = float(nominal.measured.values.std())
    ends = (share * swing + noises * SIGMA,) * 2
    seen = HeldOut(("a", "b"), *ends, (0.0, 0.0), {"servo": ends}, {})
    assert astray(nominal, seen, MAKER.noise) == ("servo is off by 70% of its swing" if far else "")
