"""A robot's folder drafted from MJCF and URDF, held against descriptions written by hand."""

import struct
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pup.drafting.description import OTHER, group_of, partner
from pup.drafting.draft import draft_robot
from pup.errors import InputError
from pup.physics.model import compile_model, standing_qpos
from pup.robot import RobotDescription
from services.cli import main

QUADRUPED = Path(__file__).parents[1] / "examples" / "quadruped"


def link(name: str, mass: float, shape: str) -> str:
    return f"""<link name="{name}">
      <inertial><mass value="{mass}"/>
        <inertia ixx="1e-3" ixy="0" ixz="0" iyy="1e-3" iyz="0" izz="1e-3"/></inertial>
      <collision><geometry>{shape}</geometry></collision></link>"""


def joint(name: str, parent: str, child: str, place: str, axis: str, more: str = "") -> str:
    return f"""<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>
      <origin xyz="{place}"/><axis xyz="{axis}"/>
      <limit lower="-0.5" upper="0.7" {more} velocity="5"/></joint>"""


BOX = '<box size="0.1 0.05 0.02"/>'
WALKER = "".join(
    (
        '<robot name="walker">',
        link("base", 2.0, '<box size="0.2 0.06 0.1"/>'),
        '<link name="imu_link"/><joint name="imu" type="fixed"><parent link="base"/>'
        '<child link="imu_link"/><origin xyz="0.02 0 0.05"/></joint>',
        *(link(f"{side}_thigh", 0.2, '<sphere radius="0.02"/>') for side in ("left", "right")),
        *(link(f"{side}_foot", 0.1, BOX) for side in ("left", "right")),
        joint("left_hip_pitch", "base", "left_thigh", "0 0.06 -0.05", "0 1 0", 'effort="2.5"'),
        joint("left_ankle_roll", "left_thigh", "left_foot", "0 0 -0.12", "1 0 0", 'effort="2"'),
        joint("right_hip_pitch", "base", "right_thigh", "0 -0.06 -0.05", "0 -1 0", 'effort="2.5"'),
        joint("right_ankle_roll", "right_thigh", "right_foot", "0 0 -0.12", "1 0 0", 'effort="2"'),
        "</robot>",
    )
)
ODOMETRY = """<link name="odom"/><joint name="base_joint" type="floating">
  <parent link="odom"/><child link="base"/></joint>"""


def urdf(folder: Path, text: str = WALKER) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "walker.urdf"
    file.write_text(text)
    return file


@pytest.mark.parametrize("name", ["darwin_op2", "darwin_leg", "so101", "emps", str(QUADRUPED)])
def test_what_a_draft_tells_is_what_was_written_by_hand(name: str, tmp_path: Path) -> None:
    """Torso, feet, IMU and mirror map; the Darwin's signs were taken from the authors' code."""
    ours = RobotDescription.load(name)
    told = draft_robot(ours.model_path, tmp_path / "draft").robot
    assert (told.torso, told.imu_site, told.feet) == (ours.torso, ours.imu_site, ours.feet)
    drafted, written = ({j.name: j for j in robot.joints} for robot in (told, ours))
    assert drafted.keys() == written.keys()
    for joint_name, one in drafted.items():
        other = written[joint_name]
        assert (one.mirror, one.mirror_sign) == (other.mirror, other.mirror_sign)


def test_a_urdf_gets_a_free_base_a_floor_an_imu_and_its_efforts(tmp_path: Path) -> None:
    drafted = draft_robot(urdf(tmp_path), tmp_path / "walker", free=True)
    robot = drafted.robot
    assert (robot.torso, robot.feet, robot.floating) == ("base", ("left_foot", "right_foot"), True)
    assert robot.groups == ("hip", "ankle")
    limits = {p.name: p.nominal for p in robot.parameters if p.name.startswith("tau_max")}
    assert limits == {"tau_max/hip": 2.5, "tau_max/ankle": 2.0}
    # Right hips turn about the other way, so that alike angles mirror; rolls are opposite.
    signs = {j.name: j.mirror_sign for j in robot.joints}
    assert signs == {
        "left_hip_pitch": -1,
        "left_ankle_roll": -1,
        "right_hip_pitch": -1,
        "right_ankle_roll": -1,
    }
    model = compile_model(robot, "ground")
    assert model.compiled.site(robot.imu_site).pos == pytest.approx([0.02, 0, 0.05])
    assert model.compiled.body_subtreemass[0] == pytest.approx(2.6)
    qpos = standing_qpos(robot, model, np.zeros(4), np.full(4, np.nan))
    assert qpos[2] == pytest.approx(0.05 + 0.12 + 0.01, abs=1e-6)
    assert any("kp" in note for note in drafted.notes)
    assert all(note in (robot.folder / "robot.toml").read_text() for note in drafted.notes)


