"""Which effects are refitted: of each the best form, and everywhere what a group shows."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pup.diagnosis.evidence import Score, Trace
from pup.diagnosis.fit import Fit
from pup.diagnosis.hypotheses import Hypothesis
from pup.diagnosis.shortlist import FINALISTS, shortlist, suspected
from pup.physics.terms import Place
from pup.physics.terms.scale import Scale
from pup.robot import RobotDescription

SCALE = Scale.of(RobotDescription.load("darwin_leg"))
ONE = np.ones((1, 1))
ALL, ANKLE, KNEE = Place("robot"), Place("group", "ankle"), Place("joint", "l_knee")


def score(effect: str, place: Place, surprise: float) -> Score:
    trace = Trace(Hypothesis(effect, place, SCALE), ONE, ONE, ONE)
    return Score(trace, surprise, 1, np.ones(1))


def chosen(*ranking: Score) -> list[tuple[str, Place]]:
    return [s.trace.hypothesis.key for s in shortlist(ranking, enough=15.0)]


def test_what_a_group_shows_is_looked_at_everywhere() -> None:
    """Its slope at all joints may promise nothing, as other joints hide it in their gains."""
    first = score("cogging", KNEE, 500.0)
    group = score("derivative_kick", ANKLE, 300.0)
    everywhere = score("derivative_kick", ALL, 2.0)
    other = score("coulomb_friction", ALL, 2.0)
    found = [("cogging", KNEE), ("derivative_kick", ANKLE)]
    assert chosen(first, group, everywhere, other) == [*found, ("derivative_kick", ALL)]


def test_what_a_joint_shows_is_not() -> None:
    first, joint = score("cogging", KNEE, 500.0), score("derivative_kick", KNEE, 300.0)
    everywhere = score("derivative_kick", ALL, 2.0)
    assert ("derivative_kick", ALL) not in chosen(first, joint, everywhere)


def test_what_promises_little_beside_the_best_is_left() -> None:
    joints = [Place("joint", f"j{i}") for i in range(20)]
    many = [score("cogging", place, 500.0 - i) for i, place in enumerate(joints)]
    assert len(chosen(*many)) == FINALISTS
    assert chosen(many[0], score("backlash", KNEE, 49.0)) == [many[0].trace.hypothesis.key]


def test_the_class_of_the_best_is_looked_at_where_that_acts() -> None:
    rival = score("quadratic_damping", ANKLE, 1.0)
    assert chosen(score("torque_speed_limit", ANKLE, 90.0), rival)[1:] == [
        rival.trace.hypothesis.key
    ]


def test_effects_of_contact_are_looked_at_whatever_they_promise() -> None:
    """A nominal fit that lacks a soft floor ends where the floor's slope says nothing of it."""
    first = score("backlash", KNEE, 5000.0)
    soft = score("ground_compliance", Place("ground"), 1.0)
    slippery = score("ground_friction", Place("foot", "l_foot"), 0.5)
    late = score("imu_delay", Place("sensor"), 0.5)
    ranking, effects = (first, soft, slippery, late), [soft, slippery, late]
    assert chosen(*ranking) == [first.trace.hypothesis.key]
    told = [s.trace.hypothesis.key for s in shortlist(ranking, 15.0, contact=True)]
    assert told[1:] == [s.trace.hypothesis.key for s in effects]


@pytest.mark.parametrize(
    ("air", "ground", "expected"),
    [
        (1.22, 6.27, True),  # a soft floor under a quadruped
        (6.74, 54.4, True),  # one that leans: nominal fits take errors of contact into the air
        (None, 6.27, True),
        (40.0, 90.0, False),  # servos that are weaker with speed, hung up and on the ground
        (5.0, None, False),
        (1.0, 1.01, False),
    ],
)
def test_contact_is_suspected_where_motions_on_the_ground_are_worse(
    air: float | None, ground: float | None, expected: bool
) -> None:
    told = [(a, g) for a, g in ((air, False), (ground, True)) if a is not None]
    measured: Any = SimpleNamespace(grounded=np.repeat([g for _, g in told], 100))
    residual = np.repeat([np.sqrt(a) for a, _ in told], 100)
    fit = Fit((), np.empty(0), residual=residual, chi2=float(residual @ residual))
    assert suspected(fit, measured) is expected
