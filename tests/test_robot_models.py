"""The built-in robots in MuJoCo: masses, mirror symmetry, stance, contacts, benches."""

import re
import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from pup.errors import InputError
from pup.physics.model import compile_model
from pup.robot import RobotDescription, built_in_robots

DARWIN = RobotDescription.load("darwin_op2")
MODEL = mujoco.MjModel.from_xml_path(str(DARWIN.model_path))
JOINTS = MODEL.jnt_qposadr[[MODEL.joint(name).id for name in DARWIN.joint_names]]
DOFS = MODEL.jnt_dofadr[[MODEL.joint(name).id for name in DARWIN.joint_names]]
FLIP = np.array([1.0, -1.0, 1.0])  # the sagittal plane is y = 0
IN_THE_AIR = 1.0  # m


def posed(q: NDArray[np.float64], height: float = IN_THE_AIR, pitch: float = 0.0) -> mujoco.MjData:
    """The robot with joint angles q (rad), the torso at a height (m) leaning forward (rad)."""
    data = mujoco.MjData(MODEL)
    data.qpos[2] = height
    data.qpos[3:7] = [np.cos(pitch / 2), 0, np.sin(pitch / 2), 0]
    data.qpos[JOINTS] = q
    mujoco.mj_forward(MODEL, data)
    return data


def touching(data: mujoco.MjData) -> set[tuple[str, str]]:
    """The pairs of geoms in contact."""
    return {(MODEL.geom(c.geom[0]).name, MODEL.geom(c.geom[1]).name) for c in data.contact}


def other_side(name: str) -> str:
    """The body on the other side."""
    return {"l_": "r_", "r_": "l_"}.get(name[:2], name[:2]) + name[2:]


@pytest.mark.parametrize("name", built_in_robots())
def test_every_built_in_model_compiles_and_has_the_joints(name: str) -> None:
    robot = RobotDescription.load(name)
    model = mujoco.MjModel.from_xml_path(str(robot.model_path))
    assert model.opt.timestep == robot.timestep
    assert {model.joint(i).name for i in range(model.njnt)} - {"root"} == set(robot.joint_names)
    free = (model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).any()
    assert free == robot.floating
    for joint in robot.joints:
        low, high = model.joint(joint.name).range
        assert low <= joint.lower < joint.upper <= high
    # Armature, damping and friction are the actuator model's.
    dofs = [model.joint(joint.name).dofadr[0] for joint in robot.joints]
    for field in (model.dof_armature, model.dof_damping, model.dof_frictionloss):
        assert not field[dofs].any()


RADIANS = ("model.xml", 'angle="radian"', "")
DEGREES = ("robot.toml", "3.14", "180")
NO_RANGE = ("model.xml", 'range="-3.1416 3.1416"', "")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ([RADIANS], "[-3.14, 3.14] is far beyond its range [-0.0548, 0.0548] rad in model.xml"),
        ([DEGREES], "[-180, 180] is far beyond its range [-3.14, 3.14] rad in model.xml"),
        ([DEGREES, NO_RANGE], "[-180, 180] is more than two turns"),
    ],
)
def test_degrees_in_one_of_a_robots_files_are_refused(
    tmp_path: Path, changes: list[tuple[str, str, str]], words: str
) -> None:
    folder = tmp_path / "robot"
    shutil.copytree(RobotDescription.load("servo_bench").folder, folder)
    for file, old, new in changes:
        text = (folder / file).read_text()
        assert old in text
        (folder / file).write_text(text.replace(old, new))
    with pytest.raises(InputError, match=re.escape(words)) as error:
        compile_model(RobotDescription.load(folder), "bench")
    assert str(folder / "robot.toml") in str(error.value) and "degrees" in str(error.value)


