"""The examples do what they say."""

import importlib.util
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


def test_from_python_the_dry_bearing_is_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spec = importlib.util.spec_from_file_location("in_python", EXAMPLES / "in_python.py")
    assert spec is not None and spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    assert example.main(tmp_path) == "coulomb_friction"
    told = capsys.readouterr().out
    assert "coulomb_friction at joint:servo" in told and "motions left out" in told
