"""The walking task: what it rewards, ends, starts and observes."""

import json
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from walking import (
    BOUNDS,
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

from pup.errors import InputError
from pup.locomotion.reference import Reference
from pup.locomotion.sampling import ParameterSampler
from pup.locomotion.settings import Direction, TaskSettings
from pup.locomotion.task import COURSE, PACE
from pup.physics.actuators import NetworkPD
from pup.robot import RobotDescription

NOISY = TaskSettings()
SILENT = replace(
    EXACT, alive=0.0, speed_weight=0.0, torque_weight=0.0, work_weight=0.0,
    tracking_weight=0.0, lateral_weight=0.0,
)  # fmt: skip


def test_the_reference_is_the_authors_gait_behind_the_half_squat(shared: Path) -> None:
    facts = json.loads((shared / "facts" / "reference_gait.json").read_text())
    assert DARWIN.gait is not None
    reference = Reference(DARWIN.gait)
    time = np.linspace(0.2, 3.0, 50)
    phase = (time - 0.2) / facts["period_s_as_played_by_authors_0.03s_rows"]
    expected = []
    for joint in DARWIN.joint_names:
        series = facts["joints"][joint]
        expected.append(
            series["c0"]
            + sum(a * np.cos(2 * np.pi * h * phase) for h, a in enumerate(series["a"], 1))
            + sum(b * np.sin(2 * np.pi * h * phase) for h, b in enumerate(series["b"], 1))
        )
    np.testing.assert_allclose(reference.angles(time), np.transpose(expected), atol=1e-9)
    start, middle, end = reference.angles(np.array([0.0, 0.1, 0.2]))
    np.testing.assert_array_equal(start, DARWIN.poses["half_squat"])
    np.testing.assert_allclose(middle, (start + end) / 2, atol=1e-12)


def test_targets_are_the_reference_plus_reach_times_the_mean_of_the_last_five_actions(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    task = walking()
    told = []
    step = task._simulations.step

    def kept(target: np.ndarray, running: np.ndarray) -> object:
        told.append(target)
        return step(target, running)

    monkeypatch.setattr(task._simulations, "step", kept)
    task.reset()
    rng, actions, times = np.random.default_rng(1), [], [np.zeros(4)]
    for _ in range(8):
        actions.append(random_actions(rng, 4))
        times.append(task.step(actions[-1]).time)
    for i, target in enumerate(told):
        mean = np.mean([a / 5 - 1 for a in actions[max(0, i - 4) : i + 1]], axis=0)
        expected = task.reference.angles(times[i]) + 0.3 * mean
        limits = [[j.lower for j in DARWIN.joints], [j.upper for j in DARWIN.joints]]
        np.testing.assert_allclose(target, np.clip(expected, *limits), atol=1e-12)


def test_the_reward_is_the_papers_with_each_weight_on_its_own_term() -> None:
    """Paper, section VI-A; speed and tracking from what the task reports."""
    rng = np.random.default_rng(2)
    actions = [random_actions(rng, 4) for _ in range(6)]

    def rewards(**weights: float) -> np.ndarray:
        task = walking(replace(SILENT, **weights))
        task.reset()
        return np.array([task.step(action).reward for action in actions])

    alone = {
        name: rewards(**{name: getattr(EXACT, name)})
        for name in (
            "alive", "speed_weight", "torque_weight", "work_weight", "tracking_weight",
            "lateral_weight",
        )
    }  # fmt: skip
    np.testing.assert_array_equal(alone["alive"], 5.0)
    task, whole = walking(), []
    task.reset()
    distance, time = np.zeros(4), np.zeros(4)
    for i, action in enumerate(actions):
        reference = task.reference.angles(time)
        step = task.step(action)
        speed = (step.distance - distance) / (step.time - time)
        np.testing.assert_allclose(alone["speed_weight"][i], 10 * speed, rtol=1e-5, atol=1e-6)
        position = step.observation.proprioception[:, JOINTS : 2 * JOINTS]
        off = 0.2 * ((reference - position) ** 2).sum(axis=1)
        np.testing.assert_allclose(alone["tracking_weight"][i], -off, rtol=1e-4, atol=1e-6)
        distance, time = step.distance, step.time
        whole.append(step.reward)
    np.testing.assert_allclose(np.sum(list(alone.values()), axis=0), whole, rtol=1e-5, atol=1e-5)
    assert (alone["torque_weight"] < 0).all() and (alone["lateral_weight"] <= 0).all()


def test_torque_work_and_sway_are_those_of_the_last_sub_step() -> None:
    """One sub-step of 4 ms from a known state, so that each can be computed by hand."""
    one = replace(SILENT, control_rate=(250.0, 250.0), substeps=1, start_velocity_noise=0.3)
    task = walking(replace(one, torque_weight=1.0))
    task.reset()
    before = task.state()["simulations/physics"]
    action = idle(4)
    costs = {
        name: walking(replace(one, **{name: 1.0}))
        for name in ("torque_weight", "work_weight", "lateral_weight")
    }
    told = {}
    for name, other in costs.items():
        other.reset()
        told[name] = -other.step(action).reward
    after = costs["torque_weight"].state()["simulations/physics"]
    nominal = BOUNDS.space.candidates(np.tile(BOUNDS.space.nominal, (4, 1)))
    law = NetworkPD(DARWIN, nominal)
    error = task.reference.angles(np.zeros(4)) - before[:, QPOS][:, 7:]
    kp, kd = law.gains(error, before[:, QVEL][:, 6:])
    velocity = after[:, QVEL][:, 6:]
    torque = kp * error - kd * velocity
    assert (np.abs(torque) < law.limit).all()
    np.testing.assert_allclose(told["torque_weight"], (torque**2).sum(axis=1), rtol=1e-5)
    work = (torque * velocity).sum(axis=1)
    np.testing.assert_allclose(told["work_weight"], work, rtol=1e-4, atol=1e-6)
    model = task._simulations._parts[0].batch.get_model(0)
    data = mujoco.MjData(model)
    for row, state in enumerate(before):
        data.qpos[:], data.qvel[:] = state[QPOS], state[QVEL]
        mujoco.mj_forward(model, data)
        mujoco.mj_subtreeVel(model, data)
        sway = abs(data.subtree_linvel[model.body("body").id, 1])
        assert told["lateral_weight"][row] == pytest.approx(sway, rel=1e-5)


def test_an_episode_ends_keeps_its_last_observation_and_starts_anew_in_the_next_step() -> None:
    settings = replace(NOISY, horizon=0.3)
    task = walking(settings, n=16)
    first = task.reset()
    assert first.proprioception.shape == (16, len(task.observation_names)) == (16, 44)
    ended, age = np.zeros(16, dtype=bool), np.zeros(16)
    ends = np.zeros(16, dtype=int)
    seen = first
    for _ in range(40):
        step = task.step(idle(16))
        np.testing.assert_array_equal(step.live, ~ended)
        new, now = seen.proprioception, step.observation.proprioception
        last = now[:, :JOINTS], now[:, 42:]  # the readings before are those of the last step
        np.testing.assert_array_equal(last[0][step.live], new[:, JOINTS : 2 * JOINTS][step.live])
        np.testing.assert_array_equal(last[1][step.live], new[:, 40:42][step.live])
        fresh = ~step.live  # a first observation has one reading, twice
        np.testing.assert_array_equal(now[fresh, :JOINTS], now[fresh, JOINTS : 2 * JOINTS])
        assert (step.reward[fresh] == 0).all() and (step.time[fresh] == 0).all()
        assert (step.distance[fresh] == 0).all()
        assert not (step.terminated | step.truncated)[fresh].any()
        age = np.where(fresh, 0, step.time)
        assert not (step.terminated & step.truncated).any()
        np.testing.assert_array_equal(step.truncated, step.live & ~step.terminated & (age >= 0.3))
        assert (step.reward[step.terminated] == 0).all()
        assert (age < 0.3 + 0.04).all()
        ended, seen = step.terminated | step.truncated, step.observation
        ends += ended
    assert (ends >= 3).all()


def test_the_action_of_a_reset_is_ignored() -> None:
    rng = np.random.default_rng(0)
    one, other = (walking(replace(NOISY, horizon=0.1), n=4) for _ in range(2))
    one.reset(), other.reset()
    over = np.zeros(4, dtype=bool)
    for _ in range(12):
        action = random_actions(rng, 4)
        step = one.step(action)
        unlike = np.where(over[:, None], 10 - action, action)
        np.testing.assert_array_equal(
            step.observation.proprioception, other.step(unlike).observation.proprioception
        )
        over = step.terminated | step.truncated
    assert over.any() or step.time.max() < 0.1


def test_a_fall_a_tilt_or_a_drift_ends_the_episode_without_a_reward() -> None:
    task = walking(n=5)
    task.reset()
    state = task.state()
    qpos = state["simulations/physics"][:, QPOS]
    qpos[1, 3:7] = np.cos(0.51), 0, np.sin(0.51), 0  # pitch of 1.02 rad
    qpos[1, 2] = 1.0
    qpos[2, 1] += 0.31  # drifted to the left
    qpos[3, 2] += 0.35  # lifted
    qpos[4, 7 + DARWIN.joint_names.index("l_hip_roll")] = 0.45  # the left leg through the right
    task.restore(state)
    step = task.step(idle(5))
    np.testing.assert_array_equal(step.terminated, [False, True, True, True, True])
    np.testing.assert_array_equal(step.reward[1:], 0.0)
    assert step.reward[0] > 0


def test_the_reference_alone_falls_at_once_as_the_paper_says() -> None:
    task = walking(n=1)
    task.reset()
    time = 0.0
    for _ in range(80):
        step = task.step(idle(1))
        time = max(time, float(step.time[0]))
        if step.terminated[0]:
            break
    assert step.terminated[0] and 0.4 < time < 2.0


def test_the_robot_stands_in_the_half_squat() -> None:
    task = walking(robot=standing_robot(), n=2)
    task.reset()
    for _ in range(60):  # 2 s
        step = task.step(idle(2))
        assert not step.terminated.any()
    assert (np.abs(step.distance) < 0.02).all()
    tilt = step.observation.proprioception[:, 40:42]
    np.testing.assert_allclose(tilt, [[0.0, 0.126 - 0.075]] * 2, atol=0.05)


def test_readings_are_as_noisy_as_the_paper_says() -> None:
    task = walking(NOISY, n=2000)
    seen = task.reset()
    state = task.state()
    rate = 1 / state["episodes/period"]
    assert 25 <= rate.min() < 25.2 and 32.8 < rate.max() <= 33
    assert abs(rate.mean() - 29) < 0.2
    joints = state["simulations/physics"][:, QPOS][:, 7:]
    off = seen.proprioception[:, JOINTS : 2 * JOINTS] - joints
    assert abs(off.std() - 0.01) < 2e-4 and abs(off.mean()) < 2e-4
    start = joints - task.reference.start
    assert 0.0099 < np.abs(start).max() <= 0.01
    quiet = walking(replace(NOISY, tilt_bias=0.0, tilt_noise=0.0), n=2000).reset()
    bias = seen.proprioception[:, 40:42] - quiet.proprioception[:, 40:42]
    assert 0.29 < np.abs(bias).max() <= 0.31 and abs(bias.std() - 0.3 / np.sqrt(3)) < 0.01
    pitch = quiet.proprioception[:, 41]
    assert abs(pitch.mean() - (0.16 - 0.075)) < 0.01
    assert 0.09 < np.abs(pitch - (0.16 - 0.075)).max() <= 0.1 + 1e-6
    qvel = state["simulations/physics"][:, QVEL]
    assert 0.0049 < np.abs(qvel).max() <= 0.005


def test_directions_turn_the_reward_and_leave_the_physics() -> None:
    tasks = {d: walking(replace(NOISY, direction=d), n=4) for d in Direction}
    for task in tasks.values():
        task.reset()
    for _ in range(8):
        steps = {d: task.step(idle(4)) for d, task in tasks.items()}
    forward, backward = steps[Direction.FORWARD], steps[Direction.BACKWARD]
    np.testing.assert_array_equal(
        forward.observation.proprioception, backward.observation.proprioception
    )
    np.testing.assert_array_equal(forward.distance, -backward.distance)
    places = tasks[Direction.FORWARD].state()["episodes/place"]
    np.testing.assert_array_equal(steps[Direction.SIDEWAYS].distance, -places[:, 1])
    assert [d.reach for d in Direction] == [0.3, 0.2, 0.3]
    assert [d.symmetric for d in Direction] == [True, True, False]


@pytest.mark.parametrize(
    ("robot", "message"),
    [
        (RobotDescription.load("so101"), "has no [gait]"),
        (replace(DARWIN, floating=False), "cannot walk: it needs a free joint"),
    ],
)
def test_a_robot_that_cannot_walk_is_refused(robot: RobotDescription, message: str) -> None:
    with pytest.raises(InputError) as refused:
        walking(robot=robot)
    assert message in str(refused.value) and "robot.toml" in str(refused.value)


def test_a_sampler_of_given_parameters_repeats_them() -> None:
    given = np.linspace(BOUNDS.lower, BOUNDS.upper, 4)
    task = walking(sampler=ParameterSampler(BOUNDS, given))
    seen = task.reset()
    np.testing.assert_allclose(
        seen.true_parameters, np.repeat([[0], [1 / 3], [2 / 3], [1]], 14, axis=1), atol=1e-6
    )
    np.testing.assert_array_equal(seen.parameters, seen.true_parameters)


@pytest.mark.parametrize("direction", list(Direction))
def test_a_value_function_is_told_the_course(direction: Direction) -> None:
    """Where and how fast, as the step tells it; how it leans and heads, as the robot is turned."""
    task = walking(settings=replace(EXACT, direction=direction))
    names = [name.removeprefix("course/") for name in task.privileged_names[: len(COURSE)]]
    assert tuple(names) == COURSE and task.privileged_names[len(COURSE) :] == task.parameter_names
    assert DARWIN.gait is not None
    rng, first = np.random.default_rng(3), task.reset()
    at_rest = np.array([0, 0, 0, 0.16 / DARWIN.gait.tilt_limit, 0, 0, 1, 0])
    np.testing.assert_allclose(first.privileged[0, : len(COURSE)], at_rest, atol=1e-6)
    last = np.zeros(4), np.zeros(4)
    for _ in range(6):
        step = task.step(random_actions(rng, 4))
        told = dict(zip(task.privileged_names, step.observation.privileged.T, strict=True))
        state = task.state()
        period = state["episodes/period"]
        ahead, aside = (
            (now - then) / period / PACE
            for now, then in zip((step.distance, step.aside), last, strict=True)
        )
        last = step.distance, step.aside
        np.testing.assert_allclose(
            told["course/aside"], step.aside / DARWIN.gait.drift_limit, atol=1e-6
        )
        np.testing.assert_allclose(told["course/speed/ahead"], ahead, atol=1e-4)
        np.testing.assert_allclose(told["course/speed/aside"], aside, atol=1e-4)
        np.testing.assert_allclose(
            told["course/phase/x"] ** 2 + told["course/phase/y"] ** 2, 1, atol=1e-6
        )
        w, x, y, z = state["simulations/physics"][:, QPOS][:, 3:7].T
        heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
        np.testing.assert_allclose(told["course/heading"], heading, atol=1e-5)
        tilt = step.observation.proprioception[:, -4:-2] / DARWIN.gait.tilt_limit
        np.testing.assert_allclose(told["course/roll"], tilt[:, 0], atol=1e-5)
    np.testing.assert_allclose(
        step.observation.privileged[:, len(COURSE) :],
        2 * step.observation.true_parameters - 1,
        atol=1e-6,
    )