@pytest.mark.parametrize("name", built_in_robots())
def test_knobs_at_their_defaults_leave_the_model_as_it_is(name: str) -> None:
    robot = RobotDescription.load(name)
    model = mujoco.MjModel.from_xml_path(str(robot.model_path))
    for knob in robot.knobs:
        for edit in knob.edits:
            kind = "joint" if edit.field.startswith(("jnt", "dof")) else edit.field.split("_")[0]
            element = getattr(model, kind)(edit.element)
            value = getattr(element, edit.field.split("_", 1)[1])[edit.index or 0]
            assert value == pytest.approx(edit.scale * knob.default + edit.offset, rel=1e-12)


def test_mass_and_height_are_the_official_ones() -> None:
    """ROBOTIS: 2.9 kg, 0.4545 m; the CAD adds up to 2.9253 kg."""
    assert MODEL.body_mass.sum() == pytest.approx(2.9253, abs=5e-5)
    data = posed(np.zeros(20), height=0.3417)
    head = data.geom("head_tilt").xpos[2] + MODEL.geom("head_tilt").size[0]
    assert head == pytest.approx(0.4545, abs=0.003)
    assert data.geom("l_foot").xpos[2] == pytest.approx(MODEL.geom("l_foot").size[2], abs=1e-12)


@settings(max_examples=50)
@given(arrays(np.float64, 20, elements=st.floats(-2, 2)))
def test_a_mirrored_pose_has_mirrored_bodies(q: NDArray[np.float64]) -> None:
    """Positions of frames, of centres of mass and of shells, and the joint-space inertia."""
    permutation, sign = DARWIN.mirror()
    here, there = posed(q), posed(sign * q[permutation])
    for body in range(1, MODEL.nbody):
        name = MODEL.body(body).name
        for field in ("xpos", "xipos"):
            mirrored = getattr(there.body(other_side(name)), field)
            np.testing.assert_allclose(mirrored, FLIP * getattr(here.body(name), field), atol=1e-9)
    for geom in range(MODEL.ngeom):
        name = MODEL.geom(geom).name
        mirrored = there.geom(other_side(name)).xpos
        np.testing.assert_allclose(mirrored, FLIP * here.geom(name).xpos, atol=1e-9)
    inertia = [np.zeros((MODEL.nv, MODEL.nv)) for _ in range(2)]
    for full, data in zip(inertia, (here, there), strict=True):
        mujoco.mj_fullM(MODEL, data, full)
    joints = inertia[0][np.ix_(DOFS, DOFS)]
    expected = np.outer(sign, sign) * joints[np.ix_(permutation, permutation)]
    np.testing.assert_allclose(inertia[1][np.ix_(DOFS, DOFS)], expected, atol=1e-9)


def test_stops_are_mirror_images() -> None:
    """Command limits are as measured on one robot; the model's stops are symmetric."""
    permutation, sign = DARWIN.mirror()
    stops = np.array([MODEL.joint(name).range for name in DARWIN.joint_names])
    np.testing.assert_allclose(np.sort(sign[:, None] * stops[permutation], axis=1), stops)


def test_poses_are_symmetric_and_free_of_self_contact() -> None:
    permutation, sign = DARWIN.mirror()
    assert set(DARWIN.poses) == {"stand", "squat", "half_squat"}
    for pose in DARWIN.poses.values():
        q = np.array(pose)
        np.testing.assert_array_equal(sign * q[permutation], q)
        assert not touching(posed(q))


def test_the_reference_gait_touches_nothing() -> None:
    """As it is and clipped to the command limits, as it is played."""
    assert DARWIN.gait is not None and DARWIN.gait.period == 0.5625
    angles = DARWIN.gait.angles(np.arange(200) / 200)
    lower = [joint.lower for joint in DARWIN.joints]
    upper = [joint.upper for joint in DARWIN.joints]
    for q in np.concatenate([angles, np.clip(angles, lower, upper)]):
        assert not touching(posed(q))


