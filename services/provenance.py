"""What a result was made with: the commit, the files and the packages."""

import hashlib
import platform
import subprocess
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pup

PACKAGE = Path(pup.__file__).parent
PACKAGES = ("pup", "mujoco", "numpy", "scipy")
NOT_THE_ENGINE = "blind"
"""What makes sets and scores verdicts has no part in them."""
ALSO = ("hardware_agent", "services", "workers")
"""Packages besides that decide what is trained and what a robot does in trials."""
SUFFIXES = (".py", ".toml", ".xml", ".json")
GIT_SECONDS = 20


def engine(also: Sequence[str] = ()) -> dict[str, Any]:
    """What diagnoses, as JSON values; or what trains and walks.

    Args:
      also: packages beside this one whose files count, such as `ALSO`.

    Returns:
      The commit `git_sha` and whether files are not those of it, `dirty`, both None outside of a
      checkout; `source_sha256` of the packages' files; `versions`.
    """
    sha, dirty = _checkout(also)
    return {
        "git_sha": sha,
        "dirty": dirty,
        "source_sha256": _digest(also),
        "versions": versions(*PACKAGES),
    }


def versions(*packages: str) -> dict[str, str]:
    """Versions of packages and of Python."""
    return {name: version(name) for name in packages} | {"python": platform.python_version()}


def now() -> str:
    """The time in UTC, as ISO 8601 tells it."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def _digest(also: Sequence[str]) -> str:
    digest, beside = hashlib.sha256(), PACKAGE.parent
    files = [(file, file.relative_to(PACKAGE)) for file in sorted(PACKAGE.rglob("*"))]
    for package in also:
        files += [(f, f.relative_to(beside)) for f in sorted((beside / package).rglob("*"))]
    for file, name in files:
        if file.suffix in SUFFIXES and file.is_file() and name.parts[0] != NOT_THE_ENGINE:
            digest.update(name.as_posix().encode())
            digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def _checkout(also: Sequence[str]) -> tuple[str | None, bool | None]:
    """The commit that the packages are of, and whether their files differ from it."""
    # Asked for first: an installed package may lie below a checkout of something else.
    if not _git("ls-files", "--", "__init__.py"):
        return None, None
    sha = _git("rev-parse", "HEAD")
    folders = (".", *(f"../{package}" for package in also))
    changed = _git("status", "--porcelain", "--", *folders, f":!{NOT_THE_ENGINE}")
    return (sha, bool(changed)) if sha else (None, None)


def _git(*arguments: str) -> str | None:
    """What git answers in the package's folder; None where it has no answer."""
    try:
        done = subprocess.run(
            ["git", *arguments],
            cwd=PACKAGE,
            capture_output=True,
            text=True,
            timeout=GIT_SECONDS,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
