"""How a robot is put on the ground: by its IMU, wherever that is, and on the floor that it has."""

import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest
from terms import OP2, play
from test_simulator import recording

from pup.errors import InputError
from pup.physics.model import compile_model, mount, starting_qpos
from pup.recording import Recording
from pup.robot import RobotDescription

SQUAT = np.array(OP2.poses["half_squat"])
FLOOR = '<geom name="floor" '
SITE = '<site name="imu" pos="0 0 -0.068"/>'
HOLDER = """
  <body name="holder" euler="0.1 0 0.15" pos="0 0 0.01">
    <inertial mass="1e-6" pos="0 0 0" diaginertia="1e-9 1e-9 1e-9"/>
    <body euler="0 0.12 0"><site name="imu" euler="0.1 0 0"/></body>
  </body>"""


def changed(folder: Path, *lines: tuple[str, str]) -> RobotDescription:
    """The robot with other lines in its model."""
    shutil.copytree(OP2.folder, folder, ignore=shutil.ignore_patterns("recordings", "policies"))
    told = (folder / "model.xml").read_text()
    for old, new in lines:
        assert told.count(old) == 1
        told = told.replace(old, new)
    (folder / "model.xml").write_text(told)
    return RobotDescription.load(str(folder))


def leaning() -> Recording:
    """A robot whose IMU tells a lean."""
    time = np.arange(0, 0.3, 0.01)
    extras = {"imu/roll": np.full(len(time), 0.03), "imu/pitch": np.full(len(time), -0.05)}
    return recording(OP2, time, np.tile(SQUAT, (len(time), 1)), SQUAT, "ground", extras=extras)


def test_an_imu_on_a_body_that_is_fixed_to_the_torso_is_turned_with_it(tmp_path: Path) -> None:
    robot = changed(tmp_path / "robot", (SITE, HOLDER))
    model = compile_model(robot, "ground")
    data = mujoco.MjData(model.compiled)
    mujoco.mj_kinematics(model.compiled, data)
    site = np.empty(4)
    mujoco.mju_mat2Quat(site, data.site_xmat[model.compiled.site("imu").id])
    assert mount(robot, model) == pytest.approx(site, abs=1e-12)
    assert play(robot, leaning(), [{}]).tilt[0, 0] == pytest.approx([0.03, -0.05], abs=1e-9)


def test_an_imu_that_moves_against_the_torso_is_refused(tmp_path: Path) -> None:
    leg = next(x for x in OP2.model_path.read_text().splitlines() if '<body name="l_' in x)
    robot = changed(tmp_path / "robot", (SITE, ""), (leg, leg + SITE))
    with pytest.raises(InputError, match="moves against the torso") as refused:
        play(robot, leaning(), [{}])
    assert "\n" not in str(refused.value)


def test_a_robot_is_put_on_the_floor_that_it_has(tmp_path: Path) -> None:
    """Wherever that lies, and whatever it is made of."""
    lifted = changed(tmp_path / "lifted", (FLOOR, f'{FLOOR}pos="0 0 0.2" '))
    block = changed(
        tmp_path / "block",
        (
            f'{FLOOR}type="plane" size="0 0 0.05"',
            f'{FLOOR}type="box" size="9 9 0.05" pos="0 0 0.1"',
        ),
    )
    for robot, height in ((lifted, 0.2), (block, 0.15)):
        start, plain = (
            starting_qpos(r, compile_model(r, "ground"), SQUAT, leaning()) for r in (robot, OP2)
        )
        assert start[2] - plain[2] == pytest.approx(height, abs=1e-12)
    rest = [play(r, leaning(), [{}]).feet[0, :, :, 2] for r in (OP2, lifted)]
    assert rest[1] - rest[0] == pytest.approx(np.full(rest[0].shape, 0.2), abs=1e-6)


def test_a_floor_that_is_not_level_is_refused(tmp_path: Path) -> None:
    robot = changed(tmp_path / "robot", (FLOOR, f'{FLOOR}euler="0 3 0" '))
    with pytest.raises(InputError, match="ground_slope") as refused:
        compile_model(robot, "ground")
    assert "\n" not in str(refused.value)
    compile_model(robot, "suspended")
