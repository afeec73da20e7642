"""Files written whole or not at all, and JSON read within limits."""

import hashlib
import json
import os
import secrets
from pathlib import Path
from typing import Any

from pup.errors import InputError

JSON_LIMIT = 64 * 2**20  # bytes
MISTAKES = (
    FileNotFoundError,
    PermissionError,
    FileExistsError,
    IsADirectoryError,
    NotADirectoryError,
)
"""What a wrong path raises; any other OSError is trouble of the storage, which may pass."""


def write_atomic(path: Path, data: bytes | str) -> None:
    """Write a file through a temporary neighbour and a rename.

    Args:
      path: where the file shall stand; its folder is made when absent.
      data: the content; text is written as UTF-8.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    raw = data.encode() if isinstance(data, str) else data
    part = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        with open(part, "xb") as file:  # unlike one of `tempfile` with the rights of any new file
            try:
                file.write(raw)
                file.flush()
                os.fsync(file.fileno())
                os.replace(part, path)
            except BaseException:
                part.unlink(missing_ok=True)
                raise
    except OSError as error:
        if error.errno is not None and not error.filename:
            error.filename = str(path)  # a full disk does not say where
        raise


def write_json(path: Path, value: Any) -> None:
    """Write a JSON document atomically; NaN and infinity are refused."""
    write_atomic(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


def sha256(path: Path) -> str:
    """SHA-256 of a file's content, in hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def read_json(path: Path, limit: int = JSON_LIMIT) -> Any:
    """Read a JSON document.

    Args:
      path: the file.
      limit: largest size accepted, in bytes.

    Raises:
      InputError: the file is absent, too large or no JSON.
      OSError: the storage cannot be read now.
    """
    try:
        if path.stat().st_size > limit:
            raise InputError(f"{path}: larger than {limit} bytes; is this the right file?")
        return json.loads(path.read_text(encoding="utf-8"))
    except MISTAKES as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except (InputError, OSError):
        raise
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not a JSON document ({error})") from error
