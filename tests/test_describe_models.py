"""Models that people have: frames out of CAD, floors in bodies, names and inertias of all kinds."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from test_describe import BOX, WALKER, link, stl, urdf

from hardware_agent.virtual import skeleton
from pup.drafting.description import group_of, groups_of, partner
from pup.drafting.draft import Drafted, draft_robot
from pup.errors import InputError
from pup.physics.model import Model, compile_model, standing_qpos
from pup.robot import RobotDescription

FLOOR = '<geom name="floor" type="plane" size="5 5 0.1"/>'
LEG = """<body name="{side}_shin" pos="0 {y} -0.1"><joint name="{side}_knee" axis="0 1 0"
  range="-1 1"/><geom name="{side}_bone" type="capsule" fromto="0 0 0 0 0 -0.1" size="0.02"/>
  <body name="{side}_foot" pos="0 0 -0.12"{foot}><joint name="{side}_ankle" axis="{axis}"
  range="-1 1"/><geom name="{side}_sole" type="box" size="{size}"/></body></body>"""
PLAIN = {"foot": "", "axis": "0 1 0", "size": "0.06 0.03 0.01"}


def legs(**foot: str) -> str:
    """Two legs, their feet as told."""
    told = PLAIN | foot
    return "".join(LEG.format(side=s, y=y, **told) for s, y in (("left", 0.05), ("right", -0.05)))


def biped(world: str = FLOOR, torso: str = "", legs: str = legs(), more: str = "") -> str:
    """A biped, with more in the world, in its torso and beside the world."""
    return f"""<mujoco><compiler angle="radian"/><worldbody>{world}
      <body name="base" pos="0 0 0.4"><freejoint/><geom type="box" size="0.05 0.06 0.1"/>
      {torso}{legs}</body></worldbody>{more}</mujoco>"""


def arm(more: str = "", range_: str = 'range="-2 2"', world: str = "") -> str:
    """An arm of two joints `a` and `b` on a fixed base."""
    return f"""<mujoco><compiler angle="radian"/><worldbody>{world}
      <body name="upper"><joint name="a" axis="0 1 0" {range_}/>
      <geom type="capsule" fromto="0 0 0 0 0 0.1" size="0.02"/><body name="lower" pos="0 0 0.1">
      <joint name="b" axis="0 1 0" {range_}/><geom type="capsule" fromto="0 0 0 0 0 0.1"
      size="0.02"/></body></body></worldbody>{more}</mujoco>"""


def drafted(folder: Path, text: str, name: str = "robot.xml", free: bool = False) -> Drafted:
    file = folder / "source" / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)
    return draft_robot(file, folder / "out", free=free)


def nominal(robot: RobotDescription) -> dict[str, float]:
    return {parameter.name: parameter.nominal for parameter in robot.parameters}


def stood(robot: RobotDescription) -> tuple[Model, np.ndarray]:
    """The robot on the ground, its joints at zero."""
    model = compile_model(robot, "ground")
    none = np.full(4, np.nan)
    return model, standing_qpos(robot, model, np.zeros(len(robot.joints)), none)


def test_no_file_is_overwritten(tmp_path: Path) -> None:
    source = tmp_path / "model.xml"
    source.write_text(biped())
    with pytest.raises(InputError, match=r"holds a model\.xml already"):
        draft_robot(source, tmp_path)
    assert source.read_text() == biped()
    package = tmp_path / "walker"
    stl(package / "meshes" / "shin.stl")
    (tmp_path / "out" / "assets").mkdir(parents=True)
    (tmp_path / "out" / "assets" / "shin.stl").write_text("mine")
    file = urdf(package, WALKER.replace(BOX, '<mesh filename="meshes/shin.stl"/>'))
    with pytest.raises(InputError, match=r"assets/shin\.stl already"):
        draft_robot(file, tmp_path / "out")
    assert [f.name for f in (tmp_path / "out").iterdir()] == ["assets"]


def test_feet_in_frames_out_of_cad_get_soles(tmp_path: Path) -> None:
    """The foot's y axis is up, and its z axis forward or back."""
    feet = legs(foot=' euler="1.5708 0 0"', axis="0 0 1", size="0.06 0.01 0.03")
    told = drafted(tmp_path / "cad", biped(legs=feet))
    assert any("left_foot, right_foot" in note and "sole" in note for note in told.notes)
    for robot in (told.robot, drafted(tmp_path / "plain", biped()).robot):
        model, qpos = stood(robot)
        virtual = skeleton.standing(robot, model.compiled, np.zeros(4))
        assert np.abs(qpos[3]) == pytest.approx(1, abs=1e-6)
        assert np.abs(virtual[3]) == pytest.approx(1, abs=1e-6)
        assert qpos[2] == pytest.approx(0.1 + 0.12 + 0.01, abs=1e-6)
    plain = (tmp_path / "plain" / "out" / "model.xml").read_text()
    assert "_foot_sole" not in plain


