"""`make`'s targets do what README.md says: what would be run, without running it."""

import os
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


def commands(target: str, environment: Path) -> list[str]:
    """What a target would run where nothing is installed yet."""
    outer = ("MAKEFLAGS", "MAKELEVEL", "MFLAGS")  # of the `make` that runs the tests
    done = subprocess.run(
        ["make", "--dry-run", f"VENV={environment}", target],
        env={k: v for k, v in os.environ.items() if k not in outer},
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    return done.stdout.splitlines()


def test_install_is_the_set_up_of_run_and_no_more(tmp_path: Path) -> None:
    installed = commands("install", tmp_path)
    assert any("pip install" in line and "-c constraints.txt" in line for line in installed)
    assert not any("pup run" in line for line in installed)
    *set_up, last = commands("run", tmp_path)
    assert (set_up, "pup run" in last) == (installed, True)


@pytest.mark.parametrize("target", ["install", "run", "test", "slow", "lint", "docs", "clean"])
def test_a_file_of_its_name_holds_no_target_up(target: str) -> None:
    """Each is declared phony."""
    (phony,) = (
        line for line in (ROOT / "Makefile").read_text().splitlines() if line.startswith(".PHONY:")
    )
    assert target in phony.split()
