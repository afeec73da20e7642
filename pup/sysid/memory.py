"""How much memory there is: the computer's, or what its container leaves of it."""

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

KINDS = {
    "": ("sys/fs/cgroup", "memory.max"),
    "memory": ("sys/fs/cgroup/memory", "memory.limit_in_bytes"),
}
"""Of control groups: where they stand, and the file with a group's limit; version 2 has no name."""


def memory(root: Path = Path("/")) -> int:
    """Bytes that this process may have at most.

    Args:
      root: of the file system that tells the limits of its control groups.
    """
    computer = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return min([computer, *_limits(root)])


def _limits(root: Path) -> Iterator[int]:
    """Limits of the control groups that this process is in, bytes; none elsewhere than on Linux."""
    for file in _files(root):
        with suppress(OSError, ValueError):  # not there, or "max"
            yield int(file.read_text())


def _files(root: Path) -> Iterator[Path]:
    """Where the limits stand, of versions 1 and 2: each group is bound by those above it.

    A container may be told its group by a path that it cannot see, and then sees that group itself
    where the root would be.
    """
    with suppress(OSError):
        for line in (root / "proc/self/cgroup").read_text().splitlines():
            _, kinds, path = line.split(":", 2)
            if kinds not in KINDS:
                continue
            place, name = KINDS[kinds]
            own = root / place / path.lstrip("/")
            above = (group for group in own.parents if group.is_relative_to(root / place))
            yield from (group / name for group in (own, *above))
