"""Effects of the ground and of the IMU, on a standing robot."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from terms import OP2, Array, Row, play, with_terms
from test_simulator import recording

from pup.physics.mujoco_batch import MujocoSimulator
from pup.physics.simulator import Trajectories
from pup.recording import Recording
from pup.robot import RobotDescription

SQUAT = np.array(OP2.poses["half_squat"])
STIFF = {f"kp/{group}": 40.0 for group in OP2.groups}
LEFT, RIGHT = OP2.feet


def standing(
    seconds: float, tilt: tuple[float, float] | None = None, step: float = 0.01
) -> Recording:
    time = np.arange(0, seconds, step)
    angles = {} if tilt is None else {"imu/roll": tilt[0], "imu/pitch": tilt[1]}
    extras = {name: np.full(len(time), angle) for name, angle in angles.items()}
    return recording(OP2, time, np.tile(SQUAT, (len(time), 1)), SQUAT, "ground", extras=extras)


def stand(run: Recording, *rows: Row) -> Trajectories:
    return play(OP2, run, [STIFF | dict(row) for row in rows])


def test_what_the_imu_told_first_it_is_made_to_tell() -> None:
    """Whatever tilts the floor or the IMU, the first reading is the recorded one."""
    run = standing(0.1, (0.03, -0.05))
    lean = {"ground_slope/roll@ground": 0.04, "ground_slope/pitch@ground": -0.03}
    askew = {f"imu_misalignment/{axis}@sensor": 0.05 for axis in ("roll", "pitch")}
    seen = stand(run, lean, askew, lean | askew, {"encoder_bias/offset@joint:l_ank_roll": 0.05})
    assert seen.tilt[:, 0] == pytest.approx(np.tile([0.03, -0.05], (4, 1)), abs=1e-9)
    assert (seen.feet[:, 0, :, 2] > 0.0).all() and (seen.feet[:, 0, :, 2] < 0.06).all()


def test_on_a_slope_a_robot_with_flat_feet_leans_by_it() -> None:
    """It stands on the floor as before, and gravity comes from elsewhere."""
    run = standing(0.6)
    lean, askew, plain = stand(
        run,
        {"ground_slope/pitch@ground": 0.05},
        {"imu_misalignment/pitch@sensor": 0.05},
        {},
    ).tilt
    for tilt in (lean, askew):
        assert tilt[0] - plain[0] == pytest.approx([0.0, 0.05], abs=1e-9)
    # An IMU that is askew changes nothing but what it tells; a slope makes the robot lean further.
    assert askew[:, 1] - plain[:, 1] == pytest.approx(np.full(len(plain), 0.05), abs=1e-4)
    assert lean[-1, 1] - plain[-1, 1] > 0.051


def test_a_robot_slides_down_a_slope_that_its_soles_cannot_hold() -> None:
    """With m g sin over m g mu cos; a foot of its own friction turns it."""
    run = standing(0.6)
    slope = {"ground_slope/pitch@ground": 0.1, "ground_friction": 0.8}
    slick = {f"ground_friction/change@foot:{foot}": -0.77 for foot in OP2.feet}
    one = {f"ground_friction/change@foot:{LEFT}": -0.77}
    holds, slides, turns = stand(run, slope, slope | slick, slope | one).feet
    way = [np.linalg.norm(feet[-1] - feet[0], axis=-1) for feet in (holds, slides, turns)]
    assert way[0].max() < 0.01
    assert way[1].min() > 2 * way[0].max()
    assert way[2][0] > 1.5 * way[2][1]


def test_a_mat_gives_way_and_a_lively_floor_throws_back() -> None:
    """Soles sink deeper the softer the floor, one alone if it alone is; dropped, they bounce."""
    run = standing(1.0)
    soft, softer, left = (
        {f"ground_compliance/time@{place}": time}
        for place, time in (("ground", 0.02), ("ground", 0.04), (f"foot:{LEFT}", 0.04))
    )
    height = stand(run, {}, soft, softer, left).feet[:, -1, :, 2]
    assert (np.diff(height[:3], axis=0) < 0).all()
    assert height[3, 0] < height[0, 0] - 1e-4
    (lively,) = stand(run, {"contact_restitution/share@ground": 0.6}).feet[:, -1, :, 2]
    assert lively == pytest.approx(height[0], abs=5e-5), "at rest it is as stiff as before"

    simulator = MujocoSimulator(OP2, [standing(0.5, step=0.004)], "pd")
    (group,) = simulator.groups
    high = group.start.copy()
    high[:, 2] += 0.03
    simulator.groups = (replace(group, start=high),)
    rows = [STIFF | {"contact_restitution/share@ground": share} for share in (0.0, 0.6)]
    feet = simulator.replay(with_terms(OP2, rows)).feet[:, :, :, 2].min(axis=2)
    landed = int(np.argmin(feet[0, :40]))
    thrown = feet[:, landed:].max(axis=1) - feet[:, -1]
    assert thrown[1] > thrown[0] + 1e-3


def firm(solref: str, folder: Path) -> RobotDescription:
    """The robot on a floor of other contact parameters."""
    shutil.copytree(OP2.folder, folder, ignore=shutil.ignore_patterns("recordings", "policies"))
    told = (folder / "model.xml").read_text()
    floor = '<geom name="floor" '
    assert told.count(floor) == 1
    (folder / "model.xml").write_text(told.replace(floor, f'{floor}solref="{solref}" '))
    return RobotDescription.load(str(folder))


def test_stiffness_and_damping_of_a_floor_are_changed_like_its_times(tmp_path: Path) -> None:
    """MuJoCo takes either: damping 2 / time, stiffness 1 / (time ratio)^2, as negative numbers."""
    times = firm("0.03 0.8", tmp_path / "times")
    direct = firm(f"{-1 / 0.024**2!r} {-2 / 0.03!r}", tmp_path / "direct")
    rows = [
        {},
        {"ground_compliance/time@ground": 0.02},
        {"contact_restitution/share@ground": 0.4},
        {f"ground_compliance/time@foot:{LEFT}": 0.03, "contact_restitution/share@ground": 0.3},
    ]
    one, two = (
        play(robot, standing(0.6), [STIFF | row for row in rows]).feet for robot in (times, direct)
    )
    assert one == pytest.approx(two, abs=1e-9)
    assert (np.abs(one[1:] - one[0]).max(axis=(1, 2, 3)) > 1e-4).all()


def test_a_floor_without_friction_keeps_what_it_has(tmp_path: Path) -> None:
    """Beside another that a foot has: no change of one is the bits of no term."""
    run, slick = standing(0.4, (0.0, 0.05)), {"ground_friction": 0.01}
    other = {f"ground_friction/change@foot:{LEFT}": 0.3}
    alone, among = (stand(run, *rows).position[0] for rows in ([slick], [slick, slick | other]))
    np.testing.assert_array_equal(alone, among)


def tilts(delay: float, step: float) -> tuple[Array, Array]:
    run = standing(0.4, (0.0, 0.15), step)
    plain, late = stand(run, {}, {"imu_delay/time@sensor": delay}).tilt
    return plain, late


def test_a_late_imu_tells_what_was() -> None:
    """By whole ticks and by parts of them; before the start it stood still."""
    step = OP2.timestep
    plain, late = tilts(6 * step, step)
    assert late[6:] == pytest.approx(plain[:-6], abs=1e-9)
    assert late[:6] == pytest.approx(np.tile(plain[0], (6, 1)), abs=1e-12)
    plain, late = tilts(6.25 * step, step)
    assert late[7:] == pytest.approx(0.25 * plain[:-7] + 0.75 * plain[1:-6], abs=1e-7)


def test_a_push_on_the_torso_lifts_the_whole_robot() -> None:
    """In free fall a force upwards takes all of its mass along: F t² / 2 m."""
    run = standing(0.2)
    simulator = MujocoSimulator(OP2, [run], "pd")
    (group,) = simulator.groups
    high = group.start.copy()
    high[:, 2] += 1.0
    simulator.groups = (replace(group, start=high),)
    rows: list[Row] = [{}, {f"external_force/z@body:{OP2.torso}": 2.0}]
    feet = simulator.replay(with_terms(OP2, rows)).feet.mean(axis=2)
    mass = float(group.model.compiled.body_mass.sum())
    way = 2.0 * run.time[-1] ** 2 / 2 / mass
    assert feet[1, -1, 2] - feet[0, -1, 2] == pytest.approx(way, rel=0.05)