def test_a_foot_that_leans_in_the_key_frame_keeps_its_axis(tmp_path: Path) -> None:
    key = '<keyframe><key name="start" qpos="0 0 0.4 1 0 0 0 0.5 0 0.5 0"/></keyframe>'
    drafted(tmp_path, biped(more=key))
    assert "_foot_sole" not in (tmp_path / "out" / "model.xml").read_text()


def test_a_floor_inside_a_body_moves_to_the_world(tmp_path: Path) -> None:
    table = '<geom size="0.1" pos="1 0 -0.2"/>'  # not of the robot, which stands no higher for it
    inside = f'<body name="ground" pos="0 0 -0.2">{FLOOR}{table}</body>'
    more = """<contact><pair geom1="floor" geom2="left_sole"/></contact>
      <default><geom contype="0" conaffinity="1"/></default>"""
    model, qpos = stood(drafted(tmp_path, biped(inside, more=more)).robot)
    floor = model.compiled.geom("floor")
    assert (floor.bodyid[0], floor.type[0]) == (0, mujoco.mjtGeom.mjGEOM_PLANE)
    assert floor.contype[0] == 1
    assert floor.id in (model.compiled.pair_geom1[0], model.compiled.pair_geom2[0])
    assert qpos[2] == pytest.approx(-0.2 + 0.23, abs=1e-6)


def test_the_floor_is_a_level_plane_and_pairs_follow_it(tmp_path: Path) -> None:
    wall = '<geom name="floor" type="plane" size="5 5 0.1" pos="2 0 0" euler="0 -1.57 0"/>'
    ground = '<geom name="ground" type="plane" size="5 5 0.1"/>'
    pair = '<contact><pair geom1="ground" geom2="left_sole"/></contact>'
    model, _ = stood(drafted(tmp_path, biped(wall + ground, more=pair)).robot)
    floor = model.compiled.geom("floor")
    assert floor.quat == pytest.approx([1, 0, 0, 0])
    assert floor.id in (model.compiled.pair_geom1[0], model.compiled.pair_geom2[0])
    assert model.compiled.geom("floor_too").pos[0] == 2


def test_uneven_ground_becomes_level(tmp_path: Path) -> None:
    field = '<asset><hfield name="h" nrow="2" ncol="2" size="5 5 0.1 0.1"/></asset>'
    told = drafted(tmp_path, biped('<geom type="hfield" hfield="h" name="floor"/>', more=field))
    assert any("height fields" in note for note in told.notes)
    assert stood(told.robot)[0].compiled.nhfield == 0


@pytest.mark.parametrize(
    ("name", "other", "group"),
    [
        ("HeadYaw", "HeadYaw", "head"),
        ("L_HipPitch", "R_HipPitch", "hip"),
        ("LHipPitch", "RHipPitch", "hip"),
        ("leftHipPitch", "rightHipPitch", "hip"),
        ("HipYawL", "HipYawR", "hip"),
        ("hip_yaw_LEFT", "hip_yaw_RIGHT", "hip"),
        ("FL_hip_joint", "FR_hip_joint", "hip"),
    ],
)
def test_words_of_a_name_may_be_told_by_capitals(name: str, other: str, group: str) -> None:
    assert (partner(name), partner(other), group_of(name)) == (other, name, group)


def test_a_joint_beside_the_middle_is_not_its_own_partner(tmp_path: Path) -> None:
    told = drafted(tmp_path, biped(legs=legs().replace("left_", "one_").replace("right_", "two_")))
    assert not told.robot.mirrored
    assert any("no mirror map" in note for note in told.notes)


def test_the_mirror_map_is_judged_at_the_reference_pose(tmp_path: Path) -> None:
    key = '<keyframe><key name="start" qpos="0 0 0.4 1 0 0 0 0.5 0 -0.3 0"/></keyframe>'
    assert drafted(tmp_path, biped(more=key)).robot.mirrored


