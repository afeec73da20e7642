"""What no known effect explains: whether there is any, its law, and the law as physics."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from terms import BENCH, SERVO, steps, with_terms

from pup.diagnosis.discover import unexplained
from pup.diagnosis.fit import Fit
from pup.diagnosis.lacks import Lack
from pup.diagnosis.selection import Selector
from pup.physics.mujoco_batch import MujocoSimulator
from pup.physics.parameters import robot_space
from pup.physics.terms import TERMS, Place, column
from pup.physics.terms.learned import FEATURES, LearnedLaw, Seen, unit, value
from pup.robot import RobotDescription, TermSpec
from pup.robot_writer import write_corrected
from tests.diagnoses import Maker
from tests.located import fitted, measured_under, replays_of, settled

PLACE = Place("joint", "servo")
RUN = steps(BENCH, np.zeros(1), 2.0, "bench")
ENOUGH = 15.0


def law(feature: str, coefficient: float) -> dict[str, float]:
    return {column(LearnedLaw.effect, feature, PLACE): coefficient}


@pytest.mark.parametrize(
    ("feature", "expected"),
    [
        ("1", "N m"),
        ("q", "N m/rad"),
        ("u", "1"),
        ("|u|*sgn(v)", "1"),
        ("v*|v|", "N m s2/rad2"),
        ("q*u", "1/rad"),
        ("t*age", "N m/s2"),
        ("u*u", "1/(N m)"),
        ("sin(24q)", "N m"),
    ],
)
def test_a_coefficient_times_its_feature_is_a_torque(feature: str, expected: str) -> None:
    assert unit(feature) == expected


def test_features_are_what_their_names_say() -> None:
    seen = Seen(*(np.array([x]) for x in (0.5, -2.0, 0.01, 0.3)), 3.0, np.array([9.0]))
    assert value("v*|v|", seen)[0] == -4.0
    assert value("e*u", seen)[0] == pytest.approx(0.003)
    assert value("sgn(v)", seen)[0] == pytest.approx(-1)
    assert value("t*age", seen)[0] == 6.0  # a command does not grow older than 2 s
    assert value("cos(8q)", seen)[0] == pytest.approx(np.cos(4.0))


def test_no_two_features_are_the_same() -> None:
    rng = np.random.default_rng(0)
    seen = Seen(*rng.normal(size=(4, 200)), rng.uniform(0, 9, 200), rng.uniform(0, 2, 200))
    columns = np.stack([value(name, seen) for name in FEATURES])
    columns /= np.linalg.norm(columns, axis=1, keepdims=True)
    alike = np.abs(columns @ columns.T) - np.eye(len(columns))
    assert alike.max() < 0.999


@pytest.mark.parametrize(
    ("term", "feature", "sign"),
    [
        ("joint_spring/stiffness", "q", -1.0),
        ("joint_spring/preload", "1", 1.0),
        ("quadratic_damping/coefficient", "v*|v|", -1.0),
        ("cogging/sine", "sin(24q)", 1.0),
    ],
)
def test_a_law_acts_as_the_effect_it_describes(term: str, feature: str, sign: float) -> None:
    rows = [{f"{term}@{PLACE}": 0.05}, law(feature, sign * 0.05)]
    simulator = MujocoSimulator(BENCH, [RUN], "pd")
    told = simulator.replay(with_terms(BENCH, [SERVO | row for row in rows])).position
    assert told[1] == pytest.approx(told[0], abs=1e-12)


def test_a_law_is_no_effect_of_the_library_and_stands_in_a_robots_description(
    tmp_path: Path,
) -> None:
    assert LearnedLaw.effect not in TERMS
    name = "|u|*sgn(v)"
    spec = TermSpec(LearnedLaw.effect, "joint", "servo", {name: -0.2})
    write_corrected(BENCH, tmp_path / "corrected", {}, [spec])
    read = RobotDescription.load(tmp_path / "corrected")
    assert read.terms == (spec,)
    row = with_terms(BENCH, [law(name, -0.2)])
    told = MujocoSimulator(BENCH, [RUN], "pd").replay(row).position
    own = MujocoSimulator(read, [RUN], "pd").replay(robot_space(read, "pd").candidates()).position
    assert np.array_equal(told, own)


def test_a_law_outside_the_library_is_found_and_predicts_other_motions() -> None:
    name, size = "cos(4q)", 0.05
    replays = replays_of(measured_under(BENCH, law(name, size), ("step", "sine", "walk")))
    fit, noise = fitted(replays)
    selector = Selector(replays, noise, (), ENOUGH, fit)
    before = selector.nominal
    told = unexplained(before, selector, ())
    assert told is not None
    assert told.finding.effect == "unknown"
    assert told.finding.place == PLACE
    assert told.finding.law is not None
    assert told.finding.parameters.keys() == {name}
    coefficient = told.finding.parameters[name]
    assert coefficient.value == pytest.approx(size, rel=0.1)
    assert coefficient.unit == "N m"
    assert told.model.held_out.sum() < 0.5 * before.held_out.sum()
    assert told.terms == (TermSpec(LearnedLaw.effect, "joint", "servo", {name: coefficient.value}),)
    assert any(name in words for words in told.laws)


def test_what_is_no_more_than_noise_is_not_simulated_for() -> None:
    replays = replays_of(measured_under(BENCH, {}))
    near, noise = fitted(replays)
    loud = replace(noise, sigma=1.2 * noise.sigma)
    fit = settled(Fit(near.coordinates, near.at.copy()), replays, loud)
    selector = Selector(replays, loud, (), ENOUGH, fit)
    spent = replays.simulated
    assert unexplained(selector.nominal, selector, ()) is None
    assert replays.simulated == spent


def test_only_channels_that_are_more_than_noise_tell_how_much_is_left() -> None:
    """A few readings that are off by much may be so by chance."""
    maker = Maker(BENCH)
    left = maker.beyond(maker.nothing(), PLACE, None).unexplained
    assert left is not None
    missing = replace(left.missing, evidence=np.zeros_like(left.missing.evidence))
    few, many = Lack(1, 3.0, 2.0, None, 0.0, 0.0), Lack(0, 0.2, 8.0, None, 0.0, 0.0)
    assert replace(left, missing=missing, lacks=(few, many)).excess == 0.2


def test_noise_alone_is_not_called_unknown() -> None:
    for seed in range(3):
        replays = replays_of(measured_under(BENCH, {}, seed=seed))
        fit, noise = fitted(replays)
        selector = Selector(replays, noise, (), ENOUGH, fit)
        assert unexplained(selector.nominal, selector, ()) is None
