"""Scripts as files: what is written is read again, and nothing that no robot could play."""

import json
import shutil
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pup.errors import InputError
from pup.robot import RobotDescription
from pup.script import LIMIT, Script
from pup.sysid.clearance import Clearance
from pup.sysid.excitation import script
from pup.sysid.scripts import scripts

OP2 = RobotDescription.load("darwin_op2")
ARM = RobotDescription.load("so101")
QUADRUPED = RobotDescription.load(Path(__file__).parents[1] / "examples" / "quadruped")


def small(**changes: object) -> dict[str, object]:
    told: dict[str, object] = {"schema": 1, "id": "a", "robot": "arm", "motion": "step"}
    told |= {"support": "bench", "joints": ["one", "two"], "way": [[0, 0], [0.1, 0]]}
    told |= {"time": [0, 0.5], "target": [[0.1, 0], [0.2, 0]], "back": [[0, 0]]}
    return told | changes


def read(folder: Path, told: object) -> Script:
    file = folder / "script.json"
    file.write_text(json.dumps(told))
    return Script.read(file)


def test_a_target_holds_until_the_next(tmp_path: Path) -> None:
    made = read(tmp_path, small())
    assert [made.at(t)[0] for t in (-1.0, 0.0, 0.499, 0.5, 9.0)] == [0.1, 0.1, 0.1, 0.2, 0.2]
    assert made.duration == 0.5 and not made.falls
    assert read(tmp_path, small(back=[])).falls


@given(st.integers(0, 2**32 - 1), st.integers(2, 40), st.integers(1, 6))
def test_what_is_written_is_read_again(
    tmp_path_factory: pytest.TempPathFactory, seed: int, ticks: int, joints: int
) -> None:
    rng = np.random.default_rng(seed)
    time = np.append(0.0, np.cumsum(rng.uniform(1e-3, 0.1, ticks - 1)))
    poses = [rng.standard_normal((n, joints)) for n in (1, ticks, rng.integers(0, 3))]
    names = tuple(f"j{i}" for i in range(joints))
    made = Script("a b", "mine", "step", "bench", names, poses[0], time, poses[1], poses[2])
    file = tmp_path_factory.mktemp("script") / "a.json"
    made.write(file)
    again = Script.read(file)
    assert again.document() == made.document() and again.name == made.name
    other = Script("a b", "mine", "step", "bench", names, poses[0], time, -poses[1], poses[2])
    assert other.name != made.name


WRONG: dict[str, tuple[object, str]] = {
    "a list": ([], "is no script of schema 1"),
    "a later schema": (small(schema=2), "is no script of schema 1"),
    "an id that leads out of its folder": (small(id="../a"), "slash"),
    "no robot": (small(robot=""), "'robot'"),
    "an unknown support": (small(support="flying"), "use suspended, ground, bench"),
    "joints by number": (small(joints=[1, 2]), "'joints'"),
    "times that do not begin at 0": (small(time=[1, 2]), "'time'"),
    "times that stand still": (small(time=[0, 0]), "'time'"),
    "an hour": (small(time=[0, 3600]), "60 s at most"),
    "a long name": (small(id="a" * 81), "80 are the most"),
    "no target for a tick": (small(target=[[0, 0]]), "as many rows"),
    "a target that is no number": (small(target=[[0, 0], [0, "x"]]), "'target' holds no rows"),
    "a target that is infinite": (small(target=[[0, 0], [0, float("inf")]]), "finite"),
    "rows of different lengths": (small(target=[[0, 0], [0]]), "'target' holds no rows"),
    "a joint too many": (small(target=[[0, 0, 0]] * 2), "rows of 3 numbers for 2 joints"),
    "no pose to begin with": (small(way=[]), "'way' has no pose"),
    "a long way": (small(way=[[0, 0]] * 17), "more than 16"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_no_robot_can_play_is_refused(tmp_path: Path, name: str) -> None:
    told, words = WRONG[name]
    with pytest.raises(InputError, match=r"script\.json: ") as caught:
        read(tmp_path, told)
    assert words in str(caught.value)


def test_a_file_that_is_large_or_no_json_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "script.json"
    file.write_bytes(b"[" * 1000)
    with pytest.raises(InputError, match="not a JSON document"):
        Script.read(file)
    with file.open("wb") as large:
        large.truncate(LIMIT + 1)
    with pytest.raises(InputError, match="larger than"):
        Script.read(file)


@pytest.mark.parametrize(
    ("robot", "seed", "anew"),
    [
        (OP2, 3, []),
        (ARM, 3, []),
        # Straight ways, and those by a named pose, take a leg up to 10 mm into another.
        (QUADRUPED, 5, ["step_0.3"]),
        (QUADRUPED, 28, ["step_0.3"]),
    ],
    ids=lambda value: getattr(value, "name", None),
)
def test_ways_lead_from_home_to_the_first_target_and_back(
    robot: RobotDescription, seed: int, anew: list[str]
) -> None:
    """By motions as they were drawn, but for those that no free way leads to."""
    kinds = ("step:0.3", "hold", *(("standup:2", "fall:left") if robot.floating else ()))
    made = scripts(robot, kinds, np.random.default_rng(seed))
    plain = script(robot, kinds, np.random.default_rng(seed))
    clearance = Clearance(robot)
    assert [one.id for one in made] == [motion.id for motion in plain]
    other = [
        m.id for o, m in zip(made, plain, strict=True) if not np.array_equal(o.target, m.target)
    ]
    assert other == anew
    for one in made:
        assert len(json.dumps(one.document())) < LIMIT
        np.testing.assert_array_equal(one.way[-1], one.target[0])
        np.testing.assert_array_equal(one.way[0], made[0].way[0])
        assert one.falls == (one.motion == "fall")
        legs = [one.way] if one.falls else [one.way, np.array([one.target[-1], *one.back])]
        for poses in legs:
            for begin, end in pairwise(poses):
                assert clearance.path_free(begin, end), one.id
        if not one.falls:
            np.testing.assert_array_equal(one.back[-1], one.way[0])


def test_a_robot_without_a_free_way_is_refused(tmp_path: Path) -> None:
    """As it waits in a pose in which a front leg stands in a hind one."""
    folder = shutil.copytree(QUADRUPED.folder, tmp_path / "crossed")
    home = dict.fromkeys(QUADRUPED.joint_names, -0.1) | {"fl_hip": 1.4, "hl_hip": -1.0}
    lines = "".join(f"{name} = {angle}\n" for name, angle in home.items())
    with (folder / "robot.toml").open("a") as file:
        file.write(f"[poses.home]\n{lines}")
    with pytest.raises(InputError, match=r"step_0\.1 and back; add a pose .* \[poses\]"):
        scripts(RobotDescription.load(folder), ("step:0.1",), np.random.default_rng(0))