def test_a_robot_that_faces_along_y_is_told_to_turn(tmp_path: Path) -> None:
    text = WALKER.replace('"0 0.06 ', '"-0.06 0 ').replace('"0 -0.06 ', '"0.06 0 ')
    for axis, turned in (("0 1 0", "-1 0 0"), ("0 -1 0", "1.0 0 0"), ("1 0 0", "0 1.0 0")):
        text = text.replace(f'"{axis}"', f'"{turned}"')
    told = drafted(tmp_path, text, "w.urdf", free=True)
    assert "it faces along y: turn the model, as forward must be +x" in told.notes


def test_a_mesh_is_found_by_as_much_of_its_path_as_there_is(tmp_path: Path) -> None:
    """Not another of its name; a space may be written as in a web address."""
    package = tmp_path / "my_package"
    stl(package / "meshes" / "another" / "shin.stl")
    stl(package / "meshes" / "left leg" / "shin.stl", 0.03)
    mesh = '<mesh filename="package://my_package/meshes/left%20leg/shin.stl"/>'
    text = WALKER.replace('<sphere radius="0.02"/>', mesh)
    robot = draft_robot(urdf(package / "urdf", text), tmp_path / "out").robot
    assert np.ptp(compile_model(robot, "bench").compiled.mesh_vert) > 0.025


def test_a_path_is_stripped_where_the_model_says_so(tmp_path: Path) -> None:
    stl(tmp_path / "source" / "here" / "m.stl")
    text = arm('<asset><mesh name="m" file="C:/x/m.stl"/></asset>').replace(
        '<compiler angle="radian"/>', '<compiler strippath="true" meshdir="here"/>'
    )
    text = text.replace('<joint name="a"', '<geom type="mesh" mesh="m"/><joint name="a"')
    assert (drafted(tmp_path, text).robot.folder / "assets" / "m.stl").is_file()


def test_meshes_that_nobody_reads_go_where_the_mass_stays(tmp_path: Path) -> None:
    mesh = '<mesh filename="package://walker/a.dae"/>'
    told = drafted(tmp_path, WALKER.replace(BOX, mesh), "w.urdf")
    assert any("left_foot, right_foot" in note for note in told.notes)
    total = compile_model(told.robot, "bench").compiled.body_subtreemass[0]
    assert total == pytest.approx(2.6)
    bare = (
        link("base", 2.0, mesh).split("<inertial>")[0]
        + f"""<collision><geometry>{mesh}
      </geometry></collision></link>"""
    )
    text = WALKER.replace(link("base", 2.0, '<box size="0.2 0.06 0.1"/>'), bare)
    with pytest.raises(InputError, match="tells the mass of 'base'"):
        drafted(tmp_path / "again", text, "w.urdf", free=True)


def test_a_base_without_mass_passes_the_centre_of_mass_on(tmp_path: Path) -> None:
    dummy = '<link name="dummy"/><joint name="f" type="fixed"><parent link="dummy"/>'
    text = WALKER.replace("</robot>", f'{dummy}<child link="base"/></joint></robot>')
    told = drafted(tmp_path, text, "w.urdf", free=True)
    assert told.robot.torso == "dummy"
    assert {"com/base/x", "com/base/y", "com/base/z"} <= nominal(told.robot).keys()
    assert "torso_com/x" not in nominal(told.robot)
    assert any("dummy weighs nothing" in note for note in told.notes)


def test_groups_are_divided_where_joints_differ() -> None:
    names = ["l_hip_yaw", "r_hip_yaw", "l_hip_pitch", "r_hip_pitch", "l_knee", "joint1", "joint2"]
    kinds = [1, 1, 2, 2, 1, 1, 2]
    groups = groups_of(names, lambda a, b: kinds[a] == kinds[b])
    assert groups[:5] == ["hip_yaw", "hip_yaw", "hip_pitch", "hip_pitch", "knee"]
    assert groups[5:] == ["joint_1", "joint_2"]


def test_servos_of_a_group_are_alike(tmp_path: Path) -> None:
    text = arm("""<actuator><position joint="a" kp="20" forcerange="-9 9"/>
      <position joint="b" kp="12" forcerange="-2 2"/></actuator>""")
    text = text.replace('"a"', '"tip_yaw"').replace('"b"', '"tip_roll"')
    told = nominal(drafted(tmp_path, text).robot)
    assert (told["tau_max/tip_yaw"], told["tau_max/tip_roll"]) == (9, 2)


def test_couplings_that_are_left_out_are_told(tmp_path: Path) -> None:
    more = """<equality><joint joint1="b" joint2="a"/></equality>
      <tendon><fixed name="t"><joint joint="b" coef="1"/></fixed></tendon>
      <custom><tuple name="tt"><element objtype="tendon" objname="t"/></tuple></custom>
      <sensor><tendonpos tendon="t"/></sensor>"""
    told = drafted(tmp_path, arm(more))
    assert "couplings of the model are left out, so that these move freely: b, a; b" in told.notes


