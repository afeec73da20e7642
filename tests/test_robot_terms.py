"""Terms in a robot's description, and a corrected robot written from a finding."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commandline import TINY, pup
from robots import MODEL, ROBOT, robot_folder, swap

from pup.errors import InputError
from pup.physics.mujoco_batch import MujocoSimulator
from pup.physics.parameters import robot_space
from pup.recording import load_recordings
from pup.robot import RobotDescription, TermSpec
from pup.robot_writer import write_corrected

TERM = """
[[term]]
effect = "backlash"
place = { kind = "joint", name = "l" }
values = { gap = 0.02, behind = 0.5 }

[[term]]
effect = "voltage_sag"
place = { kind = "bus" }
values = { drop = 0.9 } # beyond what is usually tried
"""


def test_terms_of_a_description_are_columns_behind_the_nominal_parameters(tmp_path: Path) -> None:
    plain = RobotDescription.load(robot_folder(tmp_path / "plain"))
    robot = RobotDescription.load(robot_folder(tmp_path / "terms", ROBOT + TERM))
    assert robot.terms == (
        TermSpec("backlash", "joint", "l", {"gap": 0.02, "behind": 0.5}),
        TermSpec("voltage_sag", "bus", "", {"drop": 0.9}),
    )
    space, before = robot_space(robot, "pd"), robot_space(plain, "pd")
    own = slice(len(before), None)
    assert space.names[: own.start] == before.names
    assert space.names[own] == (
        "backlash/gap@joint:l", "backlash/behind@joint:l", "backlash/drag@joint:l",
        "voltage_sag/drop@bus", "voltage_sag/buffer@bus",
    )  # fmt: skip
    assert space.units[own] == ("rad", "1", "N m s/rad", "1/(N m)", "s")
    assert space.nominal[own].tolist() == [0.02, 0.5, 0.001, 0.9, 0.02]
    assert space.lower[own].tolist() == [0.0, 0.0, 0.001 / 3, 0.0, 0.001]
    assert space.upper[own].tolist() == [0.06, 1.0, 0.02, 0.9, 0.2]


def test_a_value_left_out_is_the_nominal_one(tmp_path: Path) -> None:
    """A size is then zero: a term without any does nothing."""
    text = ROBOT + TERM[: TERM.index("values")]
    robot = RobotDescription.load(robot_folder(tmp_path, text))
    assert robot_space(robot, "pd").nominal[-3:].tolist() == [0.0, 1.0, 0.001]


WRONG_TERM = [
    ('effect = "backlash"', "", "term[1].effect: missing; write a text"),
    ('kind = "joint", name = "l"', 'name = "l"', "term[1].place.kind: missing"),
    ('kind = "joint"', 'kind = "limb"', "place.kind: 'limb' is none of joint, group, body,"),
    ('name = "l"', 'name = "x"', "place.name: the robot has no joint 'x'; it has: l, r"),
    ('"joint", name = "l"', '"group", name = "l"', "the robot has no group 'l'; it has: leg"),
    ('"joint", name = "l"', '"foot", name = "trunk"', "no foot 'trunk'; it has: left, right"),
    ('"joint", name = "l"', '"body", name = "l"', "place.name: model.xml has no body 'l'"),
    ('"joint", name = "l"', '"joint"', "term[1].place.name: missing"),
    ('"bus"', '"bus", name = "a"', "term[2].place.name: there is one bus; leave the name out"),
    ('name = "l"', 'name = "l", at = 1', "term[1].place.at: unknown key"),
    ("gap = 0.02", "gap = nan", "term[1].values.gap: expected a finite number, got nan"),
    ("values", "value", "term[1].value: unknown key; known here: effect, place, values"),
    (
        '"voltage_sag"\nplace = { kind = "bus" }\nvalues = { drop = 0.9 }',
        '"backlash"\nplace = { kind = "joint", name = "l" }',
        "term[2].effect: backlash stands twice at this place",
    ),
]


@pytest.mark.parametrize(("old", "new", "words"), WRONG_TERM, ids=[w[2][:40] for w in WRONG_TERM])
def test_a_wrong_term_is_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    folder = robot_folder(tmp_path, ROBOT + swap(old, new)(TERM))
    with pytest.raises(InputError, match=re.escape(words)) as error:
        RobotDescription.load(folder)
    assert str(error.value).startswith(str(folder / "robot.toml"))


UNPHYSICAL = [
    ("backlash", "slack", "term[1]: there is no effect 'slack'; known: command_delay,"),
    ("gap", "width", "term[1]: backlash has no 'width'; it has: gap, behind, drag"),
    ("0.02", "-0.02", "term[1]: gap = -0.02: backlash takes no negative gap"),
    ("voltage_sag", "payload", "term[2]: payload cannot act at bus; it acts at a body"),
]


@pytest.mark.parametrize(("old", "new", "words"), UNPHYSICAL)
def test_the_physics_refuses_what_means_nothing_to_it(
    tmp_path: Path, old: str, new: str, words: str
) -> None:
    folder = robot_folder(tmp_path, ROBOT + swap(old, new)(TERM))
    robot = RobotDescription.load(folder)
    with pytest.raises(InputError, match=re.escape(f"{folder / 'robot.toml'}: {words}")) as error:
        robot_space(robot, "pd")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("effect", "values"),
    [
        ("stribeck_friction", "torque = 0.02, rest = 0.03, speed = 0"),
        ("thermal_drift", "rate = 0.01, time = 0"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_a_speed_or_a_time_of_zero_is_the_limit_of_small_ones(
    tmp_path: Path, bench_recordings: Path, effect: str, values: str
) -> None:
    bench = RobotDescription.load("servo_bench")
    runs = load_recordings([bench_recordings], bench)
    term = f'\n[[term]]\neffect = "{effect}"\nplace = {{ kind = "joint", name = "servo" }}\n'
    positions = []
    for zero in ("0", "1e-6"):
        text = f"{term}values = {{ {values.removesuffix('0')}{zero} }}\n"
        folder = robot_folder(
            tmp_path / zero,
            (bench.folder / "robot.toml").read_text() + text,
            bench.model_path.read_text(),
        )
        robot = RobotDescription.load(folder)
        space = robot_space(robot, "pd")
        told = MujocoSimulator(robot, runs, "pd").replay(space.candidates(space.nominal[None]))
        assert not told.diverged.any()
        positions.append(told.position)
    assert np.allclose(*positions, atol=1e-4, equal_nan=True)


def test_every_verb_refuses_a_term_that_means_nothing_before_it_works(
    tmp_path: Path, bench_recordings: Path
) -> None:
    folder = robot_folder(
        tmp_path / "bench",
        (RobotDescription.load("servo_bench").folder / "robot.toml").read_text()
        + '\n[[term]]\neffect = "slack"\nplace = { kind = "bus" }\n',
        RobotDescription.load("servo_bench").model_path.read_text(),
    )
    out = tmp_path / "out"
    for command in (
        ["replay", bench_recordings],
        ["presysid", bench_recordings, *TINY],
        ["record", "step:0.1", "--virtual"],
    ):
        done = pup(*command, "--robot", folder, "--out", out)
        assert done.code == 2
        assert f"{folder / 'robot.toml'}: term[1]: there is no effect 'slack'" in done.err
        assert not out.exists()


LEG = RobotDescription.load("darwin_leg")
FOUND = (
    TermSpec("backlash", "joint", "l_knee", {"gap": 1e-5, "behind": 1.0}),
    TermSpec("coulomb_friction", "group", "ankle", {"torque": 0.1}),
    TermSpec("gain_asymmetry", "joint", "l_knee", {"share": -0.07}),
)
FITTED = {"kp/hip": 70.0, "kp/knee": 12.3, "armature": 1e-05, "phi/3": -0.25, "rho/hip": 1.0}


def test_a_corrected_robot_differs_by_its_parameters_and_terms_alone(tmp_path: Path) -> None:
    robot = write_corrected(LEG, tmp_path / "leg", FITTED, FOUND, "Found: play.\nA second line.")
    assert robot == RobotDescription.load(tmp_path / "leg")
    assert robot.terms == FOUND
    nominal = {spec.name: spec.nominal for spec in robot.parameters}
    assert nominal == {s.name: FITTED.get(s.name, s.nominal) for s in LEG.parameters}
    search = {spec.name: spec.search for spec in robot.parameters}
    assert search["kp/hip"] == (1.0, 70.0) and search["armature"] == (1e-05, 0.02)
    assert search["kp/ankle"] == (1.0, 60.0)
    assert robot.network is not None and LEG.network is not None
    assert robot.network.weights[3] == -0.25
    assert robot.actuator == "pd" != LEG.actuator, "the terms were found beside the PD"
    as_before = replace(
        robot,
        folder=LEG.folder,
        digest=LEG.digest,
        parameters=LEG.parameters,
        terms=(),
        network=LEG.network,
        actuator=LEG.actuator,
    )
    assert as_before == LEG
    text = (tmp_path / "leg" / "robot.toml").read_text()
    assert text.startswith("# Found: play.\n# A second line.\n")
    assert "# the MX-28's P register" in text, "comments of the original stay"


def test_a_corrected_robot_can_be_corrected_again(tmp_path: Path) -> None:
    once = write_corrected(LEG, tmp_path / "once", FITTED, FOUND)
    twice = write_corrected(once, tmp_path / "twice", {"kp/hip": 20.0}, FOUND[1:])
    assert twice.terms == FOUND[1:]
    nominal = {spec.name: spec.nominal for spec in twice.parameters}
    assert nominal["kp/hip"] == 20.0 and nominal["kp/knee"] == 12.3
    without = write_corrected(twice, tmp_path / "without", {}, ())
    assert without.terms == () and without.parameters == twice.parameters


@pytest.mark.parametrize("style", ["tables", "inline", "scattered"])
def test_however_the_original_is_written(tmp_path: Path, style: str) -> None:
    """Parameters as an inline list, or with another table between two of them."""
    text = ROBOT
    if style == "inline":
        at, end = text.index("[[parameter]]"), text.index("[gait]")
        rows = [part.strip().replace("\n", ", ") for part in text[at:end].split("[[parameter]]")]
        listed = ", ".join(f"{{ {row} }}" for row in rows if row)
        text = text.replace("joint = [", f"parameter = [{listed}]\njoint = [", 1)
        text = text[: text.index("[[parameter]]")] + text[text.index("[gait]") :]
    elif style == "scattered":
        at = text.index('[[parameter]]\nname = "armature"')
        text = text[:at] + text[text.index("[gait]") :] + "\n" + text[at : text.index("[gait]")]
    robot = RobotDescription.load(robot_folder(tmp_path / "robot", text + TERM))
    given = {"kp/leg": 2.5, "armature": 0.02}
    corrected = write_corrected(robot, tmp_path / "corrected", given, robot.terms[1:])
    assert corrected.terms == robot.terms[1:] and corrected.gait == robot.gait
    nominal = {spec.name: spec.nominal for spec in corrected.parameters}
    assert nominal == {"kp/leg": 2.5, "kd/leg": 0.2, "tau_max/leg": 2.0, "armature": 0.02}


def test_includes_and_meshes_come_along_and_nothing_else(tmp_path: Path) -> None:
    model = MODEL.replace(
        "<worldbody>",
        '<compiler meshdir="stl"/><include file="more/extra.xml"/>'
        '<asset><mesh name="m" file="a.stl"/></asset><worldbody>',
    )
    folder = robot_folder(tmp_path / "robot", ROBOT, model)
    for name, content in (
        ("more/extra.xml", "<mujocoinclude/>"),
        ("stl/a.stl", "mesh"),
        ("identified.json", "{}"),
        ("recordings/r.parquet", "data"),
    ):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(content)
    out = tmp_path / "corrected"
    write_corrected(RobotDescription.load(folder), out, {}, ())
    written = {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()}
    assert written == {"robot.toml", "model.xml", "more/extra.xml", "stl/a.stl"}


@pytest.mark.parametrize("name", ["kp/toe", "phi/27", "phi/x", "backlash/gap@joint:l_knee"])
def test_a_parameter_that_the_robot_lacks_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match=re.escape(f"parameter {name!r}: robot 'darwin_leg'")):
        write_corrected(LEG, tmp_path, {name: 1.0}, ())
    assert not list(tmp_path.iterdir())


def test_a_robot_is_not_written_over_itself(tmp_path: Path) -> None:
    robot = RobotDescription.load(robot_folder(tmp_path))
    with pytest.raises(InputError, match="is the folder of 'twin' itself"):
        write_corrected(robot, tmp_path, {}, ())


@pytest.mark.usefixtures("short_polish")
def test_every_verb_takes_a_corrected_robot_and_leaves_its_terms(
    tmp_path: Path, bench_recordings: Path
) -> None:
    """A replay has the terms; a fit moves the nominal parameters; a virtual robot is like it."""
    bench = RobotDescription.load("servo_bench")
    play = TermSpec("backlash", "joint", "servo", {"gap": 0.03})
    robot = write_corrected(bench, tmp_path / "bench", {"rho/servo": 1.2}, [play])
    recordings = load_recordings([bench_recordings], robot)
    simulator = MujocoSimulator(robot, recordings, "nn_pd")
    space = robot_space(robot, "nn_pd")
    off = space.at({"backlash/gap@joint:servo": 0.0})
    given, without = (simulator.replay(s.candidates()).position for s in (space, off))
    assert np.abs(given - without).max() > 1e-3

    folder = ("--robot", robot.folder)
    fitted = pup("presysid", bench_recordings, *folder, "--out", tmp_path / "p", *TINY, "--json")
    assert fitted.code == 0, fitted.err
    names = [parameter["name"] for parameter in fitted.json()["presysid"]["parameters"]]
    assert names == ["kp/servo", "kd/servo", "tau_max/servo", "armature"]
    bounds = ("--bounds", tmp_path / "p" / "bounds.json")
    done = pup("replay", bench_recordings, *folder, *bounds, "--out", tmp_path / "r")
    assert done.code == 0, done.err
    truth = tmp_path / "truth.json"
    made = pup(
        *("record", "step:0.1", "--virtual", *folder, "--out", tmp_path / "m", "--truth", truth)
    )
    assert made.code == 0, made.err
    assert '"backlash/gap@joint:servo": 0.03' in truth.read_text()
