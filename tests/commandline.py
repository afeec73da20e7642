"""Runs `pup`, in this process or in one of its own, for the tests of the command line."""

import io
import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from pup.sysid import polish
from services.cli import main

Arguments = Sequence[object]


@dataclass(frozen=True)
class Outcome:
    code: int
    out: str
    err: str

    def json(self) -> Any:
        """The one JSON object that stands alone on standard output."""
        (line,) = self.out.splitlines()
        return json.loads(line)


def pup(*arguments: object) -> Outcome:
    """Run `pup` in this process."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        try:
            code = main([str(a) for a in arguments])
        except SystemExit as end:  # argparse ends so
            code = int(end.code or 0)
    return Outcome(code, out.getvalue(), err.getvalue())


def pup_process(*arguments: object, folder: Path | None = None) -> Outcome:
    """Run `pup` as a user does, in a process of its own."""
    command = [sys.executable, "-m", "services.cli", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=folder)
    return Outcome(done.returncode, done.stdout, done.stderr)


BOTH = (
    *("--local", "--cores", 1, "--population", 4, "--generations", 2),
    *("--subsets", 2, "--subset-generations", 1, "--fixed-network"),
)
"""The least work that pre-sysID can be told to do with both torque laws."""
TINY = (*BOTH, "--actuator", "pd", "--no-comparison")
"""The least work that it can be told to do."""


@contextmanager
def briefly_polished() -> Iterator[None]:
    """Fits of this process do the least at their end, which takes most of the time of TINY.

    Those of other processes and of Ray's actors do as ever, and find something else.
    """
    with pytest.MonkeyPatch.context() as patch:
        for name in ("SQUARES", "ANCHORED", "ROUNDS", "ITERATIONS"):
            patch.setattr(polish, name, 1)
        yield


def files(folder: Path) -> dict[str, bytes]:
    """All files below a folder with their content; none where there is no folder."""
    found = sorted(p for p in folder.rglob("*") if p.is_file()) if folder.is_dir() else []
    return {str(p.relative_to(folder)): p.read_bytes() for p in found}
