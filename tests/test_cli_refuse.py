"""The command line: bad files end with exit code 2, one clear line and no file."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import foreign_logs
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from commandline import BOTH, TINY, files, pup, pup_process
from refusals import Cases, Made, Place, assert_refused, check

from pup.physics.parameters import robot_space
from pup.recording import KEY
from pup.robot import RobotDescription

case = Cases()

# --- Files that are no recordings -----------------------------------------------------------------


def contents(place: Place) -> dict[str, bytes]:
    good = (place.bench / "step_0.1.parquet").read_bytes()
    return {
        "truncated": good[: len(good) // 2],
        "without its last byte": good[:-1],
        "without its middle": good[:200] + good[-2000:],
        "of zero bytes": b"",
        "a text": b"time,target\n0,1\n",
    }


NO_PARQUET = (
    *("truncated", "without its last byte", "without its middle", "of zero bytes", "a text"),
)
for _kind in NO_PARQUET:

    @case(f"a Parquet file {_kind}")
    def _(place: Place, kind: str = _kind) -> Made:
        bad = place.write("bad.parquet", contents(place)[kind])
        return place.replay(place.bench, bad), (bad, "not a readable Parquet file")


Edit = Callable[[dict[str, Any], dict[str, Any]], object]
"""Changes columns (lists) and metadata."""


def edited(place: Place, edit: Edit, recording: Path | None = None) -> Path:
    """The bench's first recording, or another, with a change."""
    table = pq.read_table(recording or place.bench / "step_0.1.parquet")
    columns, told = table.to_pydict(), json.loads(table.schema.metadata[KEY])
    edit(columns, told)
    arrays = {name: pa.array(values, pa.float64()) for name, values in columns.items()}
    new = pa.table(arrays).replace_schema_metadata({KEY: json.dumps(told)} if told else {})
    path = place.here / "bad.parquet"
    pq.write_table(new, path)
    return path


def at(name: str, row: int, value: float) -> Edit:
    return lambda columns, told: columns[name].__setitem__(row, value)


def renamed(old: str, new: str) -> Edit:
    def edit(columns: dict[str, Any], told: dict[str, Any]) -> None:
        for kind in ("target", "position"):
            columns[f"{kind}/{new}"] = columns.pop(f"{kind}/{old}")

    return edit


BROKEN: dict[str, tuple[Edit, tuple[str, ...]]] = {
    "no rows": (lambda c, t: [v.clear() for v in c.values()], ("no sample",)),
    "unsorted time": (at("time", 5, 0.0), ("'time', row 5", "must increase")),
    "the same time twice": (
        lambda c, t: c["time"].__setitem__(5, c["time"][4]),
        ("'time', row 5", "repeats"),
    ),
    "NaN in a column": (
        at("position/servo", 3, float("nan")),
        ("'position/servo', row 3", "must be null"),
    ),
    "infinity in a column": (at("target/servo", 2, float("inf")), ("'target/servo', row 2",)),
    "an unknown joint": (renamed("servo", "elbow"), ("elbow", "servo")),
    "another schema version": (
        lambda c, t: t.update(schema=2),
        ("'schema' is 2", "reads schema 1"),
    ),
    "no metadata": (lambda c, t: t.clear(), ("no metadata", "pup import")),
    "a knob that the robot lacks": (
        lambda c, t: t["setup"].update(flavour=1.0),
        ("'flavour' is no knob", "mass"),
    ),
    "a knob outside its limits": (
        lambda c, t: t["setup"].update(mass=50.0),
        ("mass = 50 kg", "outside [0.001, 2]"),
    ),
    "ground under a fixed base": (
        lambda c, t: t.update(support="ground"),
        ("'ground'", "fixed", "'bench'"),
    ),
}
for _name in BROKEN:

    @case(f"a recording with {_name}")
    def _(place: Place, name: str = _name) -> Made:
        edit, words = BROKEN[name]
        bad = edited(place, edit)
        return place.replay(bad), (bad, *words)


@case("a recording of three rows, which tell nothing of a motion")
def _(place: Place) -> Made:
    short = edited(place, lambda columns, _: columns.update({n: v[:3] for n, v in columns.items()}))
    command = ["presysid", short, "--robot", "servo_bench", "--out", place.out, *TINY]
    return command, ("positions in more than 2 rows", "record longer")


@case("a recording without one of the joints")
def _(place: Place) -> Made:
    table = pq.read_table(place.leg / "step_0.1.parquet").drop_columns(
        ["target/l_knee", "position/l_knee"]
    )
    bad = place.here / "bad.parquet"
    pq.write_table(table, bad)
    return place.replay(bad, robot="darwin_leg"), (bad, "l_knee not recorded")