def test_self_contact_is_seen_between_parts_that_are_no_neighbours() -> None:
    legs_crossed = np.zeros(20)
    legs_crossed[[9, 15]] = 0.3, -0.3
    assert any({"l_foot", "r_foot"} <= set(pair) for pair in touching(posed(legs_crossed)))
    assert not touching(posed(np.zeros(20)))


@pytest.mark.parametrize("pose", ["stand", "squat", "half_squat"])
def test_the_soles_lie_flat_in_every_pose(pose: str) -> None:
    """Some forward lean of the torso lays both soles on the floor: all eight corners touch."""
    q = np.array(DARWIN.poses[pose])
    foot = posed(q).body("l_ank_roll_link").xmat.reshape(3, 3)
    lean = np.arctan2(foot[2, 0], foot[0, 0])
    in_air = posed(q, pitch=lean)
    sole = in_air.geom("l_foot").xpos[2] - MODEL.geom("l_foot").size[2]
    data = posed(q, height=IN_THE_AIR - sole - 1e-5, pitch=lean)
    assert touching(data) == {("floor", "l_foot"), ("floor", "r_foot")}
    assert len(data.contact) == 8
    for side in ("l", "r"):
        up = data.body(f"{side}_ank_roll_link").xmat.reshape(3, 3)[:, 2]
        np.testing.assert_allclose(up, [0, 0, 1], atol=1e-9)
        middle = data.geom(f"{side}_foot").xpos - data.body(f"{side}_ank_roll_link").xpos
        outward = 1 if side == "l" else -1
        np.testing.assert_allclose(middle, [0.00025, outward * 0.0105, -0.0265], atol=1e-6)


@pytest.mark.parametrize("kp", [15.0, 60.0])
def test_it_stands_in_half_squat_for_5_seconds(kp: float) -> None:
    """Under PD servos: upright at 0.125 rad, half the weight on each foot, only feet touching."""
    q = np.array(DARWIN.poses["half_squat"])
    lean = 0.1255
    in_air = posed(q, pitch=lean)
    sole = in_air.geom("l_foot").xpos[2] - MODEL.geom("l_foot").size[2]
    data = posed(q, height=IN_THE_AIR - sole, pitch=lean)
    model = mujoco.MjModel.from_xml_path(str(DARWIN.model_path))
    model.dof_damping[DOFS] = 0.7
    model.dof_armature[DOFS] = 0.001
    start = data.qpos[:2].copy()
    for _ in range(round(5 / DARWIN.timestep)):
        data.qfrc_applied[DOFS] = np.clip(kp * (q - data.qpos[JOINTS]), -2.3, 2.3)
        mujoco.mj_step(model, data)
    torso = data.body("body").xmat.reshape(3, 3)
    assert -np.arcsin(torso[2, 0]) == pytest.approx(0.125, abs=0.005)
    assert np.abs(data.qpos[:2] - start).max() < 0.002
    assert touching(data) == {("floor", "l_foot"), ("floor", "r_foot")}
    weight = {"l_foot": 0.0, "r_foot": 0.0}
    force = np.zeros(6)
    for i, contact in enumerate(data.contact):
        mujoco.mj_contactForce(model, data, i, force)
        weight[model.geom(contact.geom[1]).name] += force[0]
    assert weight["l_foot"] == pytest.approx(14.35, abs=0.05)
    assert weight["r_foot"] == pytest.approx(14.35, abs=0.05)


def test_the_leg_is_the_left_leg_of_the_whole_robot() -> None:
    leg = RobotDescription.load("darwin_leg")
    model = mujoco.MjModel.from_xml_path(str(leg.model_path))
    assert leg.groups == ("hip", "knee", "ankle")
    whole = {joint.name: joint for joint in DARWIN.joints}
    for joint in leg.joints:
        twin = whole[joint.name]
        assert (joint.servo_id, joint.lower, joint.upper) == (twin.servo_id, twin.lower, twin.upper)
        np.testing.assert_array_equal(model.joint(joint.name).axis, MODEL.joint(joint.name).axis)
        np.testing.assert_array_equal(model.joint(joint.name).range, MODEL.joint(joint.name).range)
        body = f"{joint.name}_link"
        for field in ("mass", "ipos", "iquat", "inertia"):
            value, expected = (getattr(m.body(body), field) for m in (model, MODEL))
            np.testing.assert_array_equal(value, expected)


