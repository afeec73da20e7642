"""What a set is made with: the generator's files and the packages that it computes with."""

import hashlib
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pup

PACKAGE = Path(pup.__file__).parent
FILES = (
    *("blind/*.py", "robots/*/*.toml", "robots/*/*.xml", "robot*.py", "recording*.py"),
    *("sysid/clearance.py", "sysid/excitation.py", "sysid/lean.py"),
)
SCORER = ("bound.py", "judge.py", "places.py", "score.py", "statistics.py", "table.py")
"""Files beside the generator's that have no part in what a set is."""
PACKAGES = ("pup", "mujoco", "numpy", "scipy", "pyarrow")


def generator() -> dict[str, Any]:
    """Digest of the generator's files, wherever they are installed, and versions; JSON values."""
    digest = hashlib.sha256()
    for file in sorted({file for pattern in FILES for file in PACKAGE.glob(pattern)}):
        if file.name not in SCORER:
            digest.update(file.relative_to(PACKAGE).as_posix().encode())
            digest.update(hashlib.sha256(file.read_bytes()).digest())
    versions = {name: version(name) for name in PACKAGES} | {"python": platform.python_version()}
    return {"source_sha256": digest.hexdigest(), "versions": versions}