@case("a recording on the bench of a robot with a free base")
def _(place: Place) -> Made:
    shipped = RobotDescription.load("darwin_op2").folder / "recordings" / "step_0.1_0.parquet"
    bad = edited(place, lambda columns, told: told.update(support="bench"), shipped)
    return place.replay(bad, robot="darwin_op2"), (bad, "'bench'", "free", "'suspended'")


@case("recordings of another robot")
def _(place: Place) -> Made:
    words = (place.leg / "step_0.1.parquet", "'darwin_leg'", "l_knee", "'servo_bench'")
    return place.replay(place.leg), words


@case("a recording that unpacks to more than any recording has")
def _(place: Place) -> Made:
    bomb = place.here / "bomb.parquet"
    zeros = pa.array(np.zeros(2_000_000))
    part = pa.table({name: zeros for name in ("time", "target/servo", "position/servo")})
    schema = pq.read_schema(place.bench / "step_0.1.parquet")
    part = part.replace_schema_metadata({KEY: schema.metadata[KEY]})
    with pq.ParquetWriter(bomb, part.schema, compression="zstd") as writer:
        for _ in range(4):
            writer.write_table(part)
    assert bomb.stat().st_size < 200_000
    return place.replay(bomb), (bomb, "8000000 rows", "at most")


@case("one id in two files")
def _(place: Place) -> Made:
    copy = shutil.copy(place.bench / "step_0.1.parquet", place.here / "copy.parquet")
    return place.replay(place.bench, copy), (copy, "'step_0.1'", "its own")


@case("a folder without recordings")
def _(place: Place) -> Made:
    empty = place.here / "empty"
    empty.mkdir()
    return ["run", "--recordings", empty, "--out", place.out, *TINY], (empty, "pup import")


@case("a folder whose recordings are deeper")
def _(place: Place) -> Made:
    shutil.copytree(place.bench, inner := place.here / "outer" / "a" / "inner")
    return place.replay(place.here / "outer"), (f"but in {inner}",)


@case("a folder with recordings in a folder of its own too")
def _(place: Place) -> Made:
    for copy in ("outer", "outer/inner"):  # as `cp` does the second time
        shutil.copytree(place.bench, place.here / copy)
    return place.replay(place.here / "outer"), (place.here / "outer", "inner in it")


@case("a folder that is not there")
def _(place: Place) -> Made:
    return place.replay(place.here / "nowhere"), (place.here / "nowhere", "No such file")


# --- Robots ---------------------------------------------------------------------------------------


def robot_with(place: Place, file: str, old: str, new: str) -> Path:
    """A copy of `darwin_leg` with a change in one of its files."""
    folder = place.here / "robot"
    shutil.copytree(RobotDescription.load("darwin_leg").folder, folder)
    text = (folder / file).read_text()
    assert old in text
    (folder / file).write_text(text.replace(old, new))
    return folder


MIRRORED = 'lower = -0.380901, upper = 0.233455, mirror = "l_hip_roll"'
ROBOTS = {
    "an MJCF that MuJoCo refuses": (
        *("model.xml", '<geom name="l_foot"', '<geom name="l_foot" rgba="red"'),
        ("model.xml", "MuJoCo refuses it"),
    ),
    "an MJCF with an impossible body": (
        *("model.xml", 'mass="0.0794462"', 'mass="-1"'),
        ("model.xml", "MuJoCo refuses it", "mass"),
    ),
    "an XML entity": (
        *("model.xml", "<mujoco model", '<!DOCTYPE m [<!ENTITY a "aaa">]><mujoco model'),
        ("model.xml", "entities are not accepted"),
    ),
    "a torn MJCF": ("model.xml", "</mujoco>", "", ("model.xml", "not an XML document")),
    "a file from outside its folder": (
        *("model.xml", "<worldbody>", '<include file="../../x.xml"/><worldbody>'),
        ("../../x.xml", "outside the robot's folder"),
    ),
    "a mirror map that is no involution": (
        *("robot.toml", "lower = -0.380901, upper = 0.233455", MIRRORED),
        ("robot.toml", "joint[1].mirror", "l_hip_roll", "pair them"),
    ),
    "a joint that the MJCF lacks": (
        *("robot.toml", 'name = "l_knee"', 'name = "knee"'),
        ("robot.toml", "joint[4].name", "'knee'", "l_knee"),
    ),
    "an unknown key": (
        *("robot.toml", "schema = 1", "schema = 1\ncolour = 'red'"),
        ("robot.toml", "colour", "unknown key"),
    ),
    "broken TOML": ("robot.toml", "schema = 1", "schema = ", ("robot.toml", "not a TOML document")),
}
for _name in ROBOTS:

    @case(f"a robot with {_name}")
    def _(place: Place, name: str = _name) -> Made:
        file, old, new, words = ROBOTS[name]
        robot = robot_with(place, file, old, new)
        return place.replay(place.leg, robot=robot), (robot, *words)


