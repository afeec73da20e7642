"""A robot of four legs in TOML and MJCF alone: `examples/quadruped`, the tutorial of the docs."""

import json
import shlex
import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest
from commandline import pup
from scipy.spatial.transform import Rotation
from test_docs_robot import blocks

from hardware_agent.virtual import skeleton
from pup.locomotion.sampling import ParameterSampler
from pup.locomotion.settings import TaskSettings
from pup.locomotion.task import WalkingTask
from pup.physics.model import compile_model, standing_qpos
from pup.physics.parameters import robot_space
from pup.recording import load_recordings
from pup.robot import RobotDescription
from pup.robot_stance import floor_normal
from pup.sysid.excitation import script
from pup.sysid.lean import falling_pose
from pup.sysid.result import FittedBounds
from pup.sysid.virtual import SensorNoise, record_virtual

EXAMPLES = Path(__file__).parents[1] / "examples"
QUADRUPED = EXAMPLES / "quadruped"
ROBOT = RobotDescription.load(QUADRUPED)
EXACT = SensorNoise(0.0, 0.0, 0.0, 0.0)


def test_it_is_its_own_mirror_image() -> None:
    permutation, sign = ROBOT.mirror()
    stand = np.array(ROBOT.poses["stand"])
    np.testing.assert_array_equal(sign * stand[permutation], stand)
    assert ROBOT.gait is not None
    phase = np.linspace(0, 1, 20)
    later = ROBOT.gait.angles(phase + 0.5)
    np.testing.assert_allclose(sign * ROBOT.gait.angles(phase)[:, permutation], later)


@pytest.mark.parametrize("pose", ["stand", "squat"])
def test_it_is_put_down_level_on_all_feet(pose: str) -> None:
    """Its shanks lean, so no foot has an upward axis; where the feet are tells it."""
    angles = np.array(ROBOT.poses[pose])
    model = compile_model(ROBOT, "ground")
    free = np.full(4, np.nan)
    for qpos in (
        standing_qpos(ROBOT, model, angles, free),
        skeleton.standing(ROBOT, model.compiled, angles),
    ):
        np.testing.assert_allclose(np.abs(qpos[3:7]), [1, 0, 0, 0], atol=1e-9)
        data = mujoco.MjData(model.compiled)
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model.compiled, data)
        heights = [data.body(foot).xpos[2] for foot in ROBOT.feet]
        np.testing.assert_allclose(heights, 0.013, atol=0.02)
        assert np.ptp(heights) < 1e-9


def test_the_normal_turns_with_the_feet() -> None:
    rng = np.random.default_rng(0)
    for count in (2, 3, 4, 6):
        level = np.append(rng.normal(size=(count, 2)), np.zeros((count, 1)), axis=1)
        turn = Rotation.from_rotvec(rng.uniform(-0.5, 0.5, 3)).as_matrix()
        axes = np.tile(turn[:, 2], (count, 1))
        if count > 2:
            axes = rng.normal(size=axes.shape)  # of no meaning
        np.testing.assert_allclose(floor_normal(level @ turn.T, axes), turn[:, 2], atol=1e-9)


@pytest.mark.parametrize(
    ("direction", "legs"),
    [("forward", "fl fr"), ("backward", "hl hr"), ("left", "fl hl"), ("right", "fr hr")],
)
def test_it_goes_down_on_the_side_it_shall_fall_to(direction: str, legs: str) -> None:
    stand, pose = np.array(ROBOT.poses["stand"]), falling_pose(ROBOT, direction)
    moved = np.array(ROBOT.joint_names)[pose != stand]
    assert {name.partition("_")[0] for name in moved} == set(legs.split())
    motions = script(ROBOT, [f"fall:{direction}"], np.random.default_rng(0))
    (seen,) = record_virtual(ROBOT, motions, "pd", {}, np.random.default_rng(0), EXACT)
    roll, pitch = (seen.extras[f"imu/{angle}"][-1] for angle in ("roll", "pitch"))
    down = {"forward": pitch, "backward": -pitch, "left": -roll, "right": roll}[direction]
    assert down > 0.1


