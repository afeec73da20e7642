"""Least squares on the unit cube, against closed forms, SciPy and a real replay."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import optimize

from pup.physics.mujoco_batch import MujocoSimulator
from pup.physics.parameters import ParameterSpace, robot_space
from pup.recording import Recording
from pup.robot import RobotDescription
from pup.sysid.excitation import script
from pup.sysid.gauss_newton import Residuals, confidence, least_point, least_squares
from pup.sysid.problem import Problem

Array = NDArray[np.float64]


def linear(matrix: Array, data: Array) -> Residuals:
    return lambda unit: unit @ matrix.T - data


def unit_space(count: int) -> ParameterSpace:
    names = tuple(f"p{i}" for i in range(count))
    zero = np.zeros(count)
    return ParameterSpace(names, ("1",) * count, zero + 0.5, zero, zero + 1.0)


def decay(time: Array, data: Array) -> Residuals:
    """Two decaying oscillations: amplitude, rate and frequency of each, on the unit cube."""

    def residuals(unit: Array) -> Array:
        a, r, f, b, s, g = (unit[:, i, None] for i in range(6))
        model = a * np.exp(-5 * r * time) * np.cos(9 * f * time)
        return model + b * np.exp(-5 * s * time) * np.sin(9 * g * time) - data

    return residuals


@pytest.mark.parametrize("seed", range(5))
def test_a_linear_problem_is_solved_with_its_walls(seed: int) -> None:
    """Optima beyond the cube: some coordinates end on a wall, as by SciPy's bounded solver."""
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(40, 6))
    beyond = np.array([-0.5, 1.4, 0.3, 0.6, 0.1, 0.9])
    data = matrix @ rng.permutation(beyond) + 0.1 * rng.normal(size=40)
    fit = least_squares(linear(matrix, data), np.full(6, 0.5), tolerance=1e-9)
    known = optimize.lsq_linear(matrix, data, (0, 1), tol=1e-12)
    on_wall = (known.x < 1e-6) | (known.x > 1 - 1e-6)
    assert on_wall.sum() >= 2
    assert fit.converged
    assert fit.best == pytest.approx(known.x, abs=2e-4)
    assert fit.cost == pytest.approx(known.cost, rel=1e-6)
    assert ((fit.best >= 0) & (fit.best <= 1)).all()


@pytest.mark.parametrize("anchored", [False, True])
def test_the_least_point_is_the_same_without_its_covariance(anchored: bool) -> None:
    rng = np.random.default_rng(7)
    matrix = rng.normal(size=(40, 4))
    problem, start = linear(matrix, matrix @ rng.uniform(size=4)), np.full(4, 0.5)
    anchor = np.full(4, 0.2) if anchored else None
    prior = {"prior_mean": anchor, "prior_sd": np.full(4, 0.3)} if anchored else {}
    whole = least_squares(problem, start, iterations=8, step=0.002, **prior)
    point, value = least_point(
        problem, np.ones(40), start, problem(start[None])[0], anchor, 0.3, iterations=8, step=0.002
    )
    np.testing.assert_allclose(value, problem(point[None])[0], atol=1e-9)
    np.testing.assert_allclose(point, whole.best, atol=1e-3)


def test_updated_jacobians_lead_further_than_the_one_they_are_made_of() -> None:
    time = np.linspace(0, 3, 150)
    truth = np.array([0.7, 0.2, 0.6, 0.4, 0.1, 0.3])
    residuals = decay(time, decay(time, np.zeros_like(time))(truth[None])[0])
    shares = []
    for seed in range(6):
        start = np.clip(truth + np.random.default_rng(seed).uniform(-0.1, 0.1, 6), 0, 1)
        value = residuals(start[None])[0]
        _, left = least_point(
            residuals, np.ones(150), start, value, None, 1.0, iterations=1, step=1e-3
        )
        once = least_squares(residuals, start, iterations=1, step=1e-3)
        shares.append(left @ left / 2 / once.cost)
    assert max(shares) <= 1.0
    assert np.median(shares) < 0.5


