"""The command line of training and walking: bad input ends with exit code 2, one clear line."""

import json
from dataclasses import replace
from pathlib import Path

import agents
import pytest
from commandline import pup
from refusals import Cases, Made, Place, assert_refused, check

from pup.policy.bundle import read_bundle, write_bundle
from pup.policy.shape import Method
from pup.robot import RobotDescription
from pup.sysid.result import read_bounds

pytest.importorskip("torch")
pytest.importorskip("gymnasium")

case = Cases()
DARWIN = RobotDescription.load("darwin_op2")
IDENTIFIED = DARWIN.identified_path


def train(place: Place, *options: object) -> list[object]:
    return ["train", *options, "--out", place.out]


def walk(place: Place, *options: object) -> list[object]:
    return ["replay", *options, "--robot", "darwin_op2", "--out", place.out]


@case("bounds that are not there")
def _(place: Place) -> Made:
    file = place.here / "bounds.json"
    return train(place, "--bounds", file), (file, "cannot be read")


@case("bounds of another robot")
def _(place: Place) -> Made:
    told = json.loads(IDENTIFIED.read_text())
    file = place.write("bounds.json", json.dumps(told | {"robot": "someone"}))
    return train(place, "--bounds", file), (file, "someone")


@case("bounds the wrong way round")
def _(place: Place) -> Made:
    told = json.loads(IDENTIFIED.read_text())
    told["parameters"][0] |= {"lower": 2.0, "upper": 1.0}
    file = place.write("bounds.json", json.dumps(told))
    return train(place, "--bounds", file), (file, told["parameters"][0]["name"], "no bounds")


@case("a robot without bounds")
def _(place: Place) -> Made:
    return train(place, "--robot", "darwin_leg"), ("'darwin_leg'", "--bounds")


@case("an unknown method")
def _(place: Place) -> Made:
    return train(place, "--method", "sac"), ("--method", "'sac'", "robust")


@case("an unknown direction")
def _(place: Place) -> Made:
    return train(place, "--direction", "up"), ("--direction", "'up'", "sideways")


@case("no steps")
def _(place: Place) -> Made:
    return train(place, "--steps", "0"), ("--steps", "0 is not between")


@case("a learning rate that is none")
def _(place: Place) -> Made:
    return train(place, "--learning-rate", "nan"), ("--learning-rate", "nan")


@case("a start that is no policy")
def _(place: Place) -> Made:
    folder = place.here / "policy"
    return train(place, "--start", folder), (folder / "policy.json", "cannot be read")


@case("a start that would be written over")
def _(place: Place) -> Made:
    folder = place.here / "policy"
    policy, command = agents.bundle(folder), train(place, "--start", folder)
    return [*command[:-1], policy.parent], (policy, "written over", "--out")


@case("a tracker that is not installed")
def _(place: Place) -> Made:
    return train(place, "--track", "mlflow"), ("--track mlflow", "not installed")


@case("more runners than cores")
def _(place: Place) -> Made:
    return train(place, "--runners", 3, "--cores", 2), ("--runners 3", "2 cores")


@case("no cluster at the address")
def _(place: Place) -> Made:
    return train(place, "--address", "127.0.0.1:1"), ("127.0.0.1:1", "no Ray cluster")


@case("neither recordings nor a policy")
def _(place: Place) -> Made:
    return walk(place), ("recordings", "--policy")


@case("recordings and a policy")
def _(place: Place) -> Made:
    return walk(place, place.leg, "--policy", place.here), ("recordings", "--policy")


@case("a policy that is not there")
def _(place: Place) -> Made:
    return walk(place, "--policy", place.here), (place.here / "policy.json", "cannot be read")


@case("an eta that is none")
def _(place: Place) -> Made:
    return walk(place, "--policy", place.here, "--eta", "a,b"), ("--eta", "'a,b'", "numbers")


def walker(place: Place, method: Method) -> Path:
    """A policy that was trained on the robot's own bounds."""
    bounds = read_bounds(IDENTIFIED, DARWIN)
    folder = agents.bundle(place.here / "policy", parameters=bounds.names, method=method)
    card, weights = read_bundle(folder)
    told = {"parameter_lower": bounds.lower.tolist(), "parameter_upper": bounds.upper.tolist()}
    write_bundle(folder, replace(card, **told), weights)
    return folder


@case("an eta that nothing projects to")
def _(place: Place) -> Made:
    folder = walker(place, Method.PUP)
    return walk(place, "--policy", folder, "--eta", "0,0,5"), ("--eta: 0,0,5", "outside -1 to 1")


@case("a landscape over an eta that the policy has not")
def _(place: Place) -> Made:
    """Before it walks."""
    folder = walker(place, Method.ROBUST)
    return walk(place, "--policy", folder, "--landscape", 4), (folder, "leave --landscape out")


@pytest.mark.parametrize("name", list(case))
def test_bad_input_is_refused(place: Place, name: str) -> None:
    """Nothing is written."""
    check(place, case[name](place))


def test_a_checkpoint_of_something_else_is_left_alone(tmp_path: Path) -> None:
    """It stays as it is."""
    (tmp_path / "checkpoint.npz").write_bytes(b"mine")
    assert_refused(pup("train", "--out", tmp_path), tmp_path / "checkpoint.npz", "not a checkpoint")
    assert (tmp_path / "checkpoint.npz").read_bytes() == b"mine"