@case("a robot folder without robot.toml")
def _(place: Place) -> Made:
    (place.here / "robot").mkdir()
    words = (place.here / "robot", "folder with a robot.toml", "darwin_op2")
    return place.replay(place.leg, robot=place.here / "robot"), words


@case("a robot without recordings and none given")
def _(place: Place) -> Made:
    command = ["run", "--robot", "darwin_leg", "--out", place.out, *TINY]
    return command, ("darwin_leg", "--recordings DIR")


@case("a torque law that the robot lacks")
def _(place: Place) -> Made:
    assert pup("import", "emps", foreign_logs.write_emps(place.here / "x.mat"), "--out", place.here)
    command = ["presysid", place.here / "x.parquet", "--robot", "emps", "--out", place.out]
    return [*command, *BOTH, "--actuator", "nn_pd"], ("'emps'", "nn_pd")


# --- Bounds ---------------------------------------------------------------------------------------


def bounds(**changes: Any) -> dict[str, Any]:
    space = robot_space(RobotDescription.load("servo_bench"), "pd")
    named = zip(space.names, space.nominal, strict=True)
    return {
        "schema": 1,
        "robot": "servo_bench",
        "parameters": [{"name": name, "nominal": float(value)} for name, value in named],
        "actuator": {"kind": "pd", "weights": []},
    } | changes


def parameter(name: str, value: Any) -> list[dict[str, Any]]:
    others = [known for known in bounds()["parameters"] if known["name"] != name]
    return [*others, {"name": name, "nominal": value}]


BOUNDS: dict[str, tuple[str, tuple[str, ...]]] = {
    "of another robot": (json.dumps(bounds(robot="darwin_leg")), ("'darwin_leg'", "'servo_bench'")),
    "cut off": (json.dumps(bounds())[:-40], ("not a JSON document",)),
    "that is empty": ("", ("not a JSON document",)),
    "that is a list": ("[]", ("not a bounds file",)),
    "without parameters": (json.dumps({"schema": 1, "robot": "servo_bench"}), ("'actuator'",)),
    "of another schema": (json.dumps(bounds(schema=2)), ("schema 2",)),
    "with NaN": (
        json.dumps(bounds(parameters=parameter("armature", float("nan")))),
        ("'armature' is nan", "finite"),
    ),
    "with infinity": (
        json.dumps(bounds(parameters=parameter("armature", 1))).replace(
            'nominal": 1}', 'nominal": 1e999}'
        ),
        ("'armature' is inf", "finite"),
    ),
    "with a number beyond all bounds": (
        json.dumps(bounds(parameters=parameter("armature", 10**400))),
        ("not a bounds file",),
    ),
    "with a text for a number": (
        json.dumps(bounds(parameters=parameter("armature", "big"))),
        ("not a bounds file", "big"),
    ),
    "with an unknown parameter": (
        json.dumps(bounds(parameters=parameter("rho/tail", 1.0))),
        ("'rho/tail'",),
    ),
    "with an unknown actuator": (
        json.dumps(bounds(actuator={"kind": "steam", "weights": []})),
        ("steam",),
    ),
    "without weights": (
        json.dumps(bounds(actuator={"kind": "pd", "weights": None})),
        ("not a bounds file",),
    ),
    "with too few weights": (
        json.dumps(bounds(parameters=[], actuator={"kind": "nn_pd", "weights": [1.0] * 26})),
        ("26 network weights", "27"),
    ),
}
for _name in BOUNDS:

    @case(f"a bounds file {_name}")
    def _(place: Place, name: str = _name) -> Made:
        text, words = BOUNDS[name]
        file = place.write("bounds.json", text)
        return [*place.replay(place.bench), "--bounds", file], (file, *words)


@case("a bounds file that is not there")
def _(place: Place) -> Made:
    file = place.here / "bounds.json"
    return [*place.replay(place.bench), "--bounds", file], (file, "cannot be read")


# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", case)
def test_refuses(place: Place, name: str) -> None:
    check(place, case[name](place))


LIBRARIES = ("a Parquet file truncated", "a robot with an MJCF that MuJoCo refuses")
"""Refused by libraries that could print on their own, past Python."""


@pytest.mark.parametrize("name", LIBRARIES)
def test_refuses_in_a_process_of_its_own(place: Place, name: str) -> None:
    command, words = case[name](place)
    before = files(place.here)
    assert_refused(pup_process(*command), *words)
    assert files(place.here) == before
