"""Robot folders: what is read, and what is refused with which words."""

import hashlib
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pup.errors import InputError
from pup.physics.model import compile_model
from pup.robot import RobotDescription, built_in_robots

MODEL = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="trunk">
      <freejoint/>
      <geom size="0.1"/>
      <site name="imu"/>
      <body name="left"><joint name="l"/><geom size="0.1"/></body>
      <body name="right"><joint name="r"/><geom size="0.1"/></body>
    </body>
  </worldbody>
  <equality><joint joint1="l" joint2="r" active="false"/></equality>
</mujoco>
"""

ROBOT = """
schema = 1
name = "twin"
torso = "trunk"
imu_site = "imu"
feet = ["left", "right"]
joint = [
  { name = "l", servo_id = 1, group = "leg", lower = -1, upper = 1, mirror = "r", mirror_sign = -1},
  { name = "r", servo_id = 2, group = "leg", lower = -1, upper = 1, mirror = "l", mirror_sign = -1},
]

[poses.open]
l = 0.5

[[knob]]
name = "load"
unit = "kg"
default = 0
lower = 0
upper = 2
edit = [{ field = "body_mass", element = "trunk", offset = 1.0 }]
scaling = [{ parameter = "kp/*", reference = 1.0 }]

[[parameter]]
name = "kp/*"
unit = "N m/rad"
nominal = 2
search = [1, 3]
actuators = ["pd"]

[[parameter]]
name = "kd/leg"
unit = "N m s/rad"
nominal = 0.2
search = [0.1, 0.3]
actuators = ["pd"]

[[parameter]]
name = "tau_max/leg"
unit = "N m"
nominal = 2
search = [1, 3]
actuators = ["pd"]

[[parameter]]
name = "armature"
unit = "kg m2"
nominal = 0.001
search = [0, 0.01]
actuators = ["pd"]

[gait]
period = 0.5