def test_only_position_servos_tell_limits(tmp_path: Path) -> None:
    """By the angles at which they rest, not by what they are told."""
    more = """<actuator><position joint="a" kp="5" gear="10" ctrlrange="-8 20"/>
      <general joint="b" biastype="affine" gainprm="0.3" biasprm="0 -80 -8" ctrlrange="0 255"/>
      </actuator>"""
    one, other = drafted(tmp_path, arm(more)).robot.joints
    assert (one.lower, one.upper) == (-0.8, 2)
    assert (other.lower, other.upper) == (0, pytest.approx(0.95625))
    rate = '<actuator><velocity joint="a" kv="0.5" ctrlrange="-8 8"/></actuator>'
    told = drafted(tmp_path / "rate", arm(rate, range_=""))
    assert (told.robot.joints[0].lower, told.robot.joints[0].upper) == (-np.pi, np.pi)
    assert any("made up: a, b" in note for note in told.notes)


def test_what_is_not_of_the_robot_is_left_out(tmp_path: Path) -> None:
    cube = '<body name="cube"><freejoint/><geom size="0.02"/></body>'
    told = drafted(tmp_path / "arm", arm(world=cube))
    assert not told.robot.floating and "not of the robot, and left out: cube" in told.notes
    cube += '<body name="goal" mocap="true"><geom size="0.1"/></body>'
    door = '<body name="door" pos="2 0 0"><joint name="hinge"/><geom size="0.1"/></body>'
    qpos = "0 0 1 1 0 0 0 0.3 0 0 0.4 1 0 0 0 0.5 0 0.2 0"
    key = f'<keyframe><key name="home" qpos="{qpos}"/></keyframe>'
    told = drafted(tmp_path / "biped", biped(FLOOR + cube + door, more=key))
    assert told.robot.torso == "base"
    assert "not of the robot, and left out: cube, goal, door" in told.notes
    assert told.robot.poses["home"] == (0.5, 0, 0.2, 0)


@pytest.mark.parametrize(
    ("torso", "site", "place"),
    [
        ('<site name="imu" pos="0 0 0.1"/>', "imu", 0.1),
        ('<site name="imu" pos="0 0 0.1" euler="0 0 1.57"/>', "torso_imu", 0.1),
        ('<site name="simulated" pos="0 0 0.1"/>', "torso_imu", 0.0),
        ('<body><geom size="0.01"/><site name="IMU_1" pos="0 0 0.1"/></body>', "IMU_1", 0.1),
        ('<body><geom size="0.01"/><body name="imuLink" pos="0 0 0.1"/></body>', "torso_imu", 0.1),
    ],
)
def test_the_imu_is_told_by_a_word(torso: str, site: str, place: float, tmp_path: Path) -> None:
    robot = drafted(tmp_path, biped(torso=torso)).robot
    assert robot.imu_site == site
    compiled = compile_model(robot, "ground").compiled
    assert compiled.site(site).pos[2] == pytest.approx(place)


def test_guesses_are_listed_and_leave_room_for_the_models_damping(tmp_path: Path) -> None:
    told = drafted(tmp_path / "plain", arm())
    assert "guessed by what they carry: kp, kd, tau_max of all joints" in told.notes
    assert "guessed by what they move: armature of all joints" in told.notes
    damped = drafted(tmp_path / "damped", arm().replace("<joint", '<joint damping="0.01"'))
    kinds = [name for name in nominal(told.robot) if name.startswith("kd/")]
    for kind in kinds:
        expected = nominal(told.robot)[kind] - 0.01
        assert nominal(damped.robot)[kind] == pytest.approx(expected, rel=0.05)


def test_poses_are_those_of_named_key_frames_first(tmp_path: Path) -> None:
    keys = """<keyframe><key qpos="0.1 0.1"/><key name="home" qpos="0.2 3"/>
      <key name="lie down" qpos="0.3 0"/></keyframe>"""
    told = drafted(tmp_path, arm(keys))
    assert told.robot.poses == {"home": (0.2, 2), "lie_down": (0.3, 0)}
    assert "pose home: beyond their limits, and clipped: b" in told.notes


def test_what_is_told_keeps_its_digits_and_its_step(tmp_path: Path) -> None:
    more = '<option timestep="0.001"/><actuator><position joint="a" kp="17.813"/></actuator>'
    robot = drafted(tmp_path, arm(more), "my_arm.xml").robot
    assert nominal(robot)["kp/a"] == 17.81
    assert (robot.name, robot.timestep) == ("my_arm", 0.001)
    assert drafted(tmp_path / "usual", arm()).robot.timestep == 0.002


