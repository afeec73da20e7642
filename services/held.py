"""A folder that is one process's at a time."""

import errno
import fcntl
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from services.failures import FailedError

LOCK = ".lock"
"""File in the folder; the lock on it ends with the process that has it, however that ends."""
LEASE = 360.0
"""Longest that shared storage keeps a lock of a node that vanished, s: NFSv4 90, CephFS 300."""
AGAIN = 1.0
"""Between two tries, s."""
NO_LOCKS = (errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK)
"""What a file system says that has none."""
OURS = {"PUP_FOLDER_IS_OURS": "1"}
"""Environment of a process whose folder nobody else is given, as that of a job's attempt."""


@contextmanager
def held(folder: Path, patience: float = 0.0) -> Iterator[None]:
    """Have a folder for oneself.

    Args:
      folder: which is there.
      patience: how long to wait for it, s.

    Raises:
      FailedError: another process has it; it may be had another time, so that this is no bad input.
    """
    if OURS.items() <= os.environ.items():
        yield
        return
    place, end = folder / LOCK, time.monotonic() + patience
    while (file := _locked(place)) is None:
        if time.monotonic() >= end:
            raise FailedError(
                f"{folder}: another process works in this folder; wait for its end or stop it, or "
                "use another --out"
            )
        time.sleep(AGAIN)
    with file:
        try:
            yield
        finally:
            place.unlink(missing_ok=True)


def _locked(place: Path) -> IO[str] | None:
    """The file, with the lock on it; None where another process has that."""
    file = open(place, "w")  # noqa: SIM115 - the lock lasts as long as it is open
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        with suppress(FileNotFoundError):  # who had it has just left, and the file with it
            if os.path.samestat(place.stat(), os.fstat(file.fileno())):
                return file
    except BlockingIOError:
        pass
    except OSError as error:
        if error.errno not in NO_LOCKS:
            file.close()
            raise
        line = f"{place.parent}: is where files have no locks; do not start a command twice in it"
        print(line, file=sys.stderr, flush=True)
        return file
    file.close()
    return None
