"""The Parquet file behind a recording: its footer is judged before any data is read."""

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from pup.errors import InputError
from pup.files import MISTAKES
from pup.recording_rules import check_joints, check_metadata, check_values

Array = NDArray[np.float64]

KEY = b"pup.recording"

# A recording of an hour at 1 kHz with 6 columns has 22 million cells; real ones have thousands.
MAX_FILE = 2**30  # bytes
MAX_CELLS = 20_000_000
MAX_COLUMNS = 4096
MAX_UNPACKED = 2**31  # bytes, as the footer tells
MAX_METADATA = 2**20  # bytes


@dataclass(frozen=True)
class Header:
    """What a recording's file tells of itself.

    Attributes:
      metadata: the checked JSON object of the contract.
      joints: joint names in file order.
      columns: of the file.
      rows: control ticks.
      duration: from the first tick to the last, s.
      rate: one over the median time between two ticks, Hz.
    """

    metadata: Mapping[str, Any]
    joints: tuple[str, ...]
    columns: tuple[str, ...]
    rows: int
    duration: float
    rate: float

    @property
    def cells(self) -> int:
        """Numbers in the file."""
        return self.rows * len(self.columns)


def read_header(path: Path) -> Header:
    """Read what a recording's file tells of itself, and its times; no other sample is looked at.

    Raises:
      InputError: it is no recording; the message names the file.
    """
    try:
        with _opened(path) as file:
            metadata = check_metadata(_parse(file.schema_arrow.metadata[KEY]))
            names = tuple(file.schema_arrow.names)
            joints = tuple(n.split("/", 1)[1] for n in names if n.startswith("target/"))
            check_joints(joints)
            if "time" not in names:
                raise InputError("column 'time' is missing")
            time = _values(file.read(columns=["time"], use_threads=False), "time")
            check_values({"time": time})
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    steps = np.diff(time)
    duration, rate = float(time[-1] - time[0]), float(1 / np.median(steps))
    return Header(metadata, joints, names, len(time), duration, rate)


def visible(folder: Path, pattern: str) -> list[Path]:
    """Files of a folder by a pattern, sorted, without hidden ones and those in hidden folders.

    What a killed writer left is hidden, and so is what macOS puts beside each file on a stick.

    Raises:
      InputError: the folder cannot be read, which `glob` takes for an empty one.
    """
    if not os.access(folder, os.R_OK | os.X_OK):
        raise InputError(f"{folder}: cannot be read; change its rights")
    found = sorted(folder.glob(pattern))
    return [f for f in found if not any(p.startswith(".") for p in f.relative_to(folder).parts)]


def read_columns(path: Path) -> tuple[object, dict[str, Array]]:
    """Metadata and columns of a file, nulls as NaN.

    Raises:
      InputError: it is no such file, or holds what may not be in one.
    """
    with _opened(path) as file:
        table = file.read(use_threads=False)
        columns = {name: _values(table, name) for name in table.column_names}
        return _parse(file.schema_arrow.metadata[KEY]), columns


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The file behind its footer; whatever a damaged one raises is told as one mistake."""
    try:
        size = path.stat().st_size
        if not path.is_file():
            raise InputError("not a file")
    except MISTAKES as error:
        raise InputError(f"cannot be read ({error.strerror})") from error
    if size > MAX_FILE:
        raise InputError(f"{size} bytes; a recording has at most {MAX_FILE}")
    try:
        # Opened here, as pyarrow knows no path whose name is not UTF-8.
        with path.open("rb") as raw, pq.ParquetFile(raw, page_checksum_verification=True) as file:
            check_footer(file)
            yield file
    except InputError:
        raise
    except MISTAKES as error:
        raise InputError(f"cannot be read ({error.strerror})") from error
    except Exception as error:  # damaged files make pyarrow raise nearly anything
        told = " ".join(str(error).split())[:200]
        raise InputError(f"not a readable Parquet file ({told})") from error


def _values(table: Any, name: str) -> Array:
    """A column, its nulls as NaN."""
    column = table.column(name)
    values: Array = column.to_numpy().astype(np.float64)
    missing = column.is_null().to_numpy()
    for row in np.flatnonzero(~np.isfinite(values) & ~missing):
        raise InputError(
            f"column {name!r}, row {row}: {values[row]}; a missing sample must be null"
        )
    return values


def check_footer(file: Any) -> None:
    """Judge a file by what its footer tells, before any data is read.

    Args:
      file: a `pyarrow.parquet.ParquetFile`.

    Raises:
      InputError: it is too large, or no recording.
    """
    footer, schema = file.metadata, file.schema_arrow
    unpacked = sum(footer.row_group(i).total_byte_size for i in range(footer.num_row_groups))
    rows, columns = footer.num_rows, footer.num_columns
    if columns > MAX_COLUMNS or rows * columns > MAX_CELLS or unpacked > MAX_UNPACKED:
        raise InputError(
            f"{rows} rows of {columns} columns, {unpacked} bytes unpacked; a recording has at most "
            f"{MAX_COLUMNS} columns, {MAX_CELLS} cells and {MAX_UNPACKED} bytes"
        )
    for name in schema.names:
        if schema.names.count(name) > 1:
            raise InputError(f"column {name!r} stands twice")
        if schema.field(name).type != pa.float64():
            raise InputError(f"column {name!r} is {schema.field(name).type}; it must be float64")
    told = (schema.metadata or {}).get(KEY)
    if told is None:
        raise InputError("no metadata 'pup.recording': not a recording; see `pup import`")
    if len(told) > MAX_METADATA:
        raise InputError(f"metadata 'pup.recording' has {len(told)} bytes, over {MAX_METADATA}")


def _parse(text: bytes) -> object:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"metadata 'pup.recording' is not JSON ({error})") from error
