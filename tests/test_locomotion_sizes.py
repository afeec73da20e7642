"""The walking task of robots that are not the paper's: their rate, height, gait and joints."""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("gymnasium")

from biped import biped, biped_bounds
from test_walking_start import LARGE, QUADRUPED, changed
from walking import DARWIN, EXACT, walking

from pup.errors import InputError
from pup.locomotion.demonstration import FALL, HORIZON, STRAY, PatternSearch, _losses, taught
from pup.locomotion.evaluation import Walks
from pup.locomotion.pattern import TURN, Patterns, PatternSpace
from pup.locomotion.sampling import ParameterSampler
from pup.locomotion.settings import RATE, Direction, TaskSettings
from pup.locomotion.start import torso_height
from pup.locomotion.task import WalkingTask
from pup.policy.bundle import read_bundle
from pup.robot import Harmonics, RobotDescription
from services.footage import Footage
from services.training import _Job
from services.training_options import Options, task_settings
from services.walk import Shown, walk

SHIPPED = DARWIN.folder / "policies" / "forward"


def at(rate: tuple[float, float]) -> TaskSettings:
    walk = replace(DARWIN.walk, control_rate=rate)
    return TaskSettings.of(replace(DARWIN, walk=walk), Direction.FORWARD)


# --- Rates ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rate", "smoothing"), [((25, 33), 5), ((50, 50), 9), ((90, 110), 17), ((2, 4), 1)]
)
def test_actions_are_smoothed_over_the_same_time(rate: tuple[float, float], smoothing: int) -> None:
    assert at(rate).smoothing == smoothing


def job(robot: RobotDescription, out: Path) -> _Job:
    return _Job(robot, None, Options(), out, lambda *_: None, lambda *_: None)


def test_the_future_is_discounted_over_the_same_time(tmp_path: Path) -> None:
    """In a second as much, at any rate; the paper's robot's is the authors' to the bit."""
    assert job(DARWIN, tmp_path).learning.discount == 0.99
    fast = job(changed(tmp_path / "large", more=LARGE), tmp_path)
    assert fast.learning.discount**50 == pytest.approx(0.99**RATE)
    assert fast.learning.discount != 0.99


@pytest.mark.parametrize("factor", [1, 2])
def test_a_reflex_answers_to_the_same_turn_in_a_second(factor: int) -> None:
    gains = np.zeros((1, len(DARWIN.joints), 2))
    gains[:, 12, 1] = 0.5
    patterns = Patterns(np.zeros((1, len(DARWIN.joints), 5)), gains)
    task = walking(replace(EXACT, control_rate=(factor * RATE, factor * RATE)), n=1)
    seen = task.reset().proprioception.copy()
    seen[:, -3] = seen[:, -1] + TURN / 2 / factor
    assert taught(patterns, task, seen)[0, 12] == pytest.approx(5 + 0.5 / 2 * 5, abs=1e-5)


def test_a_policy_walks_and_goes_on_with_the_smoothing_it_was_trained_with(tmp_path: Path) -> None:
    """One of before, on a robot of another rate; the shipped ones have what they had."""
    robot = changed(tmp_path / "large", more=LARGE)
    card, _ = read_bundle(SHIPPED, robot)
    assert TaskSettings.of(robot, Direction.FORWARD).smoothing == 9
    assert TaskSettings.of_policy(robot, card).smoothing == card.smoothing == 5
    assert task_settings(robot, Options(start=SHIPPED)).smoothing == 5
    assert task_settings(robot, Options()).smoothing == 9
    for direction in Direction:
        card, _ = read_bundle(DARWIN.folder / "policies" / direction, DARWIN)
        assert TaskSettings.of_policy(DARWIN, card) == TaskSettings.of(DARWIN, direction)


def test_it_is_shown_with_that_smoothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    robot, seen = changed(tmp_path / "large", more=LARGE.replace("[50, 50.0]", "[25, 50]")), []

    def shown(task: WalkingTask, _: object) -> Footage:
        seen.append(task.settings.smoothing)
        raise KeyboardInterrupt

    monkeypatch.setattr(Footage, "of", shown)
    with pytest.raises(KeyboardInterrupt):
        walk(robot, Shown(SHIPPED, robot.identified_path), tmp_path, 1)
    assert seen == [5] and TaskSettings.of(robot, Direction.FORWARD).smoothing == 6


# --- Heights --------------------------------------------------------------------------------------


def search(robot: RobotDescription) -> PatternSearch:
    def none(*_: object) -> WalkingTask:
        raise AssertionError("no task is needed")

    return PatternSearch(PatternSpace(robot, Direction.FORWARD), none, 0)


def scaled(folder: Path, size: float) -> RobotDescription:
    """The quadruped in another size: all its lengths."""
    folder.mkdir()
    text = (QUADRUPED.folder / "model.xml").read_text()

    def longer(match: re.Match[str]) -> str:
        numbers = " ".join(f"{size * float(number):.6g}" for number in match[2].split())
        return f'{match[1]}="{numbers}"'

    text = re.sub(r'\b(pos|size|fromto)="([^"]*)"', longer, text)
    (folder / "model.xml").write_text(text)
    (folder / "robot.toml").write_text((QUADRUPED.folder / "robot.toml").read_text())
    return RobotDescription.load(folder)