def test_it_stands_and_replays(tmp_path: Path) -> None:
    recordings, out = tmp_path / "recordings", tmp_path / "out"
    motions = ("record", "standup:2", "step:0.1", "--virtual", "--noiseless")
    done = pup(*motions, "--robot", QUADRUPED, "--out", recordings)
    assert done.code == 0, done.err
    stood = next(r for r in load_recordings([recordings], ROBOT) if r.motion == "standup")
    assert max(np.abs(stood.extras[f"imu/{angle}"]).max() for angle in ("roll", "pitch")) < 0.05
    stand = np.array(ROBOT.poses["stand"])
    assert np.abs(stood.position[-1] - stand).max() < 0.15  # servos sag
    replay = ("replay", recordings, "--robot", QUADRUPED, "--cores", 1, "--json")
    shown = pup(*replay, "--out", out)
    assert shown.code == 0, shown.err
    assert 0 < shown.json()["rmse"] < 0.05
    assert shown.json()["diverged"] == []


def test_it_trots_in_place_without_a_policy() -> None:
    space = robot_space(ROBOT, "pd")
    bounds = FittedBounds("pd", space, ("kp/knee",), np.array([8.0]), np.array([10.0]))
    settings = TaskSettings(horizon=4.0)
    task = WalkingTask(
        ROBOT, ParameterSampler(bounds), settings, 8, np.random.default_rng(0), threads=1
    )
    task.reset()
    still = np.full((8, len(ROBOT.joints)), 5)
    knees = []
    for _ in range(100):
        step = task.step(still)
        assert not step.terminated.any()
        knees.append(step.observation.proprioception[:, [9, 11]])  # front left and right
    left, right = np.moveaxis(np.array(knees), 2, 0)
    assert np.ptp(left, axis=0).min() > 0.25
    assert np.corrcoef(left[20:].ravel(), right[20:].ravel())[0, 1] < -0.5  # by turns
    assert np.abs(step.distance).max() < 0.3


SMALL = {
    "record": (),
    "replay": ("--cores", 1, "--episodes", 8),
    "presysid": (
        *("--local", "--cores", 1, "--population", 8, "--generations", 8),
        *("--subsets", 2, "--subset-generations", 4),
    ),
    "train": ("--steps", 60_000, "--pattern", 0, "--simulations", 64, "--cores", 1),
    "diagnose": ("--local", "--cores", 1),
}
"""What makes the tutorial's commands quick."""


@pytest.mark.slow
@pytest.mark.ray
@pytest.mark.timeout(1800)
def test_the_tutorial(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every command of the page, in its order, with less to do."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "examples").symlink_to(EXAMPLES)
    _, whole, dry = blocks("robots.md", "sh")
    _, term = blocks("robots.md", "toml")
    shutil.copytree(QUADRUPED, "dry_dog")
    with Path("dry_dog/robot.toml").open("a") as file:
        file.write(f"\n{term}")
    copy, *commands = (whole + dry).splitlines()
    assert copy == "cp -r examples/quadruped dog"
    shutil.copytree("examples/quadruped", "dog")
    for command in commands:
        _, verb, *arguments = shlex.split(command)
        done = pup(verb, *arguments, *SMALL[verb])
        assert done.code == 0, f"{command}: {done.err}"
    bounds = json.loads(Path("dog_bounds/bounds.json").read_text())
    assert {"kp/hip", "tau_max/knee", "ground_friction"} <= {
        p["name"] for p in bounds["parameters"]
    }
    walk = json.loads(Path("dog_walk/replay.json").read_text())
    assert walk["time_median"] > 7.0  # s of 14: it does not fall at once
    found = json.loads(Path("dry_diagnosis/diagnosis.json").read_text())
    assert found["verdict"] == "mismatch"
    finding = found["findings"][0]
    assert (finding["effect"], finding["place"]["names"]) == ("coulomb_friction", ["hl_knee"])
    assert found["held_out"]["rmse_after"] < 0.3 * found["held_out"]["rmse_before"]
    assert RobotDescription.load("dry_diagnosis/corrected").terms