@pytest.mark.parametrize("seed", range(4))
def test_a_nonlinear_problem_ends_where_scipy_does(seed: int) -> None:
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 3, 150)
    truth = np.array([0.7, 0.2, 0.6, 0.4, 0.1, 0.3])
    data = decay(time, np.zeros_like(time))(truth[None])[0] + 0.02 * rng.normal(size=150)
    start = np.clip(truth + rng.uniform(-0.1, 0.1, 6), 0, 1)
    residuals = decay(time, data)
    fit = least_squares(residuals, start, tolerance=1e-8)
    known = optimize.least_squares(
        lambda unit: residuals(unit[None])[0], start, bounds=(0, 1), xtol=1e-12, ftol=1e-12
    )
    assert fit.converged
    assert fit.cost == pytest.approx(known.cost, rel=1e-5)
    assert fit.best == pytest.approx(known.x, abs=2e-3)


def test_a_gaussian_prior_is_weighed_as_by_bayes() -> None:
    """Residuals of unit variance: the optimum is the posterior mean of the normal model."""
    rng = np.random.default_rng(2)
    matrix, mean, sd = rng.normal(size=(30, 4)), np.full(4, 0.3), np.array([0.1, 0.2, 1.0, np.inf])
    data = matrix @ np.full(4, 0.6) + rng.normal(size=30)
    fit = least_squares(
        linear(matrix, data), np.full(4, 0.5), prior_mean=mean, prior_sd=sd, tolerance=1e-9
    )
    information = matrix.T @ matrix + np.diag(sd**-2.0)
    posterior = np.linalg.solve(information, matrix.T @ data + sd**-2.0 * mean)
    assert ((posterior > 0) & (posterior < 1)).all()
    assert fit.best == pytest.approx(posterior, abs=1e-4)
    free = least_squares(linear(matrix, data), np.full(4, 0.5), tolerance=1e-9)
    assert np.abs(free.best - mean)[0] > np.abs(fit.best - mean)[0]


def test_intervals_are_those_of_the_normal_model() -> None:
    rng = np.random.default_rng(3)
    matrix, noise = rng.normal(size=(400, 3)), 0.05
    data = matrix @ np.array([0.4, 0.5, 0.6]) + noise * rng.normal(size=400)
    fit = least_squares(linear(matrix, data), np.full(3, 0.5))
    told = confidence(unit_space(3), fit.best, fit.covariance)
    covariance = noise**2 * np.linalg.inv(matrix.T @ matrix)
    reach = 1.645 * np.sqrt(np.diag(covariance))
    assert fit.noise == pytest.approx(noise, rel=0.15)
    assert told.upper - fit.best == pytest.approx(reach, rel=0.2)
    assert fit.best - told.lower == pytest.approx(reach, rel=0.2)
    assert told.identified.all()
    assert np.diag(told.correlation) == pytest.approx(1)


def test_what_the_data_do_not_see_is_said_so() -> None:
    """A sum is seen, its parts are not; one parameter does nothing; one is seen well."""
    rng = np.random.default_rng(4)
    matrix = np.zeros((100, 4))
    matrix[:, 0] = matrix[:, 1] = rng.normal(size=100)
    matrix[:, 3] = rng.normal(size=100)
    data = matrix @ np.array([0.2, 0.6, 0.9, 0.4]) + 0.01 * rng.normal(size=100)
    start = np.full(4, 0.5)
    fit = least_squares(linear(matrix, data), start)
    told = confidence(unit_space(4), fit.best, fit.covariance)
    assert fit.converged
    assert told.identified.tolist() == [False, False, False, True]
    assert fit.best[2] == pytest.approx(start[2], abs=1e-3), "nothing moves it but rounding"
    assert fit.best[0] + fit.best[1] == pytest.approx(0.8, abs=0.01)
    assert told.correlation[0, 1] < -0.99
    assert abs(told.correlation[2]).tolist() == pytest.approx([0, 0, 1, 0], abs=1e-9)
    assert (told.lower >= 0).all()
    assert (told.upper <= 1).all()


def test_nothing_seen_at_all_stays_where_it_is() -> None:
    fit = least_squares(lambda unit: np.ones((len(unit), 5)), np.array([0.2, 0.9]))
    assert fit.converged
    assert fit.best.tolist() == [0.2, 0.9]
    assert np.isfinite(fit.covariance).all()


def test_wide_differences_lead_on_where_narrow_ones_see_a_stair() -> None:
    """Flat between steps of 1/200: a narrow difference sees no slope at all."""
    rng = np.random.default_rng(5)
    matrix = rng.normal(size=(60, 3))
    truth = np.array([0.3, 0.55, 0.7])

    def residuals(unit: Array) -> Array:
        return (np.round(200 * unit) / 200) @ matrix.T - matrix @ truth

    fit = least_squares(residuals, np.array([0.8, 0.2, 0.4]))
    assert fit.best == pytest.approx(truth, abs=0.02)


