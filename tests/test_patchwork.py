"""A model of many names that nobody would believe alone is a patchwork for something else."""

from dataclasses import replace

import numpy as np
import pytest

from pup.diagnosis.fit import Fit
from pup.diagnosis.held_out import held_out
from pup.diagnosis.laws import NAMELESS
from pup.diagnosis.models import Model
from pup.diagnosis.patchwork import CHANCE, patched
from pup.diagnosis.residuals import Measured, Noise
from pup.diagnosis.verdict import Alternative, Finding
from pup.physics.terms import Place
from pup.robot import RobotDescription
from tests.diagnoses import Maker
from tests.diagnosis_cases import BENCH, recordings

MEASURED = Measured.of(BENCH, recordings({}))
NOISE = Noise(np.full(3, 0.002), np.zeros(3), "repeats")
SERVO = Place("joint", "servo")


def named(effect: str, probability: float, rival: float = 0.0) -> Finding:
    others = (Alternative("cogging", SERVO, rival),) if rival else ()
    return Finding(effect, SERVO, "throughout", (), {}, probability, others, {}, None, 100.0)


def foretelling(times: float) -> Model:
    """A model whose errors on motions left out are so many times the noise, in the last second."""
    errors = 0.002 * np.random.default_rng(0).normal(size=len(MEASURED.values))
    late = MEASURED.time > MEASURED.time.max() - 1
    errors[late] *= np.sqrt(1 + (times**2 - 1) / late.mean())
    fit = Fit((), np.empty(0), residual=errors / 0.002, jacobian=np.empty((len(errors), 0)))
    return Model((), 0, fit, np.zeros(1), MEASURED, predicted=MEASURED.values - errors)


def told(findings: list[Finding], times: float, known: Finding | None = None) -> Finding | None:
    model = foretelling(times)
    shown = held_out(MEASURED, foretelling(10.0), model, 0)
    return patched(findings, known, shown, model, NOISE, [])


PATCHES = [named("thermal_drift", 0.3), named("dead_band", 0.2, 0.1), named("joint_spring", 0.4)]


def test_three_that_nobody_believes_and_motions_astray_are_something_else() -> None:
    finding = told(PATCHES, 3.0)
    assert finding is not None
    assert (finding.effect, finding.place, finding.probability) == (NAMELESS, SERVO, CHANCE)
    assert finding.parameters["astray"].value == pytest.approx(3.0, rel=0.1)
    assert finding.when
    assert all(w.end > MEASURED.time.max() - 1 for w in finding.when)


@pytest.mark.parametrize(
    ("findings", "times"),
    [
        (PATCHES, 1.2),  # they foretell motions: nothing is left to be something else
        (PATCHES[:2], 3.0),
        ([*PATCHES[:2], named("joint_spring", 0.4, 0.4)], 3.0),  # a spring or cogging: of two
        ([*PATCHES[:2], named("joint_spring", 0.9)], 3.0),
    ],
)
def test_what_foretells_motions_or_is_believed_is_no_patch(
    findings: list[Finding], times: float
) -> None:
    assert told(findings, times) is None


def test_what_is_known_to_have_no_name_is_as_likely_at_least() -> None:
    known = replace(named(NAMELESS, 0.2), law="tau += v")
    raised = told(PATCHES, 3.0, known)
    assert raised == replace(known, probability=CHANCE)
    assert told(PATCHES, 3.0, named(NAMELESS, 0.9)) == named(NAMELESS, 0.9)
    assert told(PATCHES[:1], 3.0, known) == known


def test_of_joints_that_tell_nothing_none_is_astray() -> None:
    """The last joint of a robot may never have been read after a recording's first moments."""
    leg = Maker(RobotDescription.load("darwin_leg"))
    joints = len(leg.robot.joints)
    read = leg.measured.channel < joints - 1
    part = replace(
        leg.measured,
        **{
            n: getattr(leg.measured, n)[read]
            for n in ("index", "values", "recording", "channel", "time")
        },
    )
    errors = (
        0.002 * (1 + 9 * (part.channel == 1)) * np.random.default_rng(0).normal(size=read.sum())
    )
    fit = Fit((), np.empty(0), residual=errors / 0.002, jacobian=np.empty((len(errors), 0)))
    model = Model((), 0, fit, np.zeros(1), part, predicted=part.values - errors)
    noise = Noise(np.full(joints + 2, 0.002), np.zeros(joints + 2), "repeats")
    finding = patched(PATCHES, None, held_out(part, model, model, 0), model, noise, [])
    assert finding is not None and finding.place.name == leg.robot.joint_names[1]
