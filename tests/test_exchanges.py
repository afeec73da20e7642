"""Effects found at several places, one after the other, are tried as one at all of them."""

from dataclasses import replace

import numpy as np
import pytest

from pup.diagnosis.coordinates import nominal_coordinate, term_coordinate
from pup.diagnosis.exchanges import widened
from pup.diagnosis.fitting import Fit, fit_together
from pup.diagnosis.hypotheses import Hypothesis, hypotheses
from pup.diagnosis.models import Model, Round
from pup.diagnosis.noise import assumed_noise
from pup.diagnosis.nominal import free_names
from pup.diagnosis.replays import Bench, Replays, threads, union
from pup.diagnosis.residuals import Measured
from pup.physics.mujoco_batch import MujocoSimulator
from pup.physics.parameters import robot_space
from pup.physics.terms import Place
from pup.robot import RobotDescription
from tests import diagnoses

LEG = RobotDescription.load("darwin_leg")
SPACE = robot_space(LEG, "pd")
FRICTION = 0.09
"""At all joints, N m."""


@pytest.fixture(scope="module")
def replays() -> Replays:
    """Waves of a leg whose joints all have dry friction."""
    rng = np.random.default_rng(4)
    plans = []
    for plan in diagnoses.recordings(LEG, ticks=90, motions=("chirp", "triangle")):
        swing = rng.uniform(2.0, 5.0, 6) * plan.time[:, None] + rng.uniform(0, 6, 6)
        plans.append(replace(plan, target=0.25 * np.sin(swing), position=np.zeros((90, 6))))
    missing = {"coulomb_friction/torque@robot": FRICTION}
    told = MujocoSimulator(LEG, plans, "pd").replay(
        union(SPACE, [missing]).at(missing).candidates()
    )
    read = told.position[0] + diagnoses.SIGMA * rng.normal(size=told.position[0].shape)
    real = [replace(p, position=read[part]) for p, part in zip(plans, told.ticks, strict=True)]
    measured = Measured.of(LEG, real)
    return Replays(measured, SPACE, threads(Bench(measured), 1), 1)


def found(replays: Replays, places: list[Place]) -> tuple[Model, list[Round]]:
    """A model that has friction at some places, and the rounds that chose it there."""
    known = {h.key: h for h in hypotheses(replays.measured)}
    several = tuple(known["coulomb_friction", place] for place in places)
    coordinates = [nominal_coordinate(SPACE, n) for n in free_names(SPACE, ground=False)]
    at = [c.coordinate(SPACE.nominal[SPACE.names.index(c.name)]) for c in coordinates]
    for hypothesis in several:
        coordinates += [term_coordinate(n, hypothesis.scale) for n in hypothesis.magnitudes]
        at += [0.5]
    fit = Fit(tuple(coordinates), np.array(at))
    fit_together([fit], replays, assumed_noise(replays.measured))

    def model(hypotheses: tuple[Hypothesis, ...]) -> Model:
        return Model(hypotheses, len(hypotheses), fit, np.zeros(2), replays.measured)

    each = [model(several[: i + 1]) for i in range(len(several))]
    return each[-1], [Round(each[0], (), (one,), 1) for one in each]


def test_what_all_joints_have_is_told_of_all(replays: Replays) -> None:
    places = [Place("joint", "l_knee"), Place("joint", "l_ank_pitch")]
    model, rounds = found(replays, places)
    assert model.fit.chi2 > 1.5 * model.samples, "other joints have friction too"
    ways = list(widened(model, rounds, hypotheses(replays.measured), LEG))
    assert [way.hypotheses[-1].place for way in ways] == [Place("robot")]
    fit_together([way.fit for way in ways], replays, assumed_noise(replays.measured))
    assert ways[0].fit.chi2 < 1.2 * model.samples
    assert ways[0].fit.values["coulomb_friction/torque@robot"] == pytest.approx(FRICTION, rel=0.1)
    assert [h.place for h in ways[0].given_up] == places
    assert ways[0].round is rounds[0]


def test_one_place_is_left_as_it_is(replays: Replays) -> None:
    model, rounds = found(replays, [Place("joint", "l_knee")])
    assert not list(widened(model, rounds, hypotheses(replays.measured), LEG))


def test_a_group_that_holds_them_is_a_way_too(replays: Replays) -> None:
    places = [Place("joint", "l_ank_roll"), Place("joint", "l_ank_pitch")]
    model, rounds = found(replays, places)
    ways = list(widened(model, rounds, hypotheses(replays.measured), LEG))
    assert {way.hypotheses[-1].place for way in ways} == {Place("group", "ankle"), Place("robot")}