def test_a_kink_in_one_parameter_does_not_hold_back_the_others() -> None:
    """A ditch narrower than any step: its slope promises much, and every step meets a wall."""

    def residuals(unit: Array) -> Array:
        wall = 100 * np.abs(unit[:, 0] - 0.5) + 1.0
        ditch = np.where(np.abs(unit[:, 0] - 0.501) < 1e-9, 0.2, wall)
        return np.stack([ditch, unit[:, 1] - 0.7], axis=1)

    fit = least_squares(residuals, np.array([0.5, 0.2]), step=0.001)
    assert fit.best == pytest.approx([0.5, 0.7], abs=1e-3)


def test_replays_are_counted_and_come_in_batches() -> None:
    rng = np.random.default_rng(6)
    matrix = rng.normal(size=(30, 5))
    inner, batches = linear(matrix, matrix @ rng.uniform(0.2, 0.8, 5)), []

    def residuals(unit: Array) -> Array:
        batches.append(len(unit))
        assert (unit >= 0).all()
        assert (unit <= 1).all()
        return inner(unit)

    fit = least_squares(residuals, np.array([0.0, 1.0, 0.5, 0.99999, 1e-6]))
    assert fit.replays == sum(batches)
    assert set(batches[1:]) == {5}  # five parameters, five dampings
    batches.clear()
    start = np.full(5, 0.4)
    here = least_squares(residuals, start, iterations=0)
    assert batches == [1, 5]
    assert np.array_equal(here.best, start)
    assert not here.converged


PD = ("kp", "kd", "tau_max")


def leg_problem(noise: float) -> tuple[Problem, Array]:
    """Noisy steps of a virtual leg, its servo's parameters free; and their true values."""
    robot = RobotDescription.load("darwin_leg")
    rng = np.random.default_rng(8)
    space = robot_space(robot, "pd")
    free = tuple(n for n in space.names if n.split("/")[0] in PD)
    truth = space.at({"kp/hip": 19.0, "kp/ankle": 12.0, "kd/knee": 0.95, "tau_max/knee": 1.8})
    runs = tuple(
        Recording(
            id=m.id,
            robot=robot.name,
            motion=m.motion,
            support=m.support,
            source="simulation",
            joints=robot.joint_names,
            time=m.time,
            target=m.target,
            position=m.target,
        )
        for m in script(robot, ["step:0.3", "step:0.6"], rng, jitter=True)
    )
    simulator = MujocoSimulator(robot, runs, "pd")
    position = simulator.replay(truth.candidates()).position[0]
    measured = position + noise * rng.normal(size=position.shape)
    runs = tuple(
        replace(r, position=np.vstack([position[p][:1], measured[p][1:]]))
        for r, p in zip(runs, simulator.ticks, strict=True)
    )
    problem = Problem(robot, runs, "pd", space, free)
    return problem, truth.select(free).nominal


def position_errors(problem: Problem) -> Residuals:
    """The joints' errors, rad."""

    def residuals(unit: Array) -> Array:
        return problem.loss.errors(problem.replay(unit))[0].reshape(len(unit), -1)

    return residuals


def test_servo_parameters_of_a_leg_come_back_from_a_replay() -> None:
    """Well-determined parameters within their intervals, in few replays."""
    problem, truth = leg_problem(noise=0.002)
    space = problem.free_space
    fit = least_squares(position_errors(problem), space.normalise(space.nominal))
    told = confidence(space, fit.best, fit.covariance)
    gains = np.array([n.startswith(("kp/", "kd/")) for n in space.names])
    assert fit.converged
    assert fit.replays < 400
    assert fit.cost == pytest.approx(0.5 * 0.002**2 * _measured(problem), rel=0.1)
    assert told.identified[gains].all()
    missed = np.abs(space.denormalise(fit.best) - truth) / (told.upper - told.lower)
    assert (missed[told.identified] < 1).all(), dict(zip(space.names, missed, strict=True))
    assert space.denormalise(fit.best)[gains] == pytest.approx(truth[gains], rel=0.15)


def _measured(problem: Problem) -> int:
    return problem.loss.position.size - len(problem.recordings) * len(problem.robot.joints)
