"""What a killed owner leaves behind."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from workers import reaper

MARK = "PUP_TEST_REAPER=1"


@pytest.fixture
def left() -> "Iterator[subprocess.Popen[bytes]]":
    name, value = MARK.split("=")
    asleep = [sys.executable, "-c", "import time; print(flush=True); time.sleep(60)"]
    process = subprocess.Popen(asleep, env={name: value}, stdout=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.readline()  # it has its environment now
    yield process
    process.kill()
    process.wait()


def test_marked_processes_are_found_and_ended(left: "subprocess.Popen[bytes]") -> None:
    assert left.pid in reaper.marked(MARK)
    assert reaper.end(MARK, spared=left.pid)
    assert left.poll() is None
    reaper.end(MARK)
    assert left.wait(5) == -9


def test_one_that_has_no_environment_yet_is_waited_for(
    left: "subprocess.Popen[bytes]", monkeypatch: pytest.MonkeyPatch
) -> None:
    """Twice it cannot be seen, as while it is being started."""
    looks = iter([[], [], [left.pid]])
    monkeypatch.setattr(reaper, "marked", lambda mark: next(looks, []))
    assert reaper.end(MARK, calm=3)
    assert left.wait(5) == -9


def test_an_owner_that_goes_on_is_not_ended_and_its_mark_is_gone(tmp_path: Path) -> None:
    folder = tmp_path / "session"
    folder.mkdir()
    watch = reaper.start(str(folder))
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    reaper.close(watch, str(folder))
    assert watch.returncode == 0
    assert child.wait(5) == -9
    assert not folder.exists()
    assert reaper.SESSION not in os.environ


def test_what_is_started_beside_an_owner_that_marks_its_own_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a picture's encoder beside a laboratory, and Ray's mark stays."""
    monkeypatch.setenv(reaper.SESSION, "another")
    folder = tmp_path / "session"
    folder.mkdir()
    asleep = [sys.executable, "-c", "import time; time.sleep(60)"]
    watch = reaper.watch(str(folder))
    beside = subprocess.Popen(asleep)
    own = subprocess.Popen(asleep, env=os.environ | {reaper.SESSION: str(folder)})
    reaper.close(watch, str(folder))
    assert own.wait(5) == -9
    assert beside.poll() is None
    assert os.environ[reaper.SESSION] == "another"
    beside.kill()
    beside.wait()
