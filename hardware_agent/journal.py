"""What the agent has done, append-only and on the disk before it is true.

A line of JSON per entry, with a checksum. A last line that was torn by a power cut was never acted
upon, so it is cut off; damage anywhere else is told and nothing is run.
"""

import json
import os
import time
import zlib
from pathlib import Path
from typing import Any

from pup.errors import InputError
from pup.files import MISTAKES

SCHEMA = 1


class Journal:
    """A file of entries.

    Args:
      file: made when absent.

    Raises:
      InputError: the file is damaged, of another version, or cannot be where it is to be.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
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
        """
        text = json.dumps(entry | {"at": time.time()}, allow_nan=False, separators=(",", ":"))
        line = f"{zlib.crc32(text.encode()):08x} {text}\n".encode()
        before = os.fstat(self._handle).st_size
        written = os.write(self._handle, line)
        if written != len(line):
            os.ftruncate(self._handle, before)  # what comes next is not to stand behind a torn line
            raise OSError(f"{self.file}: the disk is full")
        os.fsync(self._handle)

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