def test_the_papers_robot_has_its_own_costs_to_the_bit() -> None:
    assert (FALL, STRAY) == (1.0, 0.3)
    assert search(DARWIN).fall == 1.0
    assert torso_height(DARWIN) == pytest.approx(0.2787, rel=1e-3)


@pytest.mark.parametrize("size", [8.0, 0.5])
def test_what_a_fall_costs_grows_with_the_robot(tmp_path: Path, size: float) -> None:
    """To fall forward by its own height does not pay; to walk thrice as far does, if it falls."""
    robot = scaled(tmp_path / "robot", size)
    height, fall = torso_height(robot), search(robot).fall
    assert height == pytest.approx(size * torso_height(QUADRUPED), rel=1e-5)
    distance, time = np.array([height, 0.0, 3 * height]), np.array([0.05, 1.0, 0.5]) * HORIZON
    nothing = np.zeros((3, 0), np.float32), np.zeros(3)
    walks = Walks(nothing[0], distance, nothing[1], time, time < HORIZON, nothing[1])
    falls, stands, walks_and_falls = _losses(walks, 1, fall)
    assert walks_and_falls < stands < falls


# --- Gaits in pairs -------------------------------------------------------------------------------


def with_gait(waves: dict[str, tuple[float, float]]) -> RobotDescription:
    """The quadruped with other first waves of its hips and knees, by the leg."""
    assert QUADRUPED.gait is not None
    joints = {}
    for name, series in QUADRUPED.gait.joints.items():
        leg, joint = name.split("_")
        size = 0.1 if joint == "hip" else -0.2
        a, b = waves[leg]
        joints[name] = Harmonics(series.c0, (size * a,), (size * b,))
    return replace(QUADRUPED, gait=replace(QUADRUPED.gait, joints=joints))


TROT = {"fl": (1, 0), "hr": (1, 0), "fr": (-1, 0), "hl": (-1, 0)}
PACE = {"fl": (1, 0), "hl": (1, 0), "fr": (-1, 0), "hr": (-1, 0)}
WALK = {"fl": (1, 0), "fr": (-1, 0), "hl": (0, 1), "hr": (0, -1)}
BOUND = {"fl": (1, 0), "fr": (1, 0), "hl": (-1, 0), "hr": (-1, 0)}
PRONK = {"fl": (1, 0), "fr": (1, 0), "hl": (1, 0), "hr": (1, 0)}
STAND = {"fl": (0, 0), "fr": (0, 0), "hl": (0, 0), "hr": (0, 0)}


@pytest.mark.parametrize(
    ("gait", "later"),
    [(TROT, 0.5), (PACE, 0.5), (WALK, 0.5), (STAND, 0.5), (BOUND, 0.0), (PRONK, 0.0)],
)
def test_a_pattern_has_the_symmetry_of_the_gait(
    gait: dict[str, tuple[float, float]], later: float
) -> None:
    robot = with_gait(gait)
    space = PatternSpace(robot, Direction.FORWARD)
    unit = np.random.default_rng(0).uniform(0.45, 0.55, (1, space.dimension))
    patterns, permutation = space.patterns(unit), robot.mirror()[0]

    def action(phase: float) -> np.ndarray:
        turn = 2 * math.pi * phase
        return patterns.bins(np.array([[math.cos(turn), math.sin(turn)]]), np.zeros((1, 2)), 11)[0]

    for phase in (0.1, 0.4):
        np.testing.assert_allclose(action(phase)[permutation], action(phase + later), atol=1e-9)


def test_legs_in_pairs_have_a_first_wave_together() -> None:
    """Half a period between them would have one do the opposite: no push of both."""
    space = PatternSpace(with_gait(PRONK), Direction.FORWARD)
    waves = space.patterns(np.ones((1, space.dimension))).waves[0]
    legs = [QUADRUPED.joint_names.index(f"{side}_knee") for side in ("hl", "hr")]
    assert waves[legs, 1].tolist() == [1.0, 1.0]


# --- Slides ---------------------------------------------------------------------------------------


def test_joints_that_slide_are_refused(tmp_path: Path) -> None:
    robot = biped(tmp_path)
    file = robot.folder / "model.xml"
    hip = '<joint name="r_hip" axis="0 1 0"'
    assert file.read_text().count(hip) == 1
    file.write_text(file.read_text().replace(hip, f'{hip} type="slide"'))
    robot = RobotDescription.load(tmp_path)
    sampler = ParameterSampler(biped_bounds(robot))
    with pytest.raises(InputError, match="'biped' cannot learn to walk: r_hip slide") as told:
        WalkingTask(robot, sampler, EXACT, 1, np.random.default_rng(0), threads=1)
    assert "\n" not in str(told.value)
