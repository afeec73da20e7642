"""Robot folders: what is read."""

import hashlib
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from robots import MODEL, ROBOT, robot_folder, swap

from pup.errors import InputError
from pup.physics.model import compile_model
from pup.robot import RobotDescription, built_in_robots

DARWIN = RobotDescription.load("darwin_op2")


def test_a_folder_is_a_robot_without_any_python(tmp_path: Path) -> None:
    robot = RobotDescription.load(robot_folder(tmp_path))
    assert robot.name == "twin" and robot.joint_names == ("l", "r") and robot.groups == ("leg",)
    assert robot.floating and robot.torso == "trunk" and robot.feet == ("left", "right")
    assert robot.poses == {"open": (0.5, 0.0)}
    assert [spec.name for spec in robot.parameters] == [
        "kp/leg", "kd/leg", "tau_max/leg", "armature",
    ]  # fmt: skip
    assert robot.identified_path == tmp_path / "identified.json"
    assert robot.group_index.tolist() == [0, 0]


@pytest.mark.parametrize("name", ["darwin_op2", "darwin_leg", "servo_bench", "emps"])
def test_every_built_in_robot_loads_by_name_and_by_folder(name: str) -> None:
    robot = RobotDescription.load(name)
    assert robot.name == name and name in built_in_robots()
    assert RobotDescription.load(robot.folder) == robot
    assert hash(RobotDescription.load(robot.folder)) == hash(robot)


def test_groups_stand_in_the_order_of_the_paper() -> None:
    """arm, head, hip, knee, ankle: the order of rho and sigma in the authors' mu."""
    assert DARWIN.groups == ("arm", "head", "hip", "knee", "ankle")
    mu = [spec.name for spec in DARWIN.parameters if "nn_pd" in spec.actuators]
    assert mu == [
        *(f"{kind}/{group}" for kind in ("rho", "sigma") for group in DARWIN.groups),
        "torque_limit", "torso_com/x", "torso_com/z", "ground_friction",
    ]  # fmt: skip


def test_the_digest_follows_every_file_of_the_model(tmp_path: Path) -> None:
    model = MODEL.replace("<worldbody>", '<include file="extra.xml"/><worldbody>')
    folder = robot_folder(tmp_path, model=model)
    (tmp_path / "extra.xml").write_text("<mujocoinclude/>")
    first = RobotDescription.load(folder)
    (tmp_path / "extra.xml").write_text("<mujocoinclude><option timestep='0.001'/></mujocoinclude>")
    second = RobotDescription.load(folder)
    (tmp_path / "robot.toml").write_text(ROBOT + "# a comment")
    third = RobotDescription.load(folder)
    assert len({first.digest, second.digest, third.digest}) == 3
    assert re.fullmatch(r"[0-9a-f]{64}", first.digest)


def test_the_digest_follows_meshes_by_name_and_content(tmp_path: Path) -> None:
    """Without any it is what it always was, so that what was made with it stays good."""
    told = robot_folder(tmp_path / "none")
    texts = [(told / name).read_bytes() for name in ("robot.toml", "model.xml")]
    parts = b"".join(hashlib.sha256(text).digest() for text in texts)
    assert RobotDescription.load(told).digest == hashlib.sha256(parts).hexdigest()
    asset = '<compiler meshdir="stl"/><asset><mesh name="m" file="a.stl"/></asset><worldbody>'
    folder = robot_folder(tmp_path / "some", model=MODEL.replace("<worldbody>", asset))
    digests = {RobotDescription.load(folder).digest}
    for file, content in (("a.stl", "1"), ("a.stl", "2"), ("stl/a.stl", "2")):
        (folder / file).parent.mkdir(exist_ok=True)
        (folder / file).write_text(content)
        digests.add(RobotDescription.load(folder).digest)
    assert len(digests) == 4


@given(arrays(np.float64, (3, len(DARWIN.joints)), elements=st.floats(-4, 4)))
def test_mirroring_twice_changes_nothing(q: np.ndarray) -> None:
    permutation, sign = DARWIN.mirror()
    mirrored = sign * q[..., permutation]
    np.testing.assert_array_equal(sign * mirrored[..., permutation], q)


