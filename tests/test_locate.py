"""Where something is missing: pushes, chains of knots, the missing input and splits."""

import numpy as np
import pytest
from terms import BENCH, LEG, OP2, SERVO, held, with_terms
from test_simulator import recording

from pup.diagnosis.banded import Chain
from pup.diagnosis.fit import Fit
from pup.diagnosis.impulses import responses
from pup.diagnosis.locate import BAND, explained_by, missing_input
from pup.diagnosis.splits import splits
from pup.physics.mujoco_batch import MujocoSimulator
from pup.physics.push import WRENCH, Push
from tests.located import fitted, measured_under, replays_of, settled


def test_no_push_changes_no_bit_and_a_push_deflects_by_its_torque_over_the_stiffness() -> None:
    simulator = MujocoSimulator(BENCH, [held(0.0, 2.0)], "pd")
    row = with_terms(BENCH, [SERVO])
    nothing = np.zeros((1, 1, 30, 1 + WRENCH))
    torque = nothing.copy()
    torque[..., 0] = 0.06
    plain = simulator.replay(row).position
    assert np.array_equal(simulator.replay(row, Push(0.1, nothing)).position, plain)
    pushed = simulator.replay(row, Push(0.1, torque)).position
    stiffness = SERVO["kp/servo"] + 0.3247 * 9.81 * 0.1
    assert pushed[0, -1, 0] - plain[0, -1, 0] == pytest.approx(0.06 / stiffness, rel=1e-3)


def test_a_wrench_on_a_free_torso_shows_in_the_feet_as_its_impulse_over_the_mass() -> None:
    time = np.arange(0, 0.1, 0.02)
    stand = np.tile(OP2.poses["stand"], (len(time), 1))
    run = recording(OP2, time, stand, stand[0], "ground")
    simulator = MujocoSimulator(OP2, [run], "pd")
    row = with_terms(OP2, [{}])
    push = np.zeros((1, 1, 10, len(OP2.joints) + WRENCH))
    plain = simulator.replay(row).feet
    push[..., -4] = 100.0  # N upwards: the robot of 3 kg leaves the floor
    lifted = simulator.replay(row, Push(0.02, push)).feet
    mass = simulator.groups[0].model.compiled.body_mass.sum()
    rise = (lifted - plain)[0, -1, :, 2].mean()
    assert rise == pytest.approx((100 / mass - 9.81) * 0.08**2 / 2, rel=0.2)


def test_a_chain_is_solved_and_inverted_as_the_whole_matrix() -> None:
    rng = np.random.default_rng(0)
    whole = np.zeros((2, 12, 12))
    for number in range(2):
        root = np.tril(np.triu(rng.normal(size=(12, 12)), -3)) + 4 * np.eye(12)
        root[4:8, :4] = rng.normal(size=(4, 4))
        root[8:, :4] = 0
        whole[number] = root @ root.T
    blocks = whole.reshape(2, 3, 4, 3, 4).transpose(0, 1, 3, 2, 4)
    chain = Chain(
        np.stack([blocks[:, i, i] for i in range(3)], axis=1),
        np.stack([blocks[:, i, i + 1] for i in range(2)], axis=1),
    )
    factor = chain.factor()
    right = rng.normal(size=(2, 12, 5))
    solved = factor.solve(right.reshape(2, 3, 4, 5)).reshape(2, 12, 5)
    assert solved == pytest.approx(np.linalg.solve(whole, right), abs=1e-9)
    assert factor.logdet() == pytest.approx(np.linalg.slogdet(whole)[1])
    inverse = np.linalg.inv(whole).reshape(2, 3, 4, 3, 4).transpose(0, 1, 3, 2, 4)
    told = factor.inverse()
    for i in range(3):
        assert told.diagonal[:, i] == pytest.approx(inverse[:, i, i], abs=1e-9)
    for i in range(2):
        assert told.beside[:, i] == pytest.approx(inverse[:, i, i + 1], abs=1e-9)


def test_a_torque_from_outside_is_found_at_its_joint_in_its_size_and_at_its_time() -> None:
    knee, period, knots = LEG.joint_names.index("l_knee"), 0.04, 80
    time = period * np.arange(knots)
    true = 0.15 * np.exp(-(((time - 1.5) / 0.2) ** 2))
    push = np.zeros((1, 2, knots, len(LEG.joints) + WRENCH))
    push[0, 1, :, knee] = true
    replays = replays_of(measured_under(LEG, {}, push=Push(period, push)))
    fit, noise = fitted(replays)
    told = explained_by(responses(fit, replays, noise), fit)
    name, evidence = told.ranking()[0]
    assert name == "l_knee"
    assert evidence > 30
    assert sum(told.evidence > 5) == 1
    mean, band = (part[1][:70, knee] for part in (told.mean, told.deviation))
    assert np.corrcoef(mean, true[:70])[0, 1] > 0.95
    assert mean.max() == pytest.approx(0.15, abs=0.03)
    assert np.mean(np.abs(mean - true[:70]) < BAND * band) > 0.75
    assert np.abs(told.mean[0][:, knee]).max() < 0.05


def test_nothing_is_located_where_nothing_is_missing() -> None:
    replays = replays_of(measured_under(LEG, {}, seed=5))
    fit, noise = fitted(replays)
    told = missing_input(fit, replays, noise)
    assert told.evidence.max() < 5
    assert told.noise == pytest.approx(1.0, abs=0.05)


def test_a_drift_splits_early_from_late_until_it_is_in_the_model() -> None:
    drift = {"thermal_drift/rate@robot": 0.12}
    replays = replays_of(measured_under(BENCH, drift))
    fit, noise = fitted(replays)
    early = next(s for s in splits(fit, replays, noise) if s.first == "late")
    kp = early.ratios[0]
    assert kp.parameter == "kp"
    assert kp.value == pytest.approx(1 - 0.12 * 1.5, abs=0.08)  # told by one linear step
    assert early.chance < 1e-6
    assert early.gained is not None
    assert early.gained > 0.5 * early.promised
    whole = settled(Fit(fit.coordinates, fit.at.copy(), fixed=drift), replays, noise)
    after = next(s for s in splits(whole, replays, noise) if s.first == "late")
    assert after.chance > 1e-3
    assert after.ratios[0].value == pytest.approx(1, abs=0.03)
