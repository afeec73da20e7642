"""Bounds of a fleet from the fits of its robots."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pup.errors import InputError
from pup.files import read_json
from pup.robot import RobotDescription
from pup.sysid.pooled import pooled
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