[gait.joints.l]
c0 = 0.1
a = [1.0, 0.0]
b = [0.0, 0.5]
"""

DARWIN = RobotDescription.load("darwin_op2")


def robot_folder(path: Path, robot: str = ROBOT, model: str = MODEL) -> Path:
    path.mkdir(exist_ok=True)
    (path / "robot.toml").write_text(robot)
    (path / "model.xml").write_text(model)
    return path


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


@pytest.mark.parametrize(
    ("setup", "words"),
    [
        ({"paylod": 0.1}, "'paylod' is no knob of robot 'darwin_op2' (knobs: payload,"),
        ({"payload": 3.0}, "payload = 3 kg is outside [0, 2]"),
        ({"payload": float("nan")}, "payload = nan kg is outside"),
    ],
)
def test_a_wrong_setup_is_refused(setup: dict[str, float], words: str) -> None:
    with pytest.raises(InputError, match=re.escape(words)):
        DARWIN.setup(setup)


def swap(old: str, new: str) -> Callable[[str], str]:
    def change(text: str) -> str:
        assert old in text
        return text.replace(old, new, 1)

    return change


WRONG_ROBOT = [
    ("schema = 1", "schema = 2", "schema: not 1"),
    ("schema = 1", "schema = ", "not a TOML document"),
    ("schema = 1", "schema = 1\ncolour = 'red'", "colour: unknown key"),
    ('name = "twin"', "", "name: missing; write a text"),
    ('name = "twin"', 'name = "a/b"', "name: 'a/b' is no name"),
    ('torso = "trunk"', 'torso = "chest"', "torso: model.xml has no body 'chest'"),
    ('torso = "trunk"', 'torso = "left"', "the free joint of model.xml belongs to body 'trunk'"),
    ('imu_site = "imu"', 'imu_site = "gyro"', "imu_site: model.xml has no site 'gyro'"),
    ('["left", "right"]', '["left", "toe"]', "feet: model.xml has no body 'toe'"),
    ('["left", "right"]', '["left", "left"]', "feet: ['left', 'left'] names something twice"),
    ('["left", "right"]', '"left"', "feet: expected a list of texts, got 'left'"),
    ('name = "r",', 'name = "q",', "joint[2].name: model.xml has no joint 'q'; it has: l, r"),
    ('name = "r",', 'name = "l",', "joint[2].name: joint 'l' stands twice"),
    ("servo_id = 2", "servo_id = 1", "joint[2].servo_id: 1 is also that of l"),
    ("servo_id = 2", "servo_id = 253", "253 is no bus address"),
    ("servo_id = 2", "servo_id = 2.5", "expected a whole number, got 2.5"),
    ("servo_id = 2", "servo = 2", "joint[2].servo: unknown key; known here: group, lower"),
    ("lower = -1", "lower = 1", "joint[1].lower: 1 is not below upper = 1"),
    ("lower = -1", "lower = nan", "joint[1].lower: expected a finite number, got nan"),
    ("lower = -1", "lower = true", "joint[1].lower: expected a finite number, got True"),
    ("lower = -1", "lower = '-1'", "joint[1].lower: expected a finite number, got '-1'"),
    ("mirror_sign = -1", "mirror_sign = 2", "mirror_sign: 2 is neither 1 nor -1"),
    ("mirror_sign = -1", "mirror_sign = 1", "l and r have different mirror_sign"),
    ('mirror = "r"', 'mirror = "l"', "joint[2].mirror: r mirrors l, which mirrors l"),
    ('mirror = "r"', 'mirror = "x"', "joint[1].mirror: there is no joint 'x'"),
    ('mirror = "r",', "", "joint[1].mirror: l has none; give all joints a mirror"),
    ('2, group = "leg"', '2, group = "arm"', "l and r are of different groups"),
    ("imu_site", "groups = ['leg', 'arm']\nimu_site", "groups: leg, arm listed, but the joints"),
    ("imu_site", "timestep = 0.5\nimu_site", "timestep: 0.5 s is outside"),
    ("l = 0.5", "l = 1.5", "poses.open.l: 1.5 is outside the joint's limits [-1, 1]"),
    ("l = 0.5", "x = 0.5", "poses.open.x: unknown key"),
    ("upper = 2\n", "upper = 0\n", "knob[1].lower: 0 is not below upper = 0"),
    ("default = 0", "default = 3", "knob[1].default: 3 is outside [0, 2]"),
    ('"body_mass"', '"body_parentid"', "knob[1].edit[1].field: 'body_parentid' cannot be edited"),
    ('"body_mass"', '"body_ipos"', "index: body_ipos has 3 components; give 0 to 2"),
    ("offset = 1.0", "index = 0", "index: body_mass is a single number; remove the index"),
    ('element = "trunk"', 'element = "belly"', "element: model.xml has no body 'belly'"),
    ('parameter = "kp/*"', 'parameter = "kq/*"', "the robot has no parameter 'kq/*'"),
    ("reference = 1.0", "reference = 0", "reference: 0 is not above 0"),
    ('"kd/leg"', '"kd/arm"', "parameter[2].name: there is no group 'arm'; groups: leg"),
    ('"kd/leg"', '"kp/leg"', "parameter: the pd actuator also needs: kd/leg"),
    ('"kd/leg"', '"kf/leg"', "parameter[2].name: unknown parameter 'kf/leg'; known: rho/<group>"),
    ('"kd/leg"', '"mass/belly"', "parameter[2].name: model.xml has no body 'belly'"),
    ('"kd/leg"', '"com/trunk/w"', "'com/trunk/w' does not end in /x, /y or /z"),
    ('"armature"', '"kd/leg"', "parameter[4].name: kd/leg stands twice; remove one"),
    ("search = [1, 3]", "search = [3, 1]", "parameter[1].search: [3, 1] is empty"),
    ("search = [1, 3]", "search = [1]", "parameter[1].search: expected 2 numbers, got 1"),
    ("nominal = 2", "nominal = 4", "parameter[1].nominal: 4 is outside search = [1, 3]"),
    ('["pd"]', '["nn_pd"]', "actuators: ['nn_pd'] given, but kp/* is for pd"),
    ('["pd"]', "[]", "actuators: [] given, but kp/* is for pd"),
    (
        "[gait]",
        "[network]\nweights = [1.0]\n[gait]",
        "network.error_scale: missing; write a finite",
    ),
    ("period = 0.5", "period = 0", "gait.period: 0 s is not above 0"),
    (
        "period = 0.5",
        'period = 0.5\nstart = "up"',
        "gait.start: there is no pose 'up'; poses: open",
    ),
    ("period = 0.5", "period = 0.5\nblend = -1", "gait.blend: -1 s is negative"),
    ("period = 0.5", "period = 0.5\ntilt_limit = 0", "gait.tilt_limit: 0 is not above 0"),
    ("period = 0.5", "period = 0.5\ndrift_limit = -1", "gait.drift_limit: -1 is not above 0"),
    (
        "period = 0.5",
        'period = 0.5\nground_bodies = ["toe"]',
        "gait.ground_bodies: model.xml has no body 'toe'",
    ),
    ("period = 0.5", "period = 0.5\nblnd = 1", "gait.blnd: unknown key; known here: blend,"),
    ("[gait.joints.l]", "[gait.joints.x]", "gait.joints.x: there is no such joint"),
    ("b = [0.0, 0.5]", "b = [0.0]", "gait.joints.l.b: 1 numbers, but a has 2"),
]


@pytest.mark.parametrize(("old", "new", "words"), WRONG_ROBOT, ids=[w[2][:40] for w in WRONG_ROBOT])
def test_a_wrong_robot_toml_is_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    refused(robot_folder(tmp_path, robot=swap(old, new)(ROBOT)), words)


WRONG_MODEL = [
    ('<joint name="r"/>', "", "joint[2].name: model.xml has no joint 'r'; it has: l"),
    ('"r"/>', '"r"/><joint name="s"/>', "joint: model.xml also has: s; list every joint"),
    ('"r"/>', '"r" type="ball"/>', "joint 'r' is of type 'ball'; only hinge and slide"),
    ('"r"/>', '"r"/><joint/>', "a joint of body 'right' has no name"),
    ('"r"/>', '"r"/><freejoint/>', "more than one free joint (trunk, right)"),
    ('name="floor" ', "", "feet: model.xml has no geom named 'floor'"),
    ("<mujoco>", "<mujoco", "model.xml: not an XML document"),
    (
        "\n<mujoco>",
        '<!DOCTYPE x [<!ENTITY a "aa"><!ENTITY b "&a;&a;">]>\n<mujoco>',
        "document types and entities are not accepted",
    ),
    ("<worldbody>", '<include file="../x.xml"/><worldbody>', "'../x.xml' lies outside the robot's"),
    ("<worldbody>", '<include file="model.xml"/><worldbody>', "includes 'model.xml' twice"),
    ("<worldbody>", '<include file="none.xml"/><worldbody>', "none.xml: cannot be read"),
    (
        "<worldbody>",
        '<asset><mesh name="m" file="/etc/passwd"/></asset><worldbody>',
        "'/etc/passwd' lies outside the robot's folder",
    ),
    (
        "<worldbody>",
        '<compiler meshdir=".."/><asset><mesh name="m" file="a.stl"/></asset><worldbody>',
        "'../a.stl' lies outside the robot's folder",
    ),
]


@pytest.mark.parametrize(("old", "new", "words"), WRONG_MODEL, ids=[w[2][:40] for w in WRONG_MODEL])
def test_a_wrong_model_is_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    refused(robot_folder(tmp_path, model=swap(old, new)(MODEL)), words)


def test_the_network_needs_27_weights_and_nn_pd_a_network(tmp_path: Path) -> None:
    folder = tmp_path / "leg"
    shutil.copytree(RobotDescription.load("darwin_leg").folder, folder)
    text = (folder / "robot.toml").read_text()
    (folder / "robot.toml").write_text(text.replace("0.019432612, ", ""))
    refused(folder, "network.weights: expected 27 numbers, got 26")
    (folder / "robot.toml").write_text(text[: text.index("[network]")])
    refused(folder, "network: missing; the nn_pd parameters need its weights")
    (folder / "robot.toml").write_text(text.replace('"sigma/*"', '"sigma/hip"'))
    refused(folder, "the nn_pd actuator also needs: sigma/knee, sigma/ankle")


def test_files_that_are_too_large_or_not_text_are_refused(tmp_path: Path) -> None:
    folder = robot_folder(tmp_path, robot=ROBOT + "#" * 2**20)
    refused(folder, "robot.toml: larger than 1048576 bytes")
    (folder / "robot.toml").write_bytes(ROBOT.encode("utf-16"))
    refused(folder, "robot.toml: not UTF-8 text")
    (folder / "robot.toml").write_text(ROBOT)
    (folder / "model.xml").write_bytes(MODEL.encode("utf-16"))
    refused(folder, "model.xml: not UTF-8 text")
    (folder / "model.xml").write_text("<a>" * 100_000)
    refused(folder, "model.xml: not an XML document")
    (folder / "robot.toml").write_text("a = " + "[" * 100_000)
    refused(folder, "robot.toml: nested too deeply")
    (folder / "robot.toml").write_text(ROBOT)
    (folder / "model.xml").unlink()
    refused(folder, "model.xml: cannot be read")


def test_the_mark_of_windows_notepad_is_no_mistake(tmp_path: Path) -> None:
    folder = robot_folder(tmp_path)
    plain = RobotDescription.load(folder)
    for file in ("robot.toml", "model.xml"):
        (folder / file).write_bytes(b"\xef\xbb\xbf" + (folder / file).read_bytes())
    assert RobotDescription.load(folder) == plain
    compile_model(plain, "ground")


def test_no_such_robot_names_the_built_in_ones(tmp_path: Path) -> None:
    refused(tmp_path / "nobody", "nobody: neither a built-in robot (darwin_leg, darwin_op2,")
    refused(tmp_path, "nor a folder with a robot.toml")


def refused(folder: Path, words: str) -> None:
    """The folder is refused in one line that contains the words."""
    with pytest.raises(InputError, match=re.escape(words)) as error:
        RobotDescription.load(folder)
    assert "\n" not in str(error.value)
    assert str(folder) in str(error.value)


def test_a_torso_that_is_not_first_in_its_world_is_refused(tmp_path: Path) -> None:
    """Its free joint would not be where everybody looks for it; what comes later does no harm."""
    left = '<body name="left"><joint name="l"/><geom size="0.1"/></body>'
    torso, end = '<body name="trunk">', "</worldbody>"
    apart = swap(left, "")(MODEL)
    before = robot_folder(tmp_path / "before", model=swap(torso, left + torso)(apart))
    with pytest.raises(InputError, match=r"'l' stands before .* torso 'trunk' first") as told:
        compile_model(RobotDescription.load(before), "ground")
    assert "\n" not in str(told.value)
    after = robot_folder(tmp_path / "after", model=swap(end, left + end)(apart))
    assert compile_model(RobotDescription.load(after), "ground").floating
