"""Scripts stay inside the limits, touch nothing, and do what their names say."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from pup.errors import InputError
from pup.physics.model import joint_units
from pup.physics.mujoco_batch import MujocoSimulator
from pup.physics.parameters import robot_space
from pup.recording import Recording
from pup.robot import RobotDescription, built_in_robots
from pup.sysid.clearance import Clearance
from pup.sysid.excitation import Motion, possible_kinds, script
from pup.sysid.lean import falling_pose
from pup.sysid.virtual import record

SEEDS = range(3)


@pytest.fixture(scope="module")
def op2() -> RobotDescription:
    return RobotDescription.load("darwin_op2")


def made(robot: RobotDescription, *kinds: str, seed: int = 0, jitter: bool = True) -> list[Motion]:
    return list(script(robot, kinds, np.random.default_rng(seed), jitter))


def moves(motion: Motion) -> list[np.ndarray]:
    """The different targets of a step test, in order."""
    changed = np.flatnonzero(np.any(np.diff(motion.target, axis=0) != 0, axis=1)) + 1
    return [motion.target[0], *motion.target[changed]]


@pytest.mark.parametrize("name", built_in_robots())
@pytest.mark.parametrize("seed", SEEDS)
def test_every_motion_is_within_limits_and_free_of_self_collision(name: str, seed: int) -> None:
    robot = RobotDescription.load(name)
    lower = np.array([joint.lower for joint in robot.joints])
    upper = np.array([joint.upper for joint in robot.joints])
    clearance = Clearance(robot)
    for motion in made(robot, *possible_kinds(robot), seed=seed):
        assert motion.target.shape == (len(motion.time), len(robot.joints))
        assert (motion.target >= lower - 1e-12).all(), motion.id
        assert (motion.target <= upper + 1e-12).all(), motion.id
        assert motion.time[0] == 0
        assert (np.diff(motion.time) > 0).all()
        assert np.ptp(motion.target, axis=0).max() > 0
        for start, end in pairwise(motion.target):
            if (start != end).any():
                assert clearance.path_free(start, end), motion.id


@pytest.mark.parametrize("size", [0.1, 0.3, 0.6])
def test_step_tests_move_every_joint_by_the_step_or_as_far_as_its_limits_let_it(
    op2: RobotDescription, size: float
) -> None:
    lower = np.array([joint.lower for joint in op2.joints])
    upper = np.array([joint.upper for joint in op2.joints])
    for seed in SEEDS:
        (motion,) = made(op2, f"step:{size}", seed=seed)
        assert (motion.support, motion.motion) == ("suspended", "step")
        poses = moves(motion)
        assert len(poses) == 5
        for before, after in pairwise(poses):
            stepped = np.abs(after - before)
            at_limit = np.isclose(after, lower) | np.isclose(after, upper)
            assert (stepped <= size + 1e-12).all()
            assert (np.isclose(stepped, size) | at_limit).all()
            assert (stepped > 1e-3).all()


def test_step_tests_make_four_moves_in_a_second(op2: RobotDescription) -> None:
    (motion,) = made(op2, "step:0.3", jitter=False)
    changed = np.flatnonzero(np.any(np.diff(motion.target, axis=0) != 0, axis=1)) + 1
    assert motion.time[changed] == pytest.approx([0.1, 0.35, 0.6, 0.85], abs=1 / 30)
    assert motion.time[-1] == pytest.approx(1.1, abs=1 / 30)


def test_directions_differ_between_joints_and_between_seeds(op2: RobotDescription) -> None:
    first, second = (moves(made(op2, "step:0.1", seed=s)[0]) for s in (0, 1))
    turn = np.sign(first[1] - first[0])
    assert 0 < (turn > 0).sum() < len(turn)
    assert not np.array_equal(first[0], second[0])


@pytest.mark.parametrize("seconds", [1.75, 2.0, 4.0, 6.0])
def test_stand_ups_go_from_squat_to_stand_in_the_time_named(
    op2: RobotDescription, seconds: float
) -> None:
    (motion,) = made(op2, f"standup:{seconds}", jitter=False)
    assert motion.support == "ground"
    assert motion.target[0] == pytest.approx(op2.poses["squat"])
    assert motion.target[-1] == pytest.approx(op2.poses["stand"])
    moving = np.flatnonzero(np.any(np.diff(motion.target, axis=0) != 0, axis=1))
    assert np.ptp(motion.time[moving]) == pytest.approx(seconds, abs=0.05)


@pytest.fixture(scope="module")
def grounded(op2: RobotDescription) -> dict[str, np.ndarray]:
    """Roll and pitch of the nominal robot in each motion on the ground, shape (n_ticks, 2)."""
    motions = made(op2, "standup", "stand", "fall")
    recordings = [
        Recording(m.id, op2.name, m.motion, m.support, "simulation", op2.joint_names,
                  m.time, m.target, m.target)
        for m in motions
    ]  # fmt: skip
    seen = MujocoSimulator(op2, recordings).replay(robot_space(op2, "nn_pd").candidates())
    return {m.id: seen.tilt[0, part] for m, part in zip(motions, seen.ticks, strict=True)}


@pytest.mark.parametrize(
    ("direction", "axis", "sign"),
    [("forward", 1, 1), ("backward", 1, -1), ("left", 0, -1), ("right", 0, 1)],
)
def test_falls_go_where_they_are_named_after(
    grounded: dict[str, np.ndarray], direction: str, axis: int, sign: int
) -> None:
    tilt = grounded[f"fall_{direction}"]
    fallen = tilt[np.argmax(np.abs(tilt).max(axis=1) > 1.0)]
    assert sign * fallen[axis] > 1.0
    assert abs(fallen[1 - axis]) < 0.3
    assert np.abs(tilt[0]).max() < 0.02


def test_the_nominal_robot_stands_up_without_falling(grounded: dict[str, np.ndarray]) -> None:
    for seconds in ("1.75", "2", "4", "6"):
        tilt = grounded[f"standup_{seconds}"]
        assert np.abs(tilt).max() < 0.35
        assert np.abs(tilt[-1]).max() < 0.05


def test_weight_goes_to_all_sides_and_the_robot_stays_on_its_feet(
    op2: RobotDescription, grounded: dict[str, np.ndarray]
) -> None:
    (motion,) = made(op2, "stand", jitter=False)
    assert (motion.support, motion.motion) == ("ground", "stand")
    for row in (0, -1):
        assert motion.target[row] == pytest.approx(op2.poses["stand"])
    roll, pitch = grounded["stand"].T
    assert roll.min() < -0.02 and roll.max() > 0.02
    assert pitch.min() < -0.05 and pitch.max() > 0.05
    assert max(np.abs(roll).max(), np.abs(pitch).max()) < 0.3
    assert max(abs(roll[-1]), abs(pitch[-1])) < 0.02


def test_weak_robots_stay_up_when_they_shift_their_weight(
    op2: RobotDescription, tmp_path: Path
) -> None:
    """Drawn ones, as `pup record --virtual` plays them: 5 and 8 have the weakest servos of ten."""
    for seed in (1, 5, 8):
        (made,) = record(op2, ("stand",), tmp_path / str(seed), seed)
        tilt = np.stack([made.extras["imu/roll"], made.extras["imu/pitch"]])
        assert np.nanmax(np.abs(tilt)) < 0.35, seed


def test_falling_poses_of_the_two_sides_mirror_each_other(op2: RobotDescription) -> None:
    permutation, sign = op2.mirror()
    mirrored = sign * falling_pose(op2, "left")[permutation]
    assert mirrored == pytest.approx(falling_pose(op2, "right"))


def test_triangles_are_slow_and_chirps_small(op2: RobotDescription) -> None:
    chirp, triangle = made(op2, "chirp", "triangle", jitter=False)
    speed = np.abs(np.diff(triangle.target, axis=0)) / np.diff(triangle.time)[:, None]
    assert 0.1 <= speed.max() <= 0.2 + 1e-9
    assert np.ptp(chirp.target, axis=0).max() <= 0.12 + 1e-9
    joint = int(np.argmax(np.ptp(chirp.target, axis=0)))
    away = chirp.target[:, joint] - chirp.target[0, joint]
    crossings = chirp.time[np.flatnonzero(np.diff(np.sign(away)))]
    assert crossings[1] - crossings[0] > 1.5  # slow first, half a period of 0.2 Hz is 2.5 s
    assert np.median(np.diff(crossings[-8:])) == pytest.approx(0.1, abs=0.04)


def test_a_multisine_has_its_tones_and_no_other(op2: RobotDescription) -> None:
    (motion,) = made(op2, "multisine", jitter=False)
    joint = int(np.argmax(np.ptp(motion.target, axis=0)))
    moved = motion.target[:, joint] - motion.target[0, joint]
    assert np.abs(moved).max() == pytest.approx(0.06, rel=0.02)
    grown = motion.time >= 1.0
    waves = np.exp(-2j * np.pi * np.outer(np.arange(1, 31) / 10, motion.time[grown]))
    size = np.abs(waves @ moved[grown]) / grown.sum()
    assert set(np.argsort(size)[-5:] + 1) == {3, 7, 11, 17, 23}  # tenths of a hertz


def test_holds_come_to_each_pose_from_both_sides(op2: RobotDescription) -> None:
    (motion,) = made(op2, "hold", jitter=False)
    rest = np.all(np.diff(motion.target, axis=0) == 0, axis=1)
    stays = [motion.target[0]]
    for pose in motion.target[1:][rest]:
        if not np.allclose(pose, stays[-1]):
            stays.append(pose)
    assert len(stays) == 12
    for first, pose, second, again in np.reshape(stays, (3, 4, -1)):
        assert pose == pytest.approx(again)
        assert first + second == pytest.approx(2 * pose)
        assert np.abs(first - pose).min() > 0.01


def test_ticks_are_steady_or_drawn_from_25_to_33_hz(op2: RobotDescription) -> None:
    steady = np.diff(made(op2, "chirp", jitter=False)[0].time)
    drawn = np.diff(made(op2, "chirp")[0].time)
    assert steady == pytest.approx(1 / 30)
    assert 1 / 33 <= drawn.min() < drawn.max() <= 1 / 25
    assert np.std(drawn) > 0.002


def test_a_script_follows_from_its_seed(op2: RobotDescription) -> None:
    kinds = possible_kinds(op2)
    for one, same in zip(made(op2, *kinds, seed=5), made(op2, *kinds, seed=5), strict=True):
        assert one.id == same.id
        assert np.array_equal(one.time, same.time)
        assert np.array_equal(one.target, same.target)


def test_repeated_kinds_are_numbered_and_drawn_anew(op2: RobotDescription) -> None:
    motions = made(op2, "step:0.3", "step", "fall:left")
    assert [m.id for m in motions] == [
        "step_0.3_0", "step_0.1", "step_0.3_1", "step_0.6", "fall_left"
    ]  # fmt: skip
    assert not np.array_equal(motions[0].target[0], motions[2].target[0])


def test_a_slide_moves_by_shares_of_its_range() -> None:
    emps = RobotDescription.load("emps")
    span = emps.joints[0].upper - emps.joints[0].lower
    assert joint_units(emps) == pytest.approx([span / np.pi])
    (motion,) = made(emps, "step:0.3")
    assert motion.support == "bench"
    assert np.abs(np.diff(moves(motion), axis=0)).max() == pytest.approx(0.3 * span / np.pi)


@pytest.mark.parametrize(
    ("kind", "told"),
    [
        ("dance", "can play step, standup"),
        ("step:much", "0.01 to 1"),
        ("step:nan", "0.01 to 1"),
        ("step:2", "0.01 to 1"),
        ("standup:0", "0.5 to 60"),
        ("fall:up", "forward, backward, left, right"),
        ("chirp:2", "no variants"),
    ],
)
def test_unknown_kinds_are_refused(op2: RobotDescription, kind: str, told: str) -> None:
    with pytest.raises(InputError, match=told):
        made(op2, kind)


def test_no_kinds_are_refused(op2: RobotDescription) -> None:
    with pytest.raises(InputError, match="no motion given"):
        made(op2)


@pytest.mark.parametrize("kind", ["standup", "fall", "fall:left"])
def test_a_robot_on_a_fixed_base_neither_stands_up_nor_falls(kind: str) -> None:
    with pytest.raises(InputError, match="can play step, hold, chirp, triangle, multisine"):
        made(RobotDescription.load("darwin_leg"), kind)


def test_self_collision_is_seen_on_the_way_too(op2: RobotDescription) -> None:
    clearance, rng = Clearance(op2), np.random.default_rng(0)
    lower = [joint.lower for joint in op2.joints]
    upper = [joint.upper for joint in op2.joints]
    poses = [pose for pose in rng.uniform(lower, upper, size=(200, 20)) if clearance.free(pose)]
    ways = list(pairwise(poses))
    blocked = [way for way in ways if not clearance.path_free(*way)]
    assert blocked
    for start, end in blocked:
        between = start + np.linspace(0, 1, 500)[:, None] * (end - start)
        assert not all(clearance.free(pose) for pose in between)
    assert clearance.path_free(np.array(op2.poses["squat"]), np.array(op2.poses["stand"]))


def test_a_clearance_keeps_links_apart(op2: RobotDescription) -> None:
    """The legs of the squatting robot are nearer than 5 mm to its torso, and do not touch it."""
    squat = np.array(op2.poses["squat"])
    assert Clearance(op2).free(squat)
    assert not Clearance(op2, 0.005).free(squat)