def test_a_fixed_base_stays_fixed(tmp_path: Path) -> None:
    drafted = draft_robot(urdf(tmp_path), tmp_path / "walker")
    assert not drafted.robot.floating
    assert any("--free" in note for note in drafted.notes)


def stl(file: Path, size: float = 0.02) -> None:
    """A tetrahedron, binary."""
    corners = np.array([[0, 0, 0], [size, 0, 0], [0, size, 0], [0, 0, size]], np.float32)
    faces = [corners[[0, 2, 1]], corners[[0, 1, 3]], corners[[0, 3, 2]], corners[[1, 2, 3]]]
    body = b"".join(np.r_[np.zeros((1, 3)), f].astype("<f4").tobytes() + b"\0\0" for f in faces)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(b"\0" * 80 + struct.pack("<I", len(faces)) + body)


def test_meshes_of_a_package_are_taken_along(tmp_path: Path) -> None:
    mesh = '<mesh filename="package://walker/meshes/shin.stl"/>'
    package = tmp_path / "walker"
    stl(package / "meshes" / "shin.stl")
    file = urdf(package / "urdf", WALKER.replace('<sphere radius="0.02"/>', mesh))
    robot = draft_robot(file, tmp_path / "out").robot
    assert (robot.folder / "assets" / "shin.stl").is_file()
    (package / "meshes" / "shin.stl").unlink()
    assert compile_model(robot, "bench").compiled.nmesh == 1
    with pytest.raises(InputError, match=r"shin\.stl' is not there"):
        draft_robot(file, tmp_path / "again")


SERVO = """<mujoco model="arm"><compiler angle="radian"/><worldbody>
  <geom name="floor" type="box" size="1 1 0.1" pos="0 0 -1"/>
  <body name="base" pos="0 0 1"><freejoint/><geom name="a" size="0.1"/>
    <body name="shin" pos="0 0 -0.05"><joint name="knee" axis="0 1 0" range="-1 2"/>
      <joint axis="1 0 0"/><geom name="b" size="0.1"/></body></body></worldbody>
  <actuator><position joint="knee" kp="20" kv="0.5" forcerange="-3 3" ctrlrange="-0.8 1.5"/>
    <motor joint="knee" gear="2" ctrlrange="-1 1"/></actuator>
  <keyframe><key name="home" qpos="0 0 1 1 0 0 0 0.4 0"/></keyframe></mujoco>"""


def test_servos_poses_and_overlaps_are_those_of_the_model(tmp_path: Path) -> None:
    file = tmp_path / "arm.xml"
    file.write_text(SERVO)
    drafted = draft_robot(file, tmp_path / "arm", name="my_arm")
    robot = drafted.robot
    assert (robot.name, robot.joint_names) == ("my_arm", ("knee", "shin_joint"))
    assert (robot.joints[0].lower, robot.joints[0].upper) == (-0.8, 1.5)
    nominal = {p.name: p.nominal for p in robot.parameters}
    assert (nominal["kp/knee"], nominal["kd/knee"], nominal["tau_max/knee"]) == (20, 0.5, 3)
    assert robot.poses["stand"] == robot.poses["home"] == (0.4, 0.0)
    told = " ".join(drafted.notes)
    assert "drives no shin_joint" in told and "no range" in told
    floor = compile_model(robot, "ground").compiled.geom("floor")
    assert floor.type[0] == mujoco.mjtGeom.mjGEOM_PLANE


