"""What the agent has done, append-only and on the disk before it is true.

A line of JSON per entry, with a checksum. A last line that was torn by a power cut was never acted
upon, so it is cut off; damage anywhere else is told and nothing is run.
"""

import errno
import fcntl
import json
import os
import time
import zlib
from contextlib import suppress
from pathlib import Path
from typing import Any

from pup.errors import InputError
from pup.files import MISTAKES

SCHEMA = 1


class JournalError(OSError):
    """The journal does not take an entry, which so never was; told in one line."""


def own(folder: Path) -> int:
    """Become the only agent whose files are in a folder; it is made when absent.

    Returns:
      A file descriptor: the folder is owned until it is closed, or the process ends.

    Raises:
      InputError: another agent owns it, or it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        owned = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except MISTAKES as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror})") from error
    try:
        fcntl.flock(owned, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(owned)
        raise InputError(
            f"{folder}: another agent's journal is there; end it first, or set another state"
        ) from error
    return owned


class Journal:
    """A file of entries.

    Attributes:
      trouble: why the latest entry was not taken; empty where it was.

    Args:
      file: made when absent.

    Raises:
      InputError: the file is damaged, of another version, or cannot be where it is to be.
      JournalError: it is new, and the disk takes nothing.
    """

    def __init__(self, file: Path) -> None:
        self.file, self.trouble = file, ""
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            fresh = not file.exists()
            self._handle = os.open(file, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o640)
        except MISTAKES as error:
            raise InputError(f"{file}: cannot be written ({error.strerror})") from error
        if fresh:
            self.append({"event": "journal", "schema": SCHEMA})
            folder = os.open(file.parent, os.O_RDONLY | os.O_DIRECTORY)
            os.fsync(folder)  # the file's name too
            os.close(folder)
        self.entries = self._read()

    def append(self, entry: dict[str, Any]) -> None:
        """Add an entry; when this returns, a power cut does not lose it.

        Args:
          entry: of JSON values; its time is added.

        Raises:
          JournalError: the disk does not take it.
        """
        text = json.dumps(entry | {"at": time.time()}, allow_nan=False, separators=(",", ":"))
        line = f"{zlib.crc32(text.encode()):08x} {text}\n".encode()
        before = os.fstat(self._handle).st_size
        try:
            if os.write(self._handle, line) != len(line):
                raise OSError(errno.ENOSPC, "the disk is full")
            os.fsync(self._handle)
        except OSError as error:
            with suppress(OSError):  # what comes next is not to stand behind a torn line
                os.ftruncate(self._handle, before)
            self.trouble = f"{self.file}: cannot be written ({error.strerror})"
            raise JournalError(self.trouble) from error
        self.trouble = ""

    def close(self) -> None:
        """Close the file."""
        os.close(self._handle)

    def _read(self) -> list[dict[str, Any]]:
        data = self.file.read_bytes()
        whole, _, torn = data.rpartition(b"\n")
        entries = []
        lines = whole.split(b"\n") if whole else []
        for number, line in enumerate(lines, 1):
            entry = _entry(line)
            if entry is None:
                if number == len(lines) and not torn:
                    os.ftruncate(self._handle, len(data) - len(line) - 1)
                    break
                raise InputError(f"{self.file}: line {number} is damaged; see docs/agent.md")
            entries.append(entry)
        if torn:
            os.ftruncate(self._handle, len(whole) + 1 if whole else 0)
        if not entries:  # it was cut in its very first line
            self.append({"event": "journal", "schema": SCHEMA})
        elif entries[0].get("schema") != SCHEMA:
            raise InputError(f"{self.file}: not a journal of schema {SCHEMA}")
        return entries[1:]


def _entry(line: bytes) -> dict[str, Any] | None:
    checksum, _, text = line.partition(b" ")
    if checksum != b"%08x" % zlib.crc32(text):
        return None
    told = json.loads(text)
    return told if isinstance(told, dict) else None
