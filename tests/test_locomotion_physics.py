"""The walking task's physics: symmetry, determinism, resumption, step size."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from walking import (
    BOUNDS,
    CENTRE,
    DARWIN,
    EXACT,
    JOINTS,
    QPOS,
    QVEL,
    idle,
    random_actions,
    standing_robot,
    walking,
)

from pup.locomotion.evaluation import Walks, evaluate
from pup.locomotion.landscape import landscape
from pup.locomotion.sampling import ParameterSampler
from pup.locomotion.settings import Direction, TaskSettings
from pup.locomotion.task import WalkingTask
from pup.physics.parameters import robot_space
from pup.physics.rotations import multiply
from pup.sysid.result import FittedBounds

NOISY = TaskSettings()
PERMUTATION, SIGN = DARWIN.mirror()
State = dict[str, np.ndarray]


def moving(seed: int, n: int) -> State:
    """A task's state with random joints and velocities, a little into the floor.

    Just touching, whether a corner touches would hang on round-off.
    """
    disturbed = replace(
        EXACT, start_position_noise=0.03, start_velocity_noise=0.5, start_pitch_noise=0.1
    )
    task = walking(disturbed, robot=standing_robot(), n=n, seed=seed)
    task.reset()
    state = task.state()
    state["simulations/physics"][:, QPOS.start + 2] -= 5e-4
    return state


def mirrored(state: State) -> State:
    """The same robots seen in a mirror across their x-z plane."""
    state = {name: values.copy() for name, values in state.items()}
    physics = state["simulations/physics"]
    qpos, qvel = physics[:, QPOS], physics[:, QVEL]
    qpos[:, [1, 4, 6]] *= -1  # y, and the quaternion's turns about x and z
    qvel[:, [1, 3, 5]] *= -1
    qpos[:, 7:] = SIGN * qpos[:, 7:][:, PERMUTATION]
    qvel[:, 6:] = SIGN * qvel[:, 6:][:, PERMUTATION]
    velocity = state["simulations/velocity"]
    velocity[:] = SIGN * velocity[:, PERMUTATION]
    return state


def mirrored_bins(bins: np.ndarray) -> np.ndarray:
    bins = bins[:, PERMUTATION]
    return np.where(SIGN < 0, 2 * CENTRE - bins, bins)


@pytest.mark.parametrize("direction", [Direction.FORWARD, Direction.BACKWARD])
def test_a_mirrored_robot_with_mirrored_actions_does_the_mirror_image(direction: Direction) -> None:
    state = moving(seed=3, n=8)
    settings = replace(EXACT, direction=direction)
    left, right = (walking(settings, robot=standing_robot(), n=8) for _ in range(2))
    left.restore(state), right.restore(mirrored(state))
    rng = np.random.default_rng(0)
    for _ in range(3):
        action = random_actions(rng, 8, spread=2)  # within limits that are not mirror images
        one, other = left.step(action), right.step(mirrored_bins(action))
        seen = one.observation.proprioception
        image = np.hstack([SIGN * seen[:, JOINTS:40][:, PERMUTATION], seen[:, 40:42] * [-1, 1]])
        np.testing.assert_allclose(other.observation.proprioception[:, JOINTS:42], image, atol=2e-6)
        np.testing.assert_allclose(other.reward, one.reward, rtol=1e-4, atol=1e-4)
        np.testing.assert_array_equal(other.terminated, one.terminated)
        np.testing.assert_allclose(other.distance, one.distance, atol=1e-6)


def test_a_robot_turned_by_a_quarter_walks_the_turned_way() -> None:
    """What the paper does by turning its frame: readings know no yaw.

    By a quarter, as for sideways: MuJoCo's friction pyramid has the floor's axes.
    """
    state = moving(seed=5, n=4)
    turned = {name: values.copy() for name, values in state.items()}
    turn = np.array([1.0, 0.0, 0.0, 1.0]) / np.sqrt(2)
    matrix = np.array([[0.0, -1.0], [1.0, 0.0]])
    physics = turned["simulations/physics"]
    qpos, qvel = physics[:, QPOS], physics[:, QVEL]
    qpos[:, 3:7] = multiply(turn, qpos[:, 3:7])
    qvel[:, :2] = qvel[:, :2] @ matrix.T
    straight, other = (walking(robot=standing_robot(), n=4) for _ in range(2))
    straight.restore(state), other.restore(turned)
    for _ in range(2):
        one, two = straight.step(idle(4)), other.step(idle(4))
    np.testing.assert_allclose(
        two.observation.proprioception, one.observation.proprioception, atol=2e-6
    )
    places = straight.state()["episodes/place"], other.state()["episodes/place"]
    np.testing.assert_allclose(places[1][:, :2], places[0][:, :2] @ matrix.T, atol=1e-6)


def run(threads: int, seed: int = 7, steps: int = 25, n: int = 9) -> list[np.ndarray]:
    """Everything that a noisy run over drawn parameters returns."""
    task = walking(
        replace(NOISY, horizon=0.4),
        n=n,
        seed=seed,
        threads=threads,
        sampler=ParameterSampler(BOUNDS),
    )
    seen = [task.reset().proprioception]
    rng = np.random.default_rng(0)
    for _ in range(steps):
        step = task.step(random_actions(rng, n))
        seen += [step.observation.proprioception, step.observation.parameters, step.reward]
        seen += [step.terminated, step.truncated, step.live, step.distance]
    return seen


def test_a_seed_gives_the_same_episodes_on_any_number_of_threads() -> None:
    first = run(1)
    for threads in (1, 2, 4):
        for one, other in zip(first, run(threads), strict=True):
            np.testing.assert_array_equal(one, other)
    assert any((a != b).any() for a, b in zip(first, run(1, seed=8), strict=True))


@pytest.mark.parametrize("threads", [1, 2])
def test_a_restored_task_goes_on_bit_by_bit(threads: int) -> None:
    settings = replace(NOISY, horizon=0.4)
    sampler = ParameterSampler(BOUNDS)
    whole = walking(settings, n=6, sampler=sampler)
    whole.reset()
    rng = np.random.default_rng(0)
    for i in range(30):
        action = random_actions(rng, 6)
        if i in (3, 11, 14):  # among them one with simulations about to reset
            state = whole.state()
            other = walking(settings, n=6, seed=99, threads=threads, sampler=sampler)
            other.restore(state)
        step = whole.step(action)
        if i >= 3:
            same = other.step(action)
            for name in ("reward", "terminated", "truncated", "live", "distance", "time"):
                np.testing.assert_array_equal(getattr(step, name), getattr(same, name))
            for name in ("proprioception", "parameters", "true_parameters"):
                one, two = (getattr(s.observation, name) for s in (step, same))
                np.testing.assert_array_equal(one, two)
    for name, values in whole.state().items():
        np.testing.assert_array_equal(values, other.state()[name], err_msg=name)


def test_parameters_are_drawn_from_the_widened_bounds_and_told_with_noise() -> None:
    task = walking(NOISY, n=4000, sampler=ParameterSampler(BOUNDS))
    seen = task.reset()
    mu, told = seen.true_parameters, seen.parameters
    sampler = task.sampler
    physical = sampler.physical(mu.astype(float))
    search = BOUNDS.space.select(BOUNDS.names)
    assert (physical >= search.lower - 1e-6).all() and (physical <= search.upper + 1e-6).all()
    free = [BOUNDS.names.index(name) for name in ("rho/arm", "ground_friction", "torso_com/x")]
    assert mu[:, free].min() < -0.045 and mu[:, free].max() > 1.045
    assert np.abs(mu[:, free].mean(axis=0) - 0.5).max() < 0.03
    clamped = BOUNDS.names.index("sigma/arm")  # its lower bound is the end of the search range
    assert mu[:, clamped].min() == 0.0
    off = told - mu
    assert 0.24 < np.abs(off).max() <= 0.25 + 1e-6
    assert told.min() >= -0.05 - 1e-6 and told.max() <= 1.05 + 1e-6
    values = sampler.candidates(mu[:2].astype(float))
    np.testing.assert_allclose(values.columns(BOUNDS.names), physical[:2], rtol=1e-9)
    np.testing.assert_allclose(sampler.unit(physical), mu, atol=1e-6)
    before = task.state()["episodes/mu"]
    task.step(idle(4000))
    np.testing.assert_array_equal(task.state()["episodes/mu"], before)


def test_parameters_act_on_their_own_simulation_only() -> None:
    """Friction, torque limit and centre of mass, each alone against the nominal robot."""
    names = ("ground_friction", "torque_limit", "torso_com/x", "rho/knee")
    nominal = BOUNDS.space.nominal[[BOUNDS.space.names.index(n) for n in BOUNDS.names]]
    mu = np.tile(nominal, (6, 1))
    for row, (name, value) in enumerate(zip(names, (0.1, 0.5, 0.03, 0.4), strict=True), 1):
        mu[row, BOUNDS.names.index(name)] = value
    task = walking(n=6, sampler=ParameterSampler(BOUNDS, mu))
    task.reset()
    for _ in range(8):
        step = task.step(idle(6))
    seen = step.observation.proprioception
    np.testing.assert_array_equal(seen[0], seen[5])
    assert (np.abs(seen[1:5] - seen[0]).max(axis=1) > 1e-3).all()


def test_eight_sub_steps_agree_with_two_milliseconds_below_the_readings_noise() -> None:
    """Over 0.3 s of random actions; the fit's own error on recordings is 0.013 rad."""
    sampler = ParameterSampler(BOUNDS)
    seen = {}
    for substeps in (8, 20):
        settings = replace(EXACT, control_rate=(25.0, 33.0), substeps=substeps)
        task = walking(settings, robot=standing_robot(), n=64, sampler=sampler)
        task.reset()
        rng = np.random.default_rng(0)
        for _ in range(9):
            step = task.step(random_actions(rng, 64))
        seen[substeps] = step.observation.proprioception[:, JOINTS : 2 * JOINTS]
    off = seen[8] - seen[20]
    assert np.sqrt((off**2).mean()) < 0.01 and abs(off.mean()) < 0.001


