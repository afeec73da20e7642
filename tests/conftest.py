"""Fixtures that several test files use."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

SHARED = Path(__file__).parents[2] / "shared"


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder with the real recordings; tests that need it are skipped where it is absent."""
    if not (SHARED / "recordings").is_dir():
        pytest.skip("../shared/recordings is not here")
    return SHARED


@pytest.fixture(scope="session")
def check_contract(shared: Path) -> Callable[[Path], None]:
    """Runs the contract checker on a file or folder and fails with what it prints."""

    def check(path: Path) -> None:
        command = [sys.executable, str(shared / "tools" / "check_contract.py"), str(path)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stdout + done.stderr

    return check