@given(st.data())
def test_any_accepted_mirror_map_is_an_involution(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    """Random maps over three joints: no involution, or signs that differ, and it is refused."""
    names = ("a", "b", "c")
    partners = [data.draw(st.sampled_from(names)) for _ in names]
    signs = [data.draw(st.sampled_from([-1, 1])) for _ in names]
    bodies = "".join(f'<body><joint name="{n}"/><geom size="1"/></body>' for n in names)
    rows = "".join(
        f'{{ name = "{n}", group = "leg", lower = -1, upper = 1, '
        f'mirror = "{m}", mirror_sign = {s} }},'
        for n, m, s in zip(names, partners, signs, strict=True)
    )
    folder = robot_folder(
        tmp_path_factory.mktemp("robot"),
        robot=f'schema = 1\nname = "x"\njoint = [{rows}]\n'
        + ROBOT[ROBOT.index("[[parameter]]") : ROBOT.index("[gait]")],
        model=f"<mujoco><worldbody>{bodies}</worldbody></mujoco>",
    )
    index = [names.index(partner) for partner in partners]
    good = all(index[index[i]] == i and signs[index[i]] == signs[i] for i in range(3))
    if good:
        permutation, sign = RobotDescription.load(folder).mirror()
        assert permutation[permutation].tolist() == [0, 1, 2]
        np.testing.assert_array_equal(sign[permutation] * sign, 1)
    else:
        with pytest.raises(InputError, match="mirror"):
            RobotDescription.load(folder)


def test_a_robot_without_a_mirror_map_says_so() -> None:
    with pytest.raises(InputError, match="no mirror map"):
        RobotDescription.load("emps").mirror()


def test_an_exact_parameter_replaces_one_of_a_pattern(tmp_path: Path) -> None:
    knee = ROBOT.replace('"r", servo_id = 2, group = "leg"', '"r", group = "knee"')
    knee = re.sub(r', mirror = "."(, mirror_sign = -1)', "", knee)
    knee = knee.replace("kd/leg", "kd/*").replace("tau_max/leg", "tau_max/*")
    knee = knee.replace(
        "[gait]\n",
        '[[parameter]]\nname = "kd/knee"\nunit = "N m s/rad"\nnominal = 9\nsearch = [8, 10]\n'
        'actuators = ["pd"]\n\n[gait]\n',
    )
    robot = RobotDescription.load(robot_folder(tmp_path, knee))
    nominal = {spec.name: spec.nominal for spec in robot.parameters}
    assert (nominal["kd/leg"], nominal["kd/knee"]) == (0.2, 9.0)
    assert list(nominal)[2:4] == ["kd/leg", "kd/knee"]


def test_the_gait_is_the_fourier_series_of_its_table(tmp_path: Path) -> None:
    """At phase 1/4 the first cosine is 0 and the second sine is 0; at 1/8 the second sine is 1."""
    gait = RobotDescription.load(robot_folder(tmp_path)).gait
    assert gait is not None and gait.period == 0.5
    angles = gait.angles([0.0, 0.125, 0.25])
    np.testing.assert_allclose(angles[:, 0], [1.1, 0.1 + np.sqrt(0.5) + 0.5, 0.1], atol=1e-12)
    np.testing.assert_array_equal(angles[:, 1], 0)
    assert gait.angles(0.0).shape == (2,)


def test_a_gait_says_how_it_starts_and_where_it_ends(tmp_path: Path) -> None:
    """Left out, the limits are the authors' and the feet alone may touch the floor."""
    plain = RobotDescription.load(robot_folder(tmp_path / "plain")).gait
    assert plain is not None and plain.ground_bodies == ("left", "right")
    assert (plain.start, plain.start_pitch, plain.blend) == (None, None, 0.2)
    assert (plain.tilt_limit, plain.drift_limit, plain.imu_pitch_offset) == (1.0, 0.3, 0.0)
    told = 'period = 0.5\nstart = "open"\nstart_pitch = 0.1\nground_bodies = ["left", "trunk"]'
    text = swap("period = 0.5", told)(ROBOT)
    gait = RobotDescription.load(robot_folder(tmp_path / "told", text)).gait
    assert gait is not None and gait.start == (0.5, 0.0) and gait.start_pitch == 0.1
    assert gait.ground_bodies == ("left", "trunk")


def test_a_setup_is_completed_with_the_defaults() -> None:
    assert DARWIN.setup({"payload": 0.2}) == {
        "payload": 0.2, "supply_voltage": 12.0, "p_gain": 32.0,
    }  # fmt: skip


def test_the_mark_of_windows_notepad_is_no_mistake(tmp_path: Path) -> None:
    folder = robot_folder(tmp_path)
    plain = RobotDescription.load(folder)
    for file in ("robot.toml", "model.xml"):
        (folder / file).write_bytes(b"\xef\xbb\xbf" + (folder / file).read_bytes())
    assert RobotDescription.load(folder) == plain
    compile_model(plain, "ground")
