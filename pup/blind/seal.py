"""Sealing: what is published before the engine sees a set, and what proves it afterwards."""

import hashlib
import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pup.errors import InputError
from pup.files import read_json, write_atomic, write_json

COMMITMENT = "commitment.json"
ALGORITHM = "SHA-256 of the salt's hexadecimal digits followed by the bytes of the key file"


def write_key(path: Path, key: Mapping[str, Any]) -> None:
    """Write the key, or a part of it, for its owner alone; its bytes depend on its content."""
    mask = os.umask(0o077)
    try:
        write_atomic(path, json.dumps(key, indent=1, sort_keys=True, allow_nan=False) + "\n")
    finally:
        os.umask(mask)


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


def commit(folder: Path, key: Path) -> dict[str, Any]:
    """Write a set's commitment; how many of its cases are nulls stays concealed.

    Args:
      folder: the set.
      key: its key, already written.
    """
    commitment = {
        "schema": 1,
        "algorithm": ALGORITHM,
        "key_sha256": digest_of_key(key),
        "recordings_sha256": digest_of_set(folder),
        "cases": _counts(read_key(key)["cases"]),
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
      InputError: the folder is no set, or the key, a recording or the cases are not those committed
        to.
    """
    if _commitment(folder).get("key_sha256") != digest_of_key(key):
        raise InputError(f"{key}: not the key that {folder / COMMITMENT} commits to")
    told, known = read_set(folder).get("cases"), read_key(key)
    if told != _counts(known["cases"]):
        raise InputError(f"{folder / COMMITMENT}: its cases are not those of the key {key}")
    if "generator" in known:  # keys of earlier sets have no such word, and were not checked
        check_cases(folder, known["cases"])
    return known


def check_cases(folder: Path, truths: Sequence[Mapping[str, Any]]) -> None:
    """Check that a set has the cases of its key, and no others.

    Raises:
      InputError: it has not.
    """
    wanted = {f"case_{truth['id']}" for truth in truths}
    apart = wanted ^ {case.name for case in folder.glob("case_*")}
    if apart:
        raise InputError(f"{folder}: {', '.join(sorted(apart))} in it or in its key, not in both")


def _counts(truths: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """Cases per robot."""
    return dict(sorted(Counter(truth["robot"] for truth in truths).items()))


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
