"""Files written whole, with the rights of any new file; what is wrong with one that is read."""

import os
import resource
import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from commandline import pup

from pup.errors import InputError
from pup.files import read_json, write_atomic
from pup.robot_toml import read_text
from services.checkpoint import Checkpoint


@pytest.fixture
def no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A path that exists, is nobody's mistake by its kind of error, and cannot be read."""
    monkeypatch.chdir(tmp_path)  # a socket's path is short
    with socket.socket(socket.AF_UNIX) as made:
        made.bind("socket")
    return tmp_path / "socket"


def test_threads_that_write_leave_each_other_their_rights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, usual = os.umask(0o027), os.umask

    def slow(mask: int) -> int:
        told = usual(mask)
        time.sleep(0.001)  # so that other threads come to their turn
        return told

    monkeypatch.setattr(os, "umask", slow)
    try:
        with ThreadPoolExecutor(8) as pool:
            list(pool.map(lambda i: write_atomic(tmp_path / f"{i}", b"x"), range(64)))
        assert {file.stat().st_mode & 0o777 for file in tmp_path.iterdir()} == {0o640}
        assert usual(0o027) == 0o027
    finally:
        usual(before)


def test_a_write_that_fails_leaves_what_was_there(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    with pytest.raises(IsADirectoryError):
        write_atomic(tmp_path / "folder", b"x")
    assert [p.name for p in tmp_path.iterdir()] == ["folder"]


def test_a_full_disk_is_told_with_its_place(tmp_path: Path) -> None:
    """And what was there stays; a limit on the size of files stands in for the disk."""
    file = tmp_path / "bounds.json"
    file.write_bytes(b"before")
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, usual[1]))
    try:
        with pytest.raises(OSError, match="too large") as told:
            write_atomic(file, bytes(2000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)
    assert told.value.filename == str(file)
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [("bounds.json", b"before")]


def test_trouble_of_the_storage_is_no_bad_input(no_file: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_json(no_file.with_name("absent"))
    with pytest.raises(OSError, match="No such device"):
        read_json(no_file)


def test_nor_is_it_of_a_robot(no_file: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_text(no_file.with_name("absent"), 100)
    with pytest.raises(OSError, match="No such device"):
        read_text(no_file, 100)


def test_a_checkpoint_that_cannot_be_read_now_is_kept(no_file: Path) -> None:
    with pytest.raises(OSError, match="No such device"):
        Checkpoint(no_file, "of something")


def flipped(content: bytes) -> Iterator[bytes]:
    """Every byte of it in turn as another, and every beginning of it."""
    for at in range(len(content)):
        yield content[:at]
        yield content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :]


def test_any_cut_or_flipped_byte_of_a_checkpoint_is_refused_or_harmless(tmp_path: Path) -> None:
    """Never a traceback, never another training."""
    file, rows = tmp_path / "checkpoint.npz", [{"steps": 80}]
    Checkpoint(file, "of this").write({"learner/iteration": np.array(3)}, rows, 0, 1.0)
    for content in flipped(file.read_bytes()):
        file.write_bytes(content)
        with suppress(InputError):
            kept = Checkpoint(file, "of this")
            assert kept.state["learner/iteration"] == 3 and kept.rows == rows


def test_trouble_of_the_storage_ends_a_verb_with_another_code(
    no_file: Path, bench_recordings: Path
) -> None:
    """A job is tried again after it, and not after bad input."""
    given = ("replay", bench_recordings, "--robot", "servo_bench", "--out", no_file.parent / "out")
    done = pup(*given, "--bounds", no_file)
    assert (done.code, len(done.err.splitlines())) == (1, 1)
    assert f"{no_file}: No such device" in done.err
    done = pup(*given, "--bounds", no_file.with_name("absent"))
    assert done.code == 2
