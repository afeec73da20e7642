"""Bounds fitted on virtual recordings contain the truth where the recordings can tell it."""

import json
from pathlib import Path

import numpy as np
import pytest

from pup.physics.parameters import robot_space
from pup.robot import RobotDescription
from pup.sysid.virtual import record
from services.presysid import identify
from services.presysid_options import Options
from workers.fits import LocalRunner

# A range from a few subsets is no confidence interval: its ends may miss a well-determined truth by
# a hair. Half a percent of the search range is far below anything a policy could feel.
HAIR = 0.005


def bounds_of(robot_name, kinds, folder, truth, options):
    robot = RobotDescription.load(robot_name)
    recordings = record(robot, kinds, folder / "recordings", 7, options.actuator, parameters=truth)
    return identify(
        robot, recordings, options, folder / "out", LocalRunner(), lambda *_: None, threads=2
    )


def assert_recovered(bounds, truth):
    width = bounds.space.upper - bounds.space.lower
    value = np.array([truth[name] for name in bounds.space.names])
    inside = (bounds.lower - HAIR * width <= value) & (value <= bounds.upper + HAIR * width)
    missed = [n for n, ok in zip(bounds.space.names, inside, strict=True) if not ok]
    assert not missed, {n: (truth[n], bounds.document()["parameters"]) for n in missed}


@pytest.mark.slow
def test_servo_gains_of_a_leg_are_recovered(tmp_path: Path) -> None:
    """Suspended steps tell stiffness, damping and torque limit of each group."""
    space = robot_space(RobotDescription.load("darwin_leg"), "pd")
    truth = dict(zip(space.names, map(float, space.nominal), strict=True))
    truth |= {"kp/knee": 11.0, "kd/hip": 0.9, "tau_max/ankle": 1.9, "kp/ankle": 18.0}
    options = Options("pd", generations=40, subsets=6, subset_generations=10, compare=False)
    bounds = bounds_of("darwin_leg", ["step"] * 2 + ["chirp"], tmp_path, truth, options)
    assert_recovered(bounds, truth)
    gains = [i for i, n in enumerate(bounds.space.names) if n.startswith(("kp/", "kd/"))]
    assert bounds.identified[gains].all()


@pytest.mark.usefixtures("short_polish")
def test_what_a_suspended_robot_cannot_tell_is_said_so(tmp_path: Path) -> None:
    """Ground friction and the torso's mass do nothing in the air: unidentified, whole range."""
    space = robot_space(RobotDescription.load("darwin_op2"), "nn_pd")
    truth = dict(zip(space.names, map(float, space.nominal), strict=True))
    options = Options(
        generations=3, subsets=3, subset_generations=2, compare=False, fixed_network=True
    )
    bounds = bounds_of("darwin_op2", ["step:0.3"], tmp_path, truth, options)
    by_name = {
        p["name"]: p for p in json.loads((tmp_path / "out/bounds.json").read_text())["parameters"]
    }
    for name in ("ground_friction", "torso_com/x", "torso_com/z"):
        told = by_name[name]
        low, high = told["search"]
        assert not told["identified"]
        assert told["upper"] - told["lower"] > 0.85 * (high - low)
    assert by_name["rho/hip"]["identified"]
    assert bounds.omitted


@pytest.mark.slow
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("actuator", ["nn_pd", "pd"])
def test_whole_robot_is_recovered(tmp_path: Path, actuator: str) -> None:
    """Steps, stand-ups and falls in four directions of the whole robot, its network known."""
    robot = RobotDescription.load("darwin_op2")
    space = robot_space(robot, actuator)
    truth = dict(zip(space.names, map(float, space.nominal), strict=True))
    bounded = [n for n in space.names if not n.startswith("phi/")]
    rng = np.random.default_rng(11)
    for name in bounded:
        i = space.names.index(name)
        reach = 0.06 * (space.upper[i] - space.lower[i])
        truth[name] = float(
            np.clip(truth[name] + rng.uniform(-reach, reach), space.lower[i], space.upper[i])
        )
    options = Options(
        actuator,
        generations=200,
        subsets=10,
        subset_generations=50,
        compare=False,
        fixed_network=True,
    )
    kinds = ["step"] * 2 + ["standup:1.75", "standup:2", "fall"]
    bounds = bounds_of("darwin_op2", kinds, tmp_path, truth, options)
    assert_recovered(bounds, truth)
    assert bounds.identified.sum() >= len(bounded) - 3
