"""What goes wrong with one of many jobs: written down beside it, so that the others go on."""

import traceback
from collections.abc import Mapping
from pathlib import Path

from pup.files import write_json

ERROR = "error.json"
SHOWN = 5
"""Failed jobs that a message names."""


class FailedError(RuntimeError):
    """What was asked for did not come to be, for no fault in the asking: told in one line."""


def caught(folder: Path, error: Exception) -> str:
    """Write down what a job raised, and tell it in a line."""
    message = f"{type(error).__name__}: {' '.join(str(error).split())}"
    _write(folder, message, "".join(traceback.format_exception(error)))
    return message


def lost(folder: Path, told: object) -> str:
    """Write down what is told of a job whose process was lost, and tell it in a line."""
    lines = str(told).strip().splitlines() or [""]
    message = f"{type(told).__name__}: {lines[0]}"
    _write(folder, message, str(told))
    return message


def mended(folder: Path) -> None:
    """Forget what went wrong before."""
    (folder / ERROR).unlink(missing_ok=True)


def named(failed: Mapping[str, str], place: str = "") -> str:
    """The first of the failed jobs and why, and how many more there are.

    Args:
      failed: why, by name.
      place: where to find the others.
    """
    told = [f"{name} ({why[:160]})" for name, why in sorted(failed.items())]
    more = [f"and {len(told) - SHOWN} more{place}"] if len(told) > SHOWN else []
    return ", ".join(told[:SHOWN] + more)


def _write(folder: Path, message: str, details: str) -> None:
    document = {"schema": 1, "error": message, "details": details.splitlines()}
    write_json(folder / ERROR, document)
