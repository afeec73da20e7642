"""Bounds of a fleet from the fits of its robots."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import agents
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pup.errors import InputError
from pup.files import read_json
from pup.locomotion.conditioning import fitted_eta
from pup.policy.bundle import NumpyPolicy
from pup.robot import RobotDescription
from pup.robot_parts import TermSpec
from pup.robot_writer import write_corrected
from pup.sysid.pooled import pooled, shared_terms
from pup.sysid.result import read_bounds

DARWIN = RobotDescription.load("darwin_op2")


def fits(folder: Path, moves: list[dict[str, float]]) -> list[Path]:
    """The identified bounds with some nominal values moved, a file for each robot."""
    folder.mkdir(exist_ok=True)
    files = []
    for i, moved in enumerate(moves):
        told = read_json(DARWIN.identified_path)
        for parameter in told["parameters"]:
            parameter["nominal"] = moved.get(parameter["name"], parameter["nominal"])
        told["provenance"]["recordings"] = {f"r{i}": "0" * 64}
        files.append(folder / f"{i}.json")
        files[-1].write_text(json.dumps(told))
    return files


def changed(file: Path, **more: Any) -> Path:
    file.write_text(json.dumps(read_json(file) | more))
    return file


def test_they_hold_every_robot_and_the_median_one_is_nominal(tmp_path: Path) -> None:
    files = fits(tmp_path, [{"torso_com/x": x, "rho/knee": 1.0} for x in (-0.01, 0.002, 0.03)])
    bounds = pooled(files, DARWIN)
    column = bounds.space.names.index("torso_com/x")
    assert bounds.nominal[column] == 0.002
    # Algorithm 1 widens a range by a tenth of it on either side.
    assert bounds.lower[column] == pytest.approx(-0.01 - 0.004)
    assert bounds.upper[column] == pytest.approx(0.03 + 0.004)
    knee = bounds.space.names.index("rho/knee")
    assert bounds.lower[knee] == bounds.nominal[knee] == bounds.upper[knee] == 1.0
    assert [subset.values[column] for subset in bounds.subsets] == [-0.01, 0.002, 0.03]
    assert "r1" in bounds.subsets[1].recordings
    bounds.write(tmp_path / "bounds.json")
    read = read_bounds(tmp_path / "bounds.json", DARWIN)
    assert np.array_equal(read.lower, bounds.lower)
    assert np.array_equal(
        read.space.nominal, read_bounds(files[1], DARWIN).space.at({"rho/knee": 1.0}).nominal
    )


@given(st.lists(st.floats(0.0, 3.0), min_size=2, max_size=6))
def test_order_does_not_matter_and_nobody_is_left_out(
    tmp_path_factory: pytest.TempPathFactory, knees: list[float]
) -> None:
    files = fits(tmp_path_factory.mktemp("fits"), [{"rho/knee": knee} for knee in knees])
    bounds, other = pooled(files, DARWIN), pooled(files[::-1], DARWIN)
    assert np.array_equal(bounds.lower, other.lower)
    assert np.array_equal(bounds.nominal, other.nominal)
    column = bounds.space.names.index("rho/knee")
    assert bounds.lower[column] <= min(knees) <= bounds.nominal[column] <= max(knees)
    assert max(knees) <= bounds.upper[column]
    assert np.all((bounds.lower >= bounds.space.lower) & (bounds.upper <= bounds.space.upper))
    assert np.all(np.abs(bounds.correlation) <= 1 + 1e-9)


def corrected(folder: Path, *terms: TermSpec) -> RobotDescription:
    return write_corrected(DARWIN, folder, {}, terms, actuator="nn_pd")


def friction(torque: float, name: str = "") -> TermSpec:
    values = {"torque": torque, "deflection": 0.004}
    return TermSpec("presliding_hysteresis", "joint" if name else "robot", name, values)


def law(name: str, factor: float) -> TermSpec:
    return TermSpec("learned_law", "robot", "", {name: factor})


def test_what_corrected_robots_share_is_bounded_too(tmp_path: Path) -> None:
    """The law of one robot is its own, and so is what acts at one joint."""
    robots = [
        corrected(tmp_path / "a", friction(0.04), law("u", 0.1)),
        corrected(tmp_path / "b", friction(0.08), law("v", 0.2), friction(0.3, "l_knee")),
        corrected(tmp_path / "c", friction(0.05), friction(0.2, "l_knee")),
        corrected(tmp_path / "d", friction(0.3, "l_knee")),
    ]
    terms = shared_terms(robots, DARWIN)
    assert terms == (friction(0.05),)
    files = fits(tmp_path / "fits", [{"torso_com/x": x} for x in (0.0, 0.01, 0.02, 0.03)])
    bounds = pooled(files, DARWIN, robots, terms)
    name = "presliding_hysteresis/torque@robot"
    assert [n for n in bounds.space.names if "@" in n] == [name]  # its deflection is a shape
    column = bounds.space.names.index(name)
    # Where it is not missing it is of size zero.
    assert [subset.values[column] for subset in bounds.subsets] == [0.04, 0.08, 0.05, 0.0]
    assert bounds.nominal[column] == pytest.approx(0.045)
    assert bounds.lower[column] == 0.0 and bounds.upper[column] == pytest.approx(0.088)
    bounds.write(tmp_path / "bounds.json")
    fleet = corrected(tmp_path / "fleet", *terms)
    read = read_bounds(tmp_path / "bounds.json", fleet)
    assert read.names == bounds.space.names
    assert read.space.select([name]).nominal == bounds.nominal[column]


def test_what_few_robots_lack_is_not_shared(tmp_path: Path) -> None:
    robots = [corrected(tmp_path / "a", friction(0.04)), corrected(tmp_path / "b")]
    assert shared_terms(robots, DARWIN) == ()
    assert shared_terms(robots[:1], robots[0]) == ()  # its own terms are not missing


def test_values_outside_of_the_search_range_are_held_too(tmp_path: Path) -> None:
    """Of corrected robots, whose ranges a diagnosis has widened."""
    robots = [
        write_corrected(DARWIN, tmp_path / name, {"rho/knee": knee}, (), actuator="nn_pd")
        for name, knee in (("a", 1.0), ("b", 99.0))
    ]
    files = fits(tmp_path / "fits", [{"rho/knee": 1.0}, {"rho/knee": 99.0}])
    bounds = pooled(files, DARWIN, robots)
    knee = bounds.space.names.index("rho/knee")
    assert bounds.upper[knee] == 99.0 and bounds.lower[knee] <= 1.0


def test_what_cannot_be_pooled_is_refused(tmp_path: Path) -> None:
    files = fits(tmp_path, [{}, {}])
    with pytest.raises(InputError, match="fits of two robots at least, not 1"):
        pooled(files[:1], DARWIN)
    told = read_json(files[1])
    weights = [w + 0.1 for w in told["actuator"]["weights"]]
    network = {"kind": "nn_pd", "weights": weights}
    with pytest.raises(InputError, match=r"1\.json: another network than in .*0\.json"):
        pooled([files[0], changed(files[1], actuator=network)], DARWIN)
    files = fits(tmp_path, [{}, {}])
    with pytest.raises(InputError, match=r"1\.json: of another torque law or other parameters"):
        pooled([files[0], changed(files[1], parameters=told["parameters"][1:])], DARWIN)


def test_an_effect_that_a_robot_has_not_is_one_of_size_zero(tmp_path: Path) -> None:
    fitted = read_bounds(DARWIN.identified_path, DARWIN)
    names = (*fitted.names, "presliding_hysteresis/torque@robot")
    agents.bundle(tmp_path, parameters=names, lively=True)
    policy = NumpyPolicy.load(tmp_path, DARWIN)
    mu = np.append(fitted.space.select(fitted.names).nominal, 0.0)
    known = np.clip(mu, policy.card.parameter_lower, policy.card.parameter_upper)
    eta = policy.project(policy.card.scale.unit(known))
    assert np.array_equal(fitted_eta(policy, fitted), eta)
    agents.bundle(tmp_path, parameters=("rho/knee", "rho/tail"))
    with pytest.raises(InputError, match="of a model with 'rho/tail', which the fitted has not"):
        fitted_eta(NumpyPolicy.load(tmp_path, DARWIN), fitted)


def test_parameters_that_no_training_has_seen_are_taken_at_the_nearest_that_one_has(
    tmp_path: Path,
) -> None:
    """A projection of what lies beyond the policy's bounds is a guess that robots fell by."""
    fitted = read_bounds(DARWIN.identified_path, DARWIN)
    agents.bundle(tmp_path, parameters=fitted.names, lively=True)
    policy = NumpyPolicy.load(tmp_path, DARWIN)
    card = policy.card
    at_end = replace(fitted.space.select(fitted.names), nominal=np.array(card.parameter_upper))
    beyond = replace(at_end, nominal=np.array(card.parameter_upper) + 1.0)
    near, far = (fitted_eta(policy, replace(fitted, space=space)) for space in (at_end, beyond))
    assert np.array_equal(far, near)
    unclipped = policy.project(card.scale.unit(np.array(card.parameter_upper) + 1.0))
    assert not np.array_equal(unclipped, near)
