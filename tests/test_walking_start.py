"""What a robot of another size sets of the walking task, and starts that teach nothing."""

import math
import shutil
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from walking import BOUNDS, DARWIN, EXACT, walking

from pup.errors import InputError
from pup.locomotion.sampling import ParameterSampler
from pup.locomotion.settings import Direction, TaskSettings
from pup.locomotion.standing import check_start
from pup.physics.model import compile_model
from pup.physics.parameters import robot_space
from pup.robot import RobotDescription, Walk
from pup.robot_writer import write_corrected
from pup.sysid.result import FittedBounds

ROOT = Path(__file__).parents[1]
QUADRUPED = RobotDescription.load(ROOT / "examples" / "quadruped")
LARGE = """
[walk]
control_rate = [50, 50.0]
substeps = 6
effort = 1e-5
work = 2e-4
"""
SITE = '<site name="imu" pos="0 0 -0.068"/>'


def changed(
    folder: Path, lines: dict[str, str] | None = None, more: str = "", file: str = "robot.toml"
) -> RobotDescription:
    """The OP2 with other lines in one of its files, and more behind them."""
    shutil.copytree(DARWIN.folder, folder, ignore=shutil.ignore_patterns("recordings", "policies"))
    text = (folder / file).read_text()
    for old, new in (lines or {}).items():
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    (folder / file).write_text(text + more)
    return RobotDescription.load(folder)


def starts(robot: RobotDescription, settings: TaskSettings | None = None) -> None:
    """Check the start of an OP2 with its fitted parameters."""
    settings = settings or TaskSettings.of(robot, Direction.FORWARD)
    check_start(robot, ParameterSampler.nominal(BOUNDS), settings)


@pytest.mark.parametrize("direction", Direction)
def test_a_robot_that_says_nothing_walks_as_the_papers(direction: Direction) -> None:
    """To the letter: checkpoints hold a digest of how the settings are written."""
    plain = TaskSettings(direction=direction)
    assert repr(TaskSettings.of(DARWIN, direction)) == repr(plain)
    assert DARWIN.walk == Walk()
    assert (plain.control_rate, plain.substeps) == ((25.0, 33.0), 8)
    assert (plain.torque_weight, plain.work_weight) == (0.01, 0.005)


def test_a_robot_of_another_size_sets_rate_sub_steps_and_costs(tmp_path: Path) -> None:
    robot = changed(tmp_path / "large", more=LARGE)
    assert robot.walk == Walk(control_rate=(50.0, 50.0), substeps=6, effort=1e-5, work=2e-4)
    settings = TaskSettings.of(robot, Direction.BACKWARD)
    assert settings == replace(
        TaskSettings(direction=Direction.BACKWARD),
        control_rate=(50.0, 50.0), substeps=6, torque_weight=1e-5, work_weight=2e-4, smoothing=9,
    )  # fmt: skip
    task = walking(settings.without_noise(), robot=robot)
    task.reset()
    assert task.step(np.full((4, 20), 5)).time == pytest.approx([0.02] * 4)
    assert robot.digest != DARWIN.digest  # a training does not go on with other numbers


def test_the_page_knows_every_number() -> None:
    page = (ROOT / "docs" / "robots.md").read_text()
    for number in fields(Walk):
        assert f"\n| `{number.name}` |" in page


def test_a_corrected_robot_keeps_its_numbers(tmp_path: Path) -> None:
    robot = changed(tmp_path / "large", more=LARGE)
    assert write_corrected(robot, tmp_path / "corrected", {}, robot.terms).walk == robot.walk


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("control_rate = [50, 25]", "walk.control_rate: [50, 25] Hz; write [slowest, fastest]"),
        ("control_rate = [0, 25]", "walk.control_rate: [0, 25] Hz; write [slowest, fastest]"),
        ("control_rate = 50", "walk.control_rate: expected a list of finite numbers, got 50"),
        ("control_rate = [5, 50]", "walk.substeps: 8 a control step take 0.025 s each, outside"),
        ("substeps = 5000", "walk.substeps: 5000 a control step take 8e-06 s each, outside"),
        ("substeps = 0", "walk.substeps: 0 is less than 1"),
        ("substeps = 4.5", "walk.substeps: expected a whole number, got 4.5"),
        ("effort = -1", "walk.effort: -1 is negative"),
        ("work = -1", "walk.work: -1 is negative"),
        ("alive = 9", "walk.alive: unknown key; known here: control_rate, effort, substeps, work"),
    ],
)
def test_wrong_numbers_are_refused(tmp_path: Path, line: str, words: str) -> None:
    with pytest.raises(InputError) as refused:
        changed(tmp_path / "robot", more=f"\n[walk]\n{line}\n")
    assert words in str(refused.value) and "\n" not in str(refused.value)


