"""Robot folders: what is refused, and with which words."""

import re
import shutil
from pathlib import Path

import pytest
from robots import MODEL, ROBOT, robot_folder, swap

from pup.errors import InputError
from pup.physics.model import compile_model
from pup.robot import RobotDescription

DARWIN = RobotDescription.load("darwin_op2")


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
    ("offset = 1.0", "offset = -1.0", "body_mass of trunk would be -1 at load = 0; it cannot be"),
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


@pytest.mark.parametrize(
    ("key", "kind", "words"),
    [
        ('imu_site = "imu"\n', "sensor", "term[1].place.kind: the robot has no IMU (imu_site)"),
        ('feet = ["left", "right"]\n', "ground", "term[1].place.kind: the robot has no feet"),
    ],
)
def test_a_term_of_what_a_robot_has_not_is_refused(
    tmp_path: Path, key: str, kind: str, words: str
) -> None:
    term = (
        f'[[term]]\neffect = "imu_delay"\nplace = {{ kind = "{kind}" }}\nvalues = {{ time = 0.01 }}'
    )
    walk = ROBOT.partition("[gait]")[0]
    refused(robot_folder(tmp_path, robot=swap(key, "")(walk) + term), words)


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
    (
        "<worldbody>",
        '<asset><model name="m" file="arm.xml"/></asset><worldbody>',
        "attaches 'arm.xml', which is not read; `pup describe`",
    ),
]


@pytest.mark.parametrize(("old", "new", "words"), WRONG_MODEL, ids=[w[2][:40] for w in WRONG_MODEL])
def test_a_wrong_model_is_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    refused(robot_folder(tmp_path, model=swap(old, new)(MODEL)), words)


RIGHT = '<body name="right"><joint name="r"/>'
LEGS = '<replicate count="2"><body><joint name="r"/><geom size="0.1"/></body></replicate>'
CLOTH = '<flexcomp name="f" type="grid" count="2 2 1" dim="2" spacing="1 1 1" mass="1"/>'
TIP = '<body name="tip"><inertial mass="{}" pos="0 {} 0" diaginertia="1 1 1"/></body>'
MADE_OTHERWISE = [
    (RIGHT, '<body name="right">' + LEGS, "robot.toml, as MuJoCo reads them: r, r0, r1;"),
    ("<worldbody>", "<worldbody>" + CLOTH, "as MuJoCo reads them: one without a name;"),
    (RIGHT, RIGHT + TIP.format("nan", 0), "body 'tip' has a mass, an inertia or a place that"),
    (RIGHT, RIGHT + TIP.format(1, "inf"), "a place that is no finite number"),
]


@pytest.mark.filterwarnings("ignore:flex")
@pytest.mark.parametrize(
    ("old", "new", "words"), MADE_OTHERWISE, ids=[w[2] for w in MADE_OTHERWISE]
)
def test_what_mujoco_makes_otherwise_than_the_files_say_is_refused(
    tmp_path: Path, old: str, new: str, words: str
) -> None:
    """Joints that no servo would drive, and bodies with which every replay would break down."""
    folder = robot_folder(tmp_path, model=swap(old, new)(MODEL))
    with pytest.raises(InputError, match=re.escape(words)) as error:
        compile_model(RobotDescription.load(folder), "ground")
    assert str(folder) in str(error.value) and "\n" not in str(error.value)


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


def test_no_such_robot_names_the_built_in_ones(tmp_path: Path) -> None:
    refused(tmp_path / "nobody", "nobody: neither a built-in robot (darwin_leg, darwin_op2,")
    refused(tmp_path, "nor a folder with a robot.toml")


def test_a_folder_that_mujoco_cannot_be_told_is_refused(tmp_path: Path) -> None:
    """From a memory stick, say, on which names are in another encoding."""
    folder = robot_folder(tmp_path / "arm_\udcfc")
    refused(folder, "its name, or that of a folder above, is not UTF-8")


def test_a_folder_called_as_a_built_in_robot_is_not_passed_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of `--robot emps` beside a folder `emps` nobody could tell which robot was meant."""
    robot_folder(tmp_path / "emps")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"a built-in robot, and a folder here; write \./"):
        RobotDescription.load("emps")
    assert RobotDescription.load("./emps").folder == tmp_path / "emps"
    (tmp_path / "emps" / "robot.toml").unlink()  # a folder of logs, say
    assert RobotDescription.load("emps").name == "emps"


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
