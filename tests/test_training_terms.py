"""Training and showing a policy on a corrected robot, as `pup diagnose` writes one."""

import json
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("gymnasium")

from pup.policy.bundle import NumpyPolicy
from pup.robot import RobotDescription, TermSpec
from pup.robot_writer import write_corrected
from services import training
from services.training_options import Options
from services.walk import Shown, walk
from workers.cluster import connected
from workers.learner import Learning

OP2 = RobotDescription.load("darwin_op2")
FOUND = (
    TermSpec("backlash", "joint", "l_knee", {"gap": 0.02, "behind": 1.0}),
    TermSpec("stribeck_friction", "group", "ankle", {"torque": 0.1, "rest": 0.1, "speed": 0.5}),
    TermSpec("command_delay", "bus", "", {"time": 0.02}),
    TermSpec("measurement_delay", "bus", "", {"time": 0.01}),
    TermSpec("ground_compliance", "ground", "", {"time": 0.02}),
)
SMALL = Options(
    pattern=0, steps=96, simulations=4, length=8, learning=Learning(epochs=2, minibatch=16)
)


@pytest.fixture(scope="module")
def ray_here() -> Iterator[None]:
    with connected(cores=2):
        yield


@pytest.mark.ray
def test_a_corrected_robot_is_trained_resumed_and_shown(
    ray_here: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Resumed in the middle of episodes, with the weights of a training that was not stopped."""
    monkeypatch.setattr(training, "CHECKPOINT_SECONDS", 0.0)
    robot = write_corrected(OP2, tmp_path / "corrected", {}, FOUND, actuator="nn_pd")
    bounds = OP2.identified_path

    def job(name: str, told=lambda row, steps: None):
        return training.train(robot, bounds, SMALL, tmp_path / name, lambda: nullcontext(2), told)

    def weights(name: str) -> dict[str, np.ndarray]:
        with np.load(tmp_path / name / "policy" / "weights.npz", allow_pickle=False) as packed:
            return {name: packed[name] for name in packed.files}

    def stop(row: dict[str, object], steps: int) -> None:
        if row["steps"] == 64:
            raise KeyboardInterrupt

    whole = job("whole")
    with pytest.raises(KeyboardInterrupt):
        job("halves", stop)
    assert job("halves")["done"]
    assert weights("whole").keys() == weights("halves").keys()
    for name, values in weights("whole").items():
        np.testing.assert_array_equal(values, weights("halves")[name], err_msg=name)

    policy = tmp_path / "whole" / "policy"
    card = NumpyPolicy.load(policy, robot).card
    assert card.robot_digest == robot.digest != OP2.digest
    terms = json.loads(json.dumps([asdict(term) for term in FOUND]))
    assert card.provenance["terms"] == whole["provenance"]["terms"] == terms
    shown = walk(robot, Shown(policy, bounds, episodes=3), tmp_path, threads=1)
    assert shown["robot_digest"] == shown["trained_on"] == robot.digest
    assert shown["shown"]["time"] > 0 and len(shown["fell"]) == 3