def test_robots_that_can_walk_stand_at_the_start() -> None:
    for direction in Direction:
        starts(DARWIN, TaskSettings.of(DARWIN, direction))
    space = robot_space(QUADRUPED, "pd")
    bounds = FittedBounds("pd", space, ("kp/knee",), np.array([8.0]), np.array([10.0]))
    settings = TaskSettings.of(QUADRUPED, Direction.FORWARD)
    check_start(QUADRUPED, ParameterSampler.nominal(bounds), settings)


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        (
            "robot.toml",
            "start_pitch = 0.16",
            "start_pitch = -1.2",
            "0.03 s into an episode: the torso leans by more than gait.tilt_limit = 1 rad",
        ),
        (
            "robot.toml",
            '  "l_ank_roll_link", "r_ank_roll_link", "l_ank_pitch_link"',
            '  "l_ank_roll_link", "l_ank_pitch_link"',
            "0.03 s into an episode: geom 'r_foot' of body 'r_ank_roll_link' touches the floor, "
            "which gait.ground_bodies does not name",
        ),
        (
            "model.xml",
            '<geom name="l_foot" class="shell" size="0.05235 0.033 0.007"',
            '<geom name="l_foot" class="shell" size="0.05235 0.07 0.007"',
            "geom 'l_foot' of body 'l_ank_roll_link' touches geom 'r_foot' of body "
            "'r_ank_roll_link'; part them, or <exclude> their bodies in model.xml",
        ),
        (
            "robot.toml",
            "drift_limit = 0.3",
            "drift_limit = 1e-6",
            "the torso is off its height by gait.drift_limit = 1e-06 m",
        ),
    ],
)
def test_a_start_that_counts_as_fallen_says_why(
    tmp_path: Path, file: str, old: str, new: str, words: str
) -> None:
    robot = changed(tmp_path / "robot", {old: new}, file=file)
    with pytest.raises(InputError) as refused:
        starts(robot)
    assert words in str(refused.value) and "\n" not in str(refused.value)
    assert "without any action the robot counts as fallen" in str(refused.value)


def test_standing_must_pay(tmp_path: Path) -> None:
    """What is refused does cost more: an untrained robot's first steps are punished."""
    robot = changed(tmp_path / "robot", more="\n[walk]\neffort = 1.0\n")
    with pytest.raises(
        InputError, match=r"it pays to fall; set walk\.effort far below 0\.8"
    ) as told:
        starts(robot)
    assert "\n" not in str(told.value)
    settings = replace(TaskSettings.of(robot, Direction.FORWARD), horizon=0.3).without_noise()
    task = walking(settings, n=1)
    task.reset()
    rewards = [float(task.step(np.full((1, 20), 5)).reward[0]) for _ in range(math.ceil(0.3 * 29))]
    assert sum(rewards) < 0 < sum(settings.alive for _ in rewards)


def test_the_last_motion_tells_what_ended_an_episode() -> None:
    task = walking(EXACT, n=3)
    task.reset()
    ended = task.step(np.full((3, 20), 5)).terminated
    np.testing.assert_array_equal(task.falls.any(), ended)
    assert not ended.any() and task.motion.torque.shape == (3, 20)


@pytest.mark.parametrize(("turn", "fine"), [("0 0 0.3", True), ("0 0 1.5708", False)])
def test_an_imu_turned_as_its_chip_is_refused(tmp_path: Path, turn: str, fine: bool) -> None:
    """A quarter of a turn takes roll for pitch; 17 degrees are what a mounting is off by."""
    site = SITE.replace("/>", f' euler="{turn}"/>')
    robot = changed(tmp_path / "robot", {SITE: site}, file="model.xml")
    compile_model(replace(robot, gait=None), "ground")  # nothing learns to walk on it
    if fine:
        compile_model(robot, "ground")
        return
    with pytest.raises(InputError, match="site 'imu' is turned by 90 degrees") as refused:
        compile_model(robot, "ground")
    assert "\n" not in str(refused.value)
