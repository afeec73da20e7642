"""Traces put together from few simulations against those of simulations of their own."""

from dataclasses import replace

import numpy as np
import pytest

from pup.diagnosis.coordinates import nominal_coordinate
from pup.diagnosis.fit import Fit
from pup.diagnosis.fitting import fit_together
from pup.diagnosis.hypotheses import MODERATE, Hypothesis, hypotheses
from pup.diagnosis.noise import assumed_noise
from pup.diagnosis.probing import changes
from pup.diagnosis.replays import Bench, Replays, threads
from pup.diagnosis.residuals import Measured
from pup.diagnosis.tracing import SMALL, by_rank, traces
from pup.physics.parameters import robot_space
from pup.recording import load_recordings
from pup.robot import RobotDescription
from tests.diagnosis_cases import BENCH, recordings

OP2 = RobotDescription.load("darwin_op2")
SHIPPED = OP2.model_path.parent / "recordings"
Found = dict[Hypothesis, np.ndarray]


@pytest.fixture(scope="module")
def replays() -> Replays:
    """One recording in the air and one on the ground."""
    runs = load_recordings([SHIPPED / f"{name}.parquet" for name in ("step_0.1_0", "standup_2")])
    measured = Measured.of(OP2, runs)
    return Replays(measured, robot_space(OP2, "pd"), threads(Bench(measured), 1), 1)


@pytest.fixture(scope="module")
def base(replays: Replays) -> Fit:
    """The robot as it is described, with its sensitivity to one gain."""
    coordinate = nominal_coordinate(replays.space, "kp/hip")
    nominal = replays.space.nominal[replays.space.names.index("kp/hip")]
    fit = Fit((coordinate,), np.array([coordinate.coordinate(nominal)]))
    fit_together([fit], replays, assumed_noise(replays.measured), iterations=1)
    return fit


@pytest.fixture(scope="module")
def found(replays: Replays, base: Fit) -> Found:
    """What damping leaves in the samples, by where it is."""
    noise = assumed_noise(replays.measured)
    asked = [h for h in hypotheses(replays.measured) if h.effect == "quadratic_damping"]
    return {t.hypothesis: t.whole[:, 0] for t in traces(asked, base, replays, noise)}


def test_what_joints_change_together_is_the_sum_of_each(
    replays: Replays, base: Fit, found: Found
) -> None:
    """In the air by superposition, in longer sub-steps; on the ground by a simulation of all."""
    air = ~replays.measured.grounded
    told = [h for h in found if h.place.kind == "group"]
    assert told
    for hypothesis in told:
        own = _simulated(hypothesis, base, replays)
        assert np.linalg.norm((found[hypothesis] - own)[air]) < 0.05 * np.linalg.norm(own[air])
        assert found[hypothesis][~air] == pytest.approx(own[~air], rel=0.02, abs=0.02)


def test_joints_of_promising_groups_are_simulated_on_the_ground(
    replays: Replays, base: Fit, found: Found
) -> None:
    ground = replays.measured.grounded
    for hypothesis, whole in found.items():
        if hypothesis.place.kind == "joint":  # there are fewer groups than are promising
            own = _simulated(hypothesis, base, replays)
            assert whole[ground] == pytest.approx(own[ground], rel=0.02, abs=0.02)


def test_a_joint_that_was_not_simulated_is_as_promising_as_its_group(found: Found) -> None:
    claims = {h.key: h for h in found if h.place.kind in ("joint", "group")}
    groups = [h for h in claims.values() if h.place.kind == "group"]
    alone = [h for h in claims.values() if h.place.kind == "joint"]
    told = by_rank([*alone, *groups], {h.key: i for i, h in enumerate(groups)}, OP2)
    for joint in alone:
        above = [g for g in groups if set(joint.place.joints(OP2)) < set(g.place.joints(OP2))]
        later = groups[groups.index(above[0]) + 1 :] if above else []
        assert all(told.index(joint) < told.index(group) for group in later)
    assert {h.key for h in told} == set(claims)


@pytest.mark.parametrize("share", [1.0, SMALL])
def test_a_single_joint_is_looked_at_in_the_size_that_is_most_like_the_errors(share: float) -> None:
    measured = Measured.of(BENCH, recordings({}))
    replays = Replays(measured, robot_space(BENCH, "pd"), threads(Bench(measured), 1), 1)
    noise = assumed_noise(measured)
    coordinate = nominal_coordinate(replays.space, "kp/servo")
    nominal = replays.space.nominal[replays.space.names.index("kp/servo")]
    fit = Fit((coordinate,), np.array([coordinate.coordinate(nominal)]))
    fit_together([fit], replays, noise, iterations=1)
    known = next(h for h in hypotheses(measured) if h.effect == "backlash")
    probes = known.probes(share)
    changed = changes([(fit.row(), probes, probes)], replays)[0]
    whole = measured.whiten(changed, noise)[0] / (share * MODERATE)
    told = traces([known], replace(fit, residual=whole), replays, noise)[0]
    assert told.whole[:, 0] == pytest.approx(whole, rel=1e-6, abs=1e-6)


def _simulated(hypothesis: Hypothesis, base: Fit, replays: Replays) -> np.ndarray:
    """The trace of a hypothesis by a simulation of its own."""
    here, there = replays([base.row(), {**base.row(), **hypothesis.probes()[0]}])
    noise = assumed_noise(replays.measured)
    return np.asarray(replays.measured.whiten((there - here)[None], noise)[0] / MODERATE)