def test_links_that_overlap_where_the_robot_stands_do_not_push_each_other(tmp_path: Path) -> None:
    """Neighbours never touch in MuJoCo; a shin in the torso does, and would throw the robot."""
    file = tmp_path / "tight.xml"
    hinge = '<joint axis="0 1 0" range="-57 57"/>'
    file.write_text(f"""<mujoco><worldbody><body name="base" pos="0 0 1"><freejoint/>
      <geom size="0.1"/><body name="thigh">{hinge}<geom size="0.02" pos="0 0 -0.1"/>
      <body name="shin">{hinge}<geom size="0.03" pos="0 0 -0.11"/></body></body></body>
      </worldbody></mujoco>""")
    drafted = draft_robot(file, tmp_path / "tight")
    told = "made not to touch, as they overlap where it stands: base and shin"
    assert told in drafted.notes
    assert compile_model(drafted.robot, "ground").compiled.nexclude == 1


@given(st.lists(st.sampled_from([*OTHER, "hip", "Knee", "L", "1", "joint"]), min_size=1))
def test_the_partner_of_a_partner_is_the_joint_itself(words: list[str]) -> None:
    name = "_".join(words)
    assert partner(partner(name)) == name


@pytest.mark.parametrize(
    ("name", "group"),
    [
        ("l_knee", "knee"),
        ("FR_hip_joint", "hip"),
        ("left_hip_yaw", "hip"),
        ("Pitch", "pitch"),
        ("joint_3", "joint"),
        ("7", "7"),
    ],
)
def test_groups_are_told_by_names(name: str, group: str) -> None:
    assert group_of(name) == group


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("<robot name='r'><link name='a'/></robot>", "no hinge or slide joint"),
        ("<robot", "MuJoCo refuses it"),
        (
            "<robot xmlns:xacro='x'><xacro:arm/></robot>",
            "what `xacro walker.urdf > robot.urdf` makes",
        ),
        (WALKER.replace('<sphere radius="0.02"/>', '<mesh filename="a.stl"/>'), "is not there"),
        (WALKER.replace("</robot>", f"{ODOMETRY}</robot>"), "'base' is free, but hangs on 'odom'"),
    ],
)
def test_what_cannot_be_described_is_refused_in_a_line(
    text: str, told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["describe", str(urdf(tmp_path, text)), "--out", str(out)]) == 2
    err = capsys.readouterr().err
    assert told in err and len(err.splitlines()) == 1
    assert not out.exists()


def test_names_that_mujoco_cannot_be_told_are_refused(tmp_path: Path) -> None:
    for source, out in (("a_\udcfc", "out"), ("a", "out_\udcfc")):
        with pytest.raises(InputError, match="is not UTF-8"):
            draft_robot(urdf(tmp_path / source), tmp_path / out)
        assert not (tmp_path / out).exists()


def test_the_command_tells_what_to_look_at_and_overwrites_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["describe", str(urdf(tmp_path)), "--free", "--out", str(tmp_path / "out")]
    assert main(command) == 0
    assert "walker, 4 joints in groups hip, ankle" in capsys.readouterr().out
    assert main(command) == 2
    assert "holds a robot.toml already" in capsys.readouterr().err
    for bad, told in (("nowhere.urdf", "no such file"), ("README.md", ".urdf")):
        (tmp_path / "README.md").touch()
        assert main(["describe", str(tmp_path / bad), "--out", str(tmp_path / "x")]) == 2
        assert told in capsys.readouterr().err
    command = ["describe", str(urdf(tmp_path)), "--name", "a/b", "--out", str(tmp_path / "x")]
    assert main(command) == 2
    assert "--name" in capsys.readouterr().err


def test_a_drafted_robot_is_recorded_and_replayed(tmp_path: Path) -> None:
    draft_robot(urdf(tmp_path), tmp_path / "walker", free=True)
    robot, out = str(tmp_path / "walker"), str(tmp_path / "runs")
    assert main(["record", "step:0.1", "--virtual", "--robot", robot, "--out", out]) == 0
    assert main(["replay", out, "--robot", robot, "--out", str(tmp_path / "replay")]) == 0
