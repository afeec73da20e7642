"""A folder that is one process's at a time."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from services.failures import FailedError

LOCK = ".lock"
"""File in the folder; the lock on it ends with the process that has it, however that ends."""


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Have a folder for oneself.

    Args:
      folder: which is there.

    Raises:
      FailedError: another process has it; it may be had another time, so that this is no bad input.
    """
    place = folder / LOCK
    with open(place, "w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            free = place.exists() and os.path.samestat(place.stat(), os.fstat(file.fileno()))
        except BlockingIOError:
            free = False
        if not free:  # or who had it has just left, and the file with it
            raise FailedError(
                f"{folder}: another process works in this folder; wait for its end or stop it, or "
                "use another --out"
            )
        try:
            yield
        finally:
            place.unlink(missing_ok=True)