def test_the_servo_bench_is_a_pendulum_hanging_at_zero() -> None:
    """Gravity's torque at a quarter turn is m g l, the inertia m l2; both follow the knobs."""
    robot = RobotDescription.load("servo_bench")
    model = mujoco.MjModel.from_xml_path(str(robot.model_path))
    mass, length = 0.5, 0.07
    for knob, value in zip(robot.knobs[:2], (mass, length), strict=True):
        for edit in knob.edits:
            index = (
                model.body(edit.element).id
                if edit.index is None
                else (model.body(edit.element).id, edit.index)
            )
            getattr(model, edit.field)[index] = edit.scale * value + edit.offset
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    mujoco.mj_forward(model, data)
    assert data.qfrc_bias[0] == pytest.approx(0, abs=1e-12)
    data.qpos[0] = np.pi / 2
    mujoco.mj_forward(model, data)
    assert data.qfrc_bias[0] == pytest.approx(mass * 9.81 * length, rel=1e-9)
    inertia = np.zeros((1, 1))
    mujoco.mj_fullM(model, data, inertia)
    assert inertia[0, 0] == pytest.approx(mass * length**2, rel=1e-3)


def test_the_emps_axis_is_a_mass_that_gravity_does_not_move() -> None:
    robot = RobotDescription.load("emps")
    model = mujoco.MjModel.from_xml_path(str(robot.model_path))
    data = mujoco.MjData(model)
    data.qfrc_applied[0] = 95.11
    mujoco.mj_step(model, data)
    assert data.qacc[0] == pytest.approx(1.0)
    nominal = {spec.name: spec.nominal for spec in robot.parameters}
    assert nominal["tau_max/axis"] == pytest.approx(35.15065 * 10, rel=1e-3)
    assert nominal["kd/axis"] == pytest.approx(35.15065 * 243.45, rel=1e-4)
    assert nominal["kp/axis"] == pytest.approx(nominal["kd/axis"] * 160.18, rel=1e-4)


def test_the_so101_weighs_and_hangs_as_its_public_model() -> None:
    """Masses and lever arms of so101_new_calib.xml, with the jaw half open.

    At zero the upper arm stands and the rest lies straight ahead: gravity pulls all three down, and
    down is positive.
    """
    robot = RobotDescription.load("so101")
    model = mujoco.MjModel.from_xml_path(str(robot.model_path))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert model.body_mass.sum() == pytest.approx(0.147 + 0.100006 + 0.103 + 0.104 + 0.079 + 0.099)
    expected = [0.0, 0.537692, 0.451762, 0.116148, -0.000087]
    np.testing.assert_allclose(-data.qfrc_bias, expected, atol=2e-6)
    data.qpos[:] = [0.3, 0.5, -0.4, 0.7, 1.2]
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.body("held").xpos, [0.373338, -0.111305, 0.077346], atol=1e-5)
    expected = [0.0, 0.685728, 0.417493, 0.082318, 0.003179]
    np.testing.assert_allclose(-data.qfrc_bias, expected, atol=2e-6)


@pytest.mark.parametrize("joint", ["Pitch", "Elbow", "Wrist_Pitch"])
def test_positive_angles_lower_the_so101(joint: str) -> None:
    robot = RobotDescription.load("so101")
    model = mujoco.MjModel.from_xml_path(str(robot.model_path))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    before = data.body("held").xpos[2]
    data.joint(joint).qpos[0] = 0.1
    mujoco.mj_forward(model, data)
    assert data.body("held").xpos[2] < before - 0.01
