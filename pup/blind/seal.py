"""Sealing: what is published before the engine sees a set, and what proves it afterwards."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pup.errors import InputError
from pup.files import read_json, write_atomic, write_json

COMMITMENT = "commitment.json"
ALGORITHM = "SHA-256 of the salt's hexadecimal digits followed by the bytes of the key file"


def write_key(path: Path, key: Mapping[str, Any]) -> None:
    """Write the key; its bytes depend on its content alone."""
    write_atomic(path, json.dumps(key, indent=1, sort_keys=True, allow_nan=False) + "\n")


def read_key(path: Path) -> dict[str, Any]:
    """Read a key.

    Raises:
      InputError: the file is no key.
    """
    key = read_json(path)
    if not isinstance(key, dict) or key.get("schema") != 1 or "salt" not in key:
        raise InputError(f"{path}: not a key of a blind set (schema 1)")
    return key


def digest_of_key(path: Path) -> str:
    """The commitment to a key file."""
    return hashlib.sha256(str(read_key(path)["salt"]).encode() + path.read_bytes()).hexdigest()


def digest_of_set(folder: Path) -> str:
    """SHA-256 over the names and contents of all recordings of a set."""
    digest = hashlib.sha256()
    for file in sorted(folder.glob("case_*/*/*.parquet")):
        digest.update(file.relative_to(folder).as_posix().encode())
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def commit(folder: Path, key: Path, counts: Mapping[str, int]) -> dict[str, Any]:
    """Write a set's commitment.

    Args:
      folder: the set.
      key: its key, already written.
      counts: cases per robot; how many of them are nulls stays concealed.
    """
    commitment = {
        "schema": 1,
        "algorithm": ALGORITHM,
        "key_sha256": digest_of_key(key),
        "recordings_sha256": digest_of_set(folder),
        "cases": dict(counts),
        "engine_git_sha": None,
    }
    write_json(folder / COMMITMENT, commitment)
    return commitment


def read_set(folder: Path) -> dict[str, Any]:
    """Check a set against its commitment.

    Returns:
      The commitment.

    Raises:
      InputError: the folder is no set, or a recording is not the one committed to.
    """
    commitment = _commitment(folder)
    if commitment.get("recordings_sha256") != digest_of_set(folder):
        raise InputError(f"{folder}: its recordings are not those that its commitment names")
    return commitment


def verify(folder: Path, key: Path) -> dict[str, Any]:
    """Check a key and a set against the commitment.

    Returns:
      The key.

    Raises:
      InputError: the folder is no set, or the key or a recording is not the one committed to.
    """
    if _commitment(folder).get("key_sha256") != digest_of_key(key):
        raise InputError(f"{key}: not the key that {folder / COMMITMENT} commits to")
    read_set(folder)
    return read_key(key)


def _commitment(folder: Path) -> dict[str, Any]:
    file = folder / COMMITMENT
    if not file.is_file():
        raise InputError(
            f"{folder}: no {COMMITMENT} in it; name the folder of a set that is completely made"
        )
    commitment = read_json(file)
    if not isinstance(commitment, dict) or commitment.get("schema") != 1:
        raise InputError(f"{file}: not a commitment of a blind set (schema 1)")
    return commitment
