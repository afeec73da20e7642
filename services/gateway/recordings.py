"""Recordings that pages show: folders of Parquet files, looked through within limits."""

import asyncio
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from pathlib import Path

from pup.errors import InputError
from pup.recording import Recording
from pup.recording_file import Header, read_header
from pup.transfer.trial import UnknownError
from services.gateway.storage import on_storage
from services.job_folder import below, inside

LISTED = 500
"""Recordings of a folder on a page of their list."""
LOOKED = 20_000
"""Files of a folder that are looked at."""
CELLS = 4_000_000
"""Numbers of a recording that is drawn: an hour at 50 Hz of 20 joints."""
SUFFIX = ".parquet"


@dataclass(frozen=True)
class Listed:
    """A recording in a list.

    Attributes:
      name: of its file, below its shelf.
      header: what the file tells; None where it cannot be read.
      trouble: why not, in one line.
    """

    name: str
    header: Header | None = None
    trouble: str = ""


@dataclass(frozen=True)
class Listing:
    """A page of the list of a shelf's recordings.

    Attributes:
      shelf: its name.
      shown: the recordings of the page.
      skipped: how many come before them.
      total: how many were found.
      all_found: whether there are no more than these, for only so many files are looked at.
    """

    shelf: str
    shown: list[Listed]
    skipped: int
    total: int
    all_found: bool

    @property
    def end(self) -> int:
        """How many come before the page and on it."""
        return self.skipped + len(self.shown)

    @property
    def count(self) -> str:
        """How many there are, in words."""
        return f"{self.total}{'' if self.all_found else ' or more'}"


class Shelves:
    """Folders of recordings.

    Args:
      folders: by the names that they have on pages.
    """

    def __init__(self, folders: Mapping[str, Path]) -> None:
        self.folders = folders
        self._drawing = asyncio.Semaphore(1)

    def listed(self, shelf: str, skipped: int = 0) -> Listing:
        """Recordings of a shelf by name, a page of them.

        Args:
          shelf: its name.
          skipped: recordings before the page; the first one is shown where there are no more.

        Raises:
          UnknownError: there is no such shelf.
        """
        files = below(self._folder(shelf))
        found = [(name, path) for name, path in islice(files, LOOKED) if name.endswith(SUFFIX)]
        skipped = skipped if skipped < len(found) else 0
        shown = [_listed(name, path) for name, path in found[skipped : skipped + LISTED]]
        return Listing(shelf, shown, skipped, len(found), next(files, None) is None)

    def file(self, shelf: str, name: str) -> Path:
        """A recording's file.

        Raises:
          UnknownError: there is none of this name.
        """
        path = inside(self._folder(shelf), name) if name.endswith(SUFFIX) else None
        if path is None:
            raise UnknownError(f"there is no recording {name[:200]}")
        return path

    async def read(self, path: Path) -> Recording:
        """A recording, for its drawing: one at a time, for they may be large.

        Raises:
          InputError: it cannot be read, or is too large; the message is one line.
        """
        async with self._drawing:
            return await on_storage(_read, path)

    def _folder(self, shelf: str) -> Path:
        if shelf not in self.folders:
            raise UnknownError(f"there is no folder of recordings {shelf}")
        return self.folders[shelf]


def _listed(name: str, path: Path) -> Listed:
    shown = os.fsencode(name).decode(errors="replace")
    if shown != name:  # no page can hold the name itself
        return Listed(shown, trouble="its name is not UTF-8; rename it")
    try:
        status = path.stat()
        return Listed(name, _header(path, status.st_mtime_ns, status.st_size))
    except InputError as error:
        return Listed(name, trouble=_told(error, path))
    except OSError as error:
        return Listed(name, trouble=error.strerror or "it cannot be read")


@lru_cache(maxsize=4096)
def _header(path: Path, modified: int, size: int) -> Header:
    return read_header(path)


def _read(path: Path) -> Recording:
    try:
        cells = read_header(path).cells
        if cells > CELLS:
            raise InputError(f"{cells} numbers; recordings of up to {CELLS} are drawn")
        return Recording.read(path)
    except InputError as error:
        raise InputError(_told(error, path)) from error


def _told(error: InputError, path: Path) -> str:
    """A mistake without the folder, which is none of the reader's business."""
    return str(error).removeprefix(f"{path}: ")[:500]
