"""Where a replay starts: the mean of a robot that rests on the ground, else its first reading."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from biped import biped
from numpy.typing import NDArray
from recordings import make

from pup.physics.groups import group_of
from pup.physics.model import compile_model, first_tilt
from pup.physics.rest import ticks_at_rest
from pup.physics.simulator import schedule
from pup.recording import Recording
from pup.robot import RobotDescription
from pup.sysid.loss import ReplayLoss

REST, TICKS = 15, 40
NOISE = 0.002  # rad


def resting(support: str, seed: int = 0) -> Recording:
    """Half a second at rest, read with noise, and then a command."""
    rng = np.random.default_rng(seed)
    target = np.zeros((TICKS, 2))
    target[REST:] = 0.5
    return make(
        support=support,
        time=np.arange(TICKS) / 30,
        target=target,
        position=0.3 + rng.normal(0, NOISE, (TICKS, 2)),
    )


def test_the_readings_of_a_rest_are_averaged() -> None:
    starts = []
    for seed in range(200):
        recording = resting("ground", seed)
        assert ticks_at_rest(recording) == REST
        starts.append(schedule(recording, ("a", "b"), 0.002).start)
    np.testing.assert_allclose(np.std(starts), NOISE / np.sqrt(REST), rtol=0.1)


def test_a_noisy_imu_does_not_hide_a_rest() -> None:
    """Half a degree of noise, as a BNO055 has."""
    rng = np.random.default_rng(0)
    held = 0
    for seed in range(100):
        recording = resting("ground", seed)
        tilts = rng.normal(0, 0.009, (2, TICKS))
        extras = {"imu/roll": tilts[0], "imu/pitch": tilts[1]}
        held += ticks_at_rest(replace(recording, extras=extras)) == REST
    assert held > 90


def test_a_robot_that_hangs_starts_at_its_first_reading() -> None:
    """Nothing grows there, and a servo at 200 Hz may have begun to fall."""
    recording = resting("suspended")
    assert ticks_at_rest(recording) == 1
    np.testing.assert_array_equal(
        schedule(recording, ("a", "b"), 0.002).start, recording.position[0]
    )


def test_a_robot_that_moves_from_the_start_has_no_rest() -> None:
    recording = resting("ground")
    sinking = recording.position - 0.05 * np.linspace(0, 1, TICKS)[:, None] * [1, 0]
    assert ticks_at_rest(replace(recording, position=sinking)) == 1


def hopper(folder: Path) -> RobotDescription:
    """The biped with legs that slide by 0.02 m in all."""
    biped(folder)
    for name, told in (
        ("model.xml", {'range="-1 1"': 'type="slide" range="-0.01 0.01"'}),
        ("robot.toml", {"-0.8": "-0.01", "0.8": "0.01", "[0.1]": "[0.005]"}),
    ):
        text = (folder / name).read_text()
        for old, new in told.items():
            text = text.replace(old, new)
        (folder / name).write_text(text)
    return RobotDescription.load(folder)


def test_a_slide_drifts_by_less_than_a_hinge(tmp_path: Path) -> None:
    """One that sinks by 0.1 mm of 20 rests no more than one whose hinges turn by a degree."""
    robot = hopper(tmp_path)
    noise = np.random.default_rng(0).normal(0, 1e-6, (TICKS, 2))
    still = replace(
        resting("ground"),
        robot=robot.name,
        motion="stand",
        joints=robot.joint_names,
        target=0.01 * resting("ground").target,
        position=noise,
    )
    sinks = replace(still, position=noise - np.linspace(0, 2e-4, TICKS)[:, None])
    loss = ReplayLoss(robot, [still, sinks])
    assert loss.rests == (slice(REST // 2, REST), None)
    group = group_of(robot, [still, sinks], "ground", loss.ticks)
    assert dict(zip(group.members, group.rests, strict=True)) == {0: True, 1: False}
    begun = dict(zip(group.members, group.start[:, group.model.qpos], strict=True))
    np.testing.assert_allclose(begun[0], noise[:REST].mean(axis=0))
    np.testing.assert_array_equal(begun[1], sinks.position[0])


def test_a_command_at_once_leaves_no_rest() -> None:
    recording = resting("ground")
    target = recording.target.copy()
    target[1:, 0] += 0.1
    assert ticks_at_rest(replace(recording, target=target)) == 1


def test_readings_that_are_missing_are_left_out() -> None:
    recording = resting("ground")
    position = recording.position.copy()
    position[2:5, 0] = np.nan
    position[:, 1] = np.nan
    position[-1, 1] = 7.0  # known only after a command: the joint stood at its target
    start = schedule(replace(recording, position=position), ("a", "b"), 0.002).start
    known: NDArray[np.float64] = position[:REST, 0]
    np.testing.assert_allclose(start, [np.nanmean(known), 0.0])


def test_a_gap_hides_no_drift() -> None:
    """Every joint has one, and both sink: what is known tells."""
    recording = resting("ground")
    position = recording.position - 0.05 * np.linspace(0, 1, TICKS)[:, None]
    position[2, 0] = position[3, 1] = np.nan
    assert ticks_at_rest(replace(recording, position=position)) == 1


def test_where_little_is_known_of_a_rest_there_is_none() -> None:
    recording = resting("ground")
    position = recording.position.copy()
    position[1:] = np.nan
    assert ticks_at_rest(replace(recording, position=position)) == 1


def test_the_torso_is_as_its_imu_says_on_average() -> None:
    robot = RobotDescription.load("darwin_op2")
    model = compile_model(robot, "ground")
    tilts = {
        f"imu/{angle}": at + np.random.default_rng(2).normal(0, NOISE, TICKS)
        for angle, at in (("roll", 0.1), ("pitch", -0.2))
    }
    still = replace(resting("ground"), extras=tilts)
    mean = {n: np.full(TICKS, v[:REST].mean()) for n, v in tilts.items()}
    np.testing.assert_allclose(
        first_tilt(robot, model, still), first_tilt(robot, model, replace(still, extras=mean))
    )