def test_that_no_feet_are_found_is_said(tmp_path: Path) -> None:
    text = biped().replace("<geom", '<geom contype="0" conaffinity="0"')
    assert any("no feet are found" in note for note in drafted(tmp_path, text).notes)


def test_what_has_no_name_gets_one_of_its_own(tmp_path: Path) -> None:
    hinge = '<joint axis="0 1 0" range="-1 1"/>'
    text = f"""<mujoco><worldbody><body pos="0 0 1"><freejoint/><geom size="0.1"/>
      <body name="torso"><geom size="0.02"/></body>
      <body><joint axis="1 0 0" range="-1 1"/>{hinge}<geom size="0.02" pos="0 0 -0.3"/></body>
      <body>{hinge}<geom size="0.02" pos="0 0.1 -0.3"/></body></body></worldbody></mujoco>"""
    robot = drafted(tmp_path, text).robot
    assert robot.torso == "torso_2" and robot.feet == ("body", "body_2")
    assert robot.joint_names == ("body_joint", "body_joint_2", "body_2_joint")


def test_names_that_a_toml_file_cannot_hold_are_changed(tmp_path: Path) -> None:
    text = WALKER.replace("left_", "left leg/").replace("right_", "right leg/")
    told = drafted(tmp_path, text, "w.urdf", free=True)
    assert told.robot.joint_names[0] == "left_leg_hip_pitch"
    assert told.robot.feet == ("left_leg_foot", "right_leg_foot") and told.robot.mirrored
    assert any("left_leg_hip_pitch" in note for note in told.notes)
    servo = '<actuator><position joint="my a" kp="7"/></actuator>'
    robot = drafted(tmp_path / "servo", arm(servo).replace('"a"', '"my a"')).robot
    assert nominal(robot)["kp/my_a"] == 7


BARE = '<link name="imu_link"/>'
SHAPE = f'<link name="imu_link"><collision><geometry>{BOX}</geometry></collision></link>'
EMPTY = link("imu_link", 0.0, BOX)
FAULTY = ('ixx="1e-3"', 'ixx="9e-3"')


@pytest.mark.parametrize("imu", [BARE, SHAPE, EMPTY])
@pytest.mark.parametrize("inertia", [FAULTY[:1] * 2, FAULTY])
def test_inertias_are_mended_and_masses_are_those_of_the_model(
    imu: str, inertia: tuple[str, str], tmp_path: Path
) -> None:
    """Shapes of links that have no mass, or no inertial, give them none."""
    text = WALKER.replace(*inertia, 1).replace(BARE, imu)
    told = drafted(tmp_path, text, "w.urdf", free=True)
    assert any("MuJoCo refused inertias" in n for n in told.notes) == (inertia == FAULTY)
    assert stood(told.robot)[0].compiled.body_subtreemass[0] == pytest.approx(2.6)


TWO = '<body><freejoint/><geom size="1"/><body><joint/><geom size="1"/></body></body>'
CLOTH = '<flexcomp name="f" type="grid" count="3 3 1" dim="2" spacing="1 1 1"/>'


@pytest.mark.parametrize(
    ("text", "free", "told"),
    [
        (arm(), True, "has a joint of its own; the model has no base link"),
        (arm().replace('name="b"', 'name="a"'), False, "robot.xml: MuJoCo refuses it: "),
        (arm(world=CLOTH), False, "soft body"),
        (biped(FLOOR + TWO), False, "more than one robot is free (torso, base)"),
        ("", False, "MuJoCo refuses it: "),
    ],
)
def test_what_is_refused_names_the_source(text: str, free: bool, told: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as refused:
        drafted(tmp_path, text, free=free)
    message, source = str(refused.value), str(tmp_path / "source" / "robot.xml")
    assert told in message and message.startswith(source) and "\n" not in message
    assert not (tmp_path / "out").exists()


def test_what_pup_itself_refuses_is_told_of_the_source(tmp_path: Path) -> None:
    """Not of a folder that nobody knows of."""
    degrees = '<actuator><position joint="a" kp="1" ctrlrange="-90 90"/></actuator>'
    with pytest.raises(InputError, match="are these degrees") as refused:
        drafted(tmp_path, arm(degrees, range_=""))
    source = tmp_path / "source" / "robot.xml"
    told = f"{source}: what comes of it is refused: robot.toml: joint 'a'"
    assert str(refused.value).startswith(told)
