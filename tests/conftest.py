"""Fixtures that several test files use."""

import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from commandline import briefly_polished
from hypothesis import settings
from refusals import Place

from pup.robot import RobotDescription
from pup.sysid.virtual import record

settings.register_profile("patient", deadline=None)  # a machine that is busy is no fault
settings.load_profile("patient")

# A shell that runs the tests in the background has them, and all that they start, ignore it.
signal.signal(signal.SIGINT, signal.default_int_handler)

SHARED = Path(__file__).parents[2] / "shared"

LONGEST = (
    *("workers", "diagnosis", "jobs_ray", "cli", "blind_run", "training", "rivals"),
    *("diagnose_job", "run_corrected", "run", "blind_sound", "agent_holds", "training_job"),
    *("search", "reweighing", "transfer_job", "brax", "agent", "gateway_orders", "exhaustive"),
)
"""Files that take longest, which go first: after a long one that begins last, a worker is idle."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest files first, each with its tests in their order."""
    rank = {f"test_{name}.py": number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.name, len(rank)))


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder with the real recordings; tests that need it are skipped where it is absent."""
    if not (SHARED / "recordings").is_dir():
        pytest.skip("../shared/recordings is not here")
    return SHARED


@pytest.fixture(scope="module")
def ray_here() -> Iterator[None]:
    """A Ray of two cores, whose runners can import the tests' own tasks."""
    from workers.cluster import connected  # Ray is for those who ask for it

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(Path(__file__).parent))
        with connected(cores=2):
            yield


@pytest.fixture(scope="session")
def check_contract(shared: Path) -> Callable[[Path], None]:
    """Runs the contract checker on a file or folder and fails with what it prints."""

    def check(path: Path) -> None:
        command = [sys.executable, str(shared / "tools" / "check_contract.py"), str(path)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stdout + done.stderr

    return check


@pytest.fixture(scope="session")
def leg_recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two short recordings of a virtual `darwin_leg`; leave it as it is."""
    folder = tmp_path_factory.mktemp("leg")
    record(RobotDescription.load("darwin_leg"), ("step:0.1", "step:0.3"), folder, seed=3)
    return folder


@pytest.fixture(scope="session")
def bench_recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same of a virtual `servo_bench`."""
    folder = tmp_path_factory.mktemp("bench")
    record(RobotDescription.load("servo_bench"), ("step:0.1", "step:0.3"), folder, seed=3)
    return folder


@pytest.fixture
def place(tmp_path: Path, leg_recordings: Path, bench_recordings: Path) -> Place:
    """Where a case of bad input works."""
    return Place(tmp_path, leg_recordings, bench_recordings)


@pytest.fixture
def short_polish() -> Iterator[None]:
    """Fits of this process, and of no other, do the least at their end."""
    with briefly_polished():
        yield


@pytest.fixture(scope="module")
def browser(service: Any) -> Iterator[Any]:
    """Chromium, started after the module's service: its store is written without a loop around."""
    import pages

    with pages.chromium() as made:
        yield made


@pytest.fixture
def open_page(browser: Any, service: Any) -> Iterator[Any]:
    """Opens pages of the module's service; fails where one writes an error to its console."""
    import pages

    with pages.opener(browser, service, lambda message: message.type == "error") as opened:
        yield opened
