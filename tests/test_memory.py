"""How much memory there is: no more than a container's limit, as Linux tells it."""

import os
from pathlib import Path

import pytest

from pup.sysid.memory import memory

COMPUTER = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
NONE_V1 = 9223372036854771712  # what version 1 tells of a group without a limit
SMALL = 2**20


def told(root: Path, group: str, **limits: object) -> int:
    """The memory where a process is in a group, and limits stand in folders (`a__b`: `a/b`)."""
    (root / "proc/self").mkdir(parents=True)
    (root / "proc/self/cgroup").write_text(group + "\n")
    for place, limit in limits.items():
        folder = root / "sys/fs/cgroup" / place.replace("__", "/").removeprefix("here")
        folder.mkdir(parents=True, exist_ok=True)
        name = "memory.max" if group.startswith("0::") else "memory.limit_in_bytes"
        (folder / name).write_text(f"{limit}\n")
    return memory(root)


@pytest.mark.parametrize(
    ("group", "limits"),
    [
        ("0::/", {"here": SMALL}),  # a container of its own namespace
        ("0::/pod/job", {"pod__job": "max", "pod": SMALL}),  # as Kubernetes bounds a pod
        ("0::/pod/job", {"pod__job": SMALL, "pod": 2 * SMALL}),
        ("4:memory:/docker/7f", {"memory": SMALL}),  # its path is the host's
        ("4:memory:/docker/7f", {"memory": NONE_V1, "memory__docker__7f": SMALL}),
    ],
)
def test_a_container_has_what_it_is_allowed(
    tmp_path: Path, group: str, limits: dict[str, object]
) -> None:
    assert told(tmp_path, group, **limits) == SMALL


@pytest.mark.parametrize(
    ("group", "limits"),
    [
        ("0::/", {}),
        ("0::/", {"here": "max"}),
        ("4:memory:/", {"memory": NONE_V1}),
        ("2:cpu:/", {"here": SMALL}),
    ],
)
def test_without_a_limit_there_is_what_the_computer_has(
    tmp_path: Path, group: str, limits: dict[str, object]
) -> None:
    assert told(tmp_path, group, **limits) == COMPUTER


def test_here_is_no_more_than_the_computer_has(tmp_path: Path) -> None:
    assert 0 < memory() <= COMPUTER
    assert memory(tmp_path) == COMPUTER  # where there are no control groups
