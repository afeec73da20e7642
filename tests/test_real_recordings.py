"""The paper's own robot, where its recordings are at hand (`../shared/recordings`)."""

import json
from pathlib import Path

import numpy as np
import pytest

from pup.importers import import_recordings
from pup.physics.mujoco_batch import MujocoSimulator
from pup.physics.parameters import NETWORK_NAMES, ParameterSpace, robot_space
from pup.recording import Recording
from pup.robot import RobotDescription
from pup.sysid.loss import ReplayLoss
from pup.sysid.result import read_fitted

OP2 = RobotDescription.load("darwin_op2")


@pytest.fixture(scope="module")
def steps(shared: Path) -> tuple[Recording, ...]:
    """The 15 suspended step tests."""
    logs = sorted((shared / "recordings" / "darwin_op2_hardware").glob("0.05_0.*_?.json"))
    return import_recordings("darwin-hardware", logs, OP2)


def rmse(recordings: tuple[Recording, ...], space: ParameterSpace) -> float:
    trajectories = MujocoSimulator(OP2, recordings, "nn_pd").replay(space.candidates())
    return float(np.sqrt((ReplayLoss(OP2, recordings).rmse(trajectories) ** 2).mean()))


def test_the_authors_fit_is_as_good_here_as_in_their_simulator(
    shared: Path, steps: tuple[Recording, ...]
) -> None:
    """Model, decoding of mu and actuator are right: about 0.040 rad, as the authors' own replay."""
    told = json.loads((shared / "facts" / "authors_sysid.json").read_text())
    mu = told["nominal_physical"]
    groups = [group.lower() for group in told["group_order"]]
    values = {
        f"{kind}/{g}": mu[5 * k + i]
        for k, kind in enumerate(("rho", "sigma"))
        for i, g in enumerate(groups)
    }
    values |= {name: mu[10 + i] for i, name in enumerate(NETWORK_NAMES)}
    values |= {"torque_limit": mu[37]}
    assert len(steps) == 15
    error = rmse(steps, robot_space(OP2, "nn_pd").at(values))
    assert 0.035 <= error <= 0.045
    assert error == pytest.approx(0.0385, abs=0.001)


def test_the_shipped_fit_replays_the_real_robot(steps: tuple[Recording, ...]) -> None:
    _, space = read_fitted(OP2.identified_path, OP2)
    assert rmse(steps, space) < 0.0155