def test_the_pd_law_walks_too() -> None:
    """Its damping is taken implicitly in part, by each simulation's own time step."""
    pd = FittedBounds(
        actuator="pd",
        space=robot_space(DARWIN, "pd"),
        names=("kp/knee", "armature"),
        lower=np.array([10.0, 0.0005]),
        upper=np.array([20.0, 0.005]),
    )
    task = walking(NOISY, n=8, sampler=ParameterSampler(pd), robot=standing_robot())
    task.reset()
    for _ in range(30):
        step = task.step(idle(8))
    assert not step.terminated.all()
    assert np.isfinite(step.observation.proprioception).all()


def test_a_landscape_walks_each_eta_on_each_of_the_drawn_parameters(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In batches; those with the same mu and eta walk alike. Mu is drawn as for training."""
    seen: list[np.ndarray] = []

    def policy(proprioception: np.ndarray, eta: np.ndarray) -> np.ndarray:
        return idle(len(proprioception)) + np.rint(5 * eta).astype(int)

    def evaluated(act: Any, task: WalkingTask) -> Walks:
        assert task.n <= 4 and task.sampler.mu is not None
        seen.append(task.sampler.mu)
        return evaluate(act, task)

    monkeypatch.setattr("pup.locomotion.landscape.BATCH", 4)
    monkeypatch.setattr("pup.locomotion.landscape.evaluate", evaluated)
    eta = np.array([[0.2], [-0.2], [0.2]])
    short = replace(EXACT, horizon=0.4)
    distance = landscape(policy, DARWIN, BOUNDS, short, eta, draws=3, seed=1, threads=1)
    assert distance.shape == (3, 3)
    np.testing.assert_allclose(distance[:, 0], distance[:, 2], rtol=1e-9)
    assert (distance[:, 0] != distance[:, 1]).all() and len(set(distance[:, 0])) == 3
    sampler = ParameterSampler(BOUNDS)
    mu = sampler.physical(sampler.draw(np.random.default_rng(1), np.arange(3)))
    assert [len(part) for part in seen] == [4, 4, 1]
    np.testing.assert_array_equal(np.concatenate(seen), np.repeat(mu, 3, axis=0))


def test_a_policy_is_judged_by_one_episode_of_each_simulation() -> None:
    given = np.random.default_rng(0).uniform(BOUNDS.lower, BOUNDS.upper, (5, 14))
    task = walking(replace(NOISY, horizon=2.0), n=5, sampler=ParameterSampler(BOUNDS, given))
    walks = evaluate(lambda seen, parameters: idle(len(seen)), task)
    np.testing.assert_allclose(walks.parameters, task.sampler.unit(given), atol=1e-6)
    assert walks.fell.all() and ((walks.time > 0.3) & (walks.time < 2.0)).all()
    assert walks.distance.shape == walks.reward.shape == (5,)
    standing = walking(
        replace(EXACT, horizon=1.0), n=5, robot=standing_robot(),
        sampler=ParameterSampler(BOUNDS, given),
    )  # fmt: skip
    walks = evaluate(lambda seen, parameters: idle(len(seen)), standing)
    assert not walks.fell.any() and (walks.time >= 1.0).all()
    assert walks.summary()["upright_share"] == 1.0


@pytest.mark.parametrize("aside", [-0.4, 0.4])
def test_a_robot_off_its_course_ends_an_episode_of_a_training_only(aside: float) -> None:
    for settings in (EXACT, EXACT.evaluation()):
        task = walking(settings, n=2, robot=standing_robot())
        task.reset()
        task._episodes.start[1, 1] -= aside  # as if it had come from there
        step = task.step(idle(2))
        assert step.terminated.tolist() == [False, settings.on_course]
        np.testing.assert_allclose(step.aside, [0.0, aside], atol=0.01)
