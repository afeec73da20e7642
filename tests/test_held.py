"""A folder is one process's at a time, for all that go on from what they find there."""

import errno
import fcntl
import os
import threading
import time
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from blind_sets import poor, seal
from commandline import TINY, files, pup
from jobs import holder
from workshops import Workshop, opened

from pup.errors import InputError
from services.blind_journal import Journal
from services.experiment.cells import graph
from services.experiment.plan import small
from services.experiment.run import Order, work_on
from services.failures import FailedError
from services.held import LOCK, OURS, held

BUSY = "another process works in this folder"
SMALL = ("--robot", "servo_bench", "--local")
NONE = ("--train-steps", 0, "--trials", 0, "--effects", 0)


def command(verb: str, bench: Path, folder: Path) -> tuple[object, ...]:
    match verb:
        case "run":
            return ("run", "--recordings", bench, *SMALL[:2], *TINY, *NONE)
        case "presysid":
            return ("presysid", bench, *SMALL[:2], *TINY)
        case "train":
            return ("train", "--steps", 1000)
        case "diagnose":
            return ("diagnose", bench, *SMALL)
    seal(folder, {"0f": poor(0)}, {"0f": {}})
    return ("blind", "run", "--set", folder / "set", "--local")


@pytest.mark.parametrize("verb", ["run", "presysid", "train", "diagnose", "blind run"])
def test_a_verb_that_goes_on_where_it_was_is_not_started_twice(
    bench_recordings: Path, tmp_path: Path, verb: str
) -> None:
    if verb in ("run", "train"):
        pytest.importorskip("torch")
    out = tmp_path / "out"
    out.mkdir()
    with holder(out):
        refused = pup(*command(verb, bench_recordings, tmp_path), "--out", out)
    assert refused.code == 1 and f"{out}: {BUSY}" in refused.err
    assert len(refused.err.splitlines()) == 1
    assert set(files(out)) <= {LOCK}


def test_a_folder_is_free_again_whatever_happened(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), held(tmp_path):
        with pytest.raises(FailedError, match=BUSY), held(tmp_path):
            pass
        raise KeyboardInterrupt
    with held(tmp_path):
        pass
    assert not list(tmp_path.iterdir())


def test_a_lock_that_was_left_behind_is_in_nobodys_way(tmp_path: Path) -> None:
    (tmp_path / LOCK).touch()  # by a process that was killed
    with held(tmp_path):
        assert Journal(tmp_path, {}).document()["sessions"] == []
        (tmp_path / "other").touch()
        with pytest.raises(InputError, match="not empty"):
            Journal(tmp_path, {})


def test_who_has_patience_waits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.held.AGAIN", 0.01)
    with holder(tmp_path) as other:
        with pytest.raises(FailedError, match=BUSY), held(tmp_path, 0.1):
            pass
        threading.Timer(0.3, other.kill).start()
        began = time.monotonic()
        with held(tmp_path, 60):
            assert time.monotonic() - began > 0.2
    assert not list(tmp_path.iterdir())


def test_a_job_has_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A node that vanished keeps its lock for minutes; retries would run out before."""
    (name, value), *_ = OURS.items()
    monkeypatch.setenv(name, value)
    with holder(tmp_path), held(tmp_path):
        pass


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK, errno.EIO])
def test_where_files_have_no_locks_it_goes_on_and_says_so(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    number: int,
) -> None:
    def flock(*_: Any) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", flock)
    trouble = number == errno.EIO  # which may pass
    how = pytest.raises(OSError, match="Input/output") if trouble else nullcontext()
    with how, held(tmp_path):
        assert (tmp_path / LOCK).exists()
    assert ("files have no locks" in capsys.readouterr().err) != trouble


def test_a_cell_that_ray_repeats_waits_for_the_process_that_has_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As that of a node that Ray has lost, and that still works."""
    shop: Workshop = opened(monkeypatch)
    monkeypatch.setattr("services.held.AGAIN", 0.01)
    cells = graph(replace(small(), stages=("record",)))
    order = Order(next(iter(cells.values())), tmp_path)
    order.folder.mkdir(parents=True)
    with holder(order.folder) as other:
        monkeypatch.setattr("services.experiment.run.LEASE", 0.1)
        assert BUSY in work_on(order).error and not shop.done
        monkeypatch.setattr("services.experiment.run.LEASE", 60.0)
        threading.Timer(0.3, other.kill).start()
        assert not work_on(order).error
    assert shop.done == [order.cell.name] and order.done
    assert not (order.folder / LOCK).exists()
