"""Bounds that parameters are drawn from."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from walking import BOUNDS, DARWIN

from pup.errors import InputError
from pup.sysid.result import read_bounds


def changed(folder: Path, **entry: Any) -> Path:
    """The robot's own bounds with the first parameter changed; None leaves a key out."""
    document = json.loads(DARWIN.identified_path.read_text())
    first = document["parameters"][0] | entry
    document["parameters"][0] = {key: value for key, value in first.items() if value is not None}
    path = folder / "bounds.json"
    path.write_text(json.dumps(document))
    return path


def test_bounds_are_read_around_the_fitted_values() -> None:
    document = json.loads(DARWIN.identified_path.read_text())
    assert BOUNDS.names == tuple(entry["name"] for entry in document["parameters"])
    assert len(BOUNDS.names) == 14 and BOUNDS.actuator == "nn_pd"
    np.testing.assert_array_equal(BOUNDS.lower, [e["lower"] for e in document["parameters"]])
    nominal = [BOUNDS.space.nominal[BOUNDS.space.names.index(name)] for name in BOUNDS.names]
    np.testing.assert_array_equal(nominal, [e["nominal"] for e in document["parameters"]])


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({"lower": None}, "parameter 'rho/arm' has no bounds lower and upper"),
        ({"upper": "high"}, "parameter 'rho/arm' has no bounds lower and upper"),
        ({"lower": 2.0, "upper": 1.0}, "parameter 'rho/arm': [2, 1] are no bounds"),
        ({"lower": 1.0, "upper": float("inf")}, "parameter 'rho/arm': [1, inf] are no bounds"),
        ({"name": "rho/tail"}, "parameter 'rho/tail' is not one of robot 'darwin_op2'"),
    ],
)
def test_wrong_bounds_are_refused(tmp_path: Path, entry: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError) as refused:
        read_bounds(changed(tmp_path, **entry), DARWIN)
    assert words in str(refused.value) and "\n" not in str(refused.value)
