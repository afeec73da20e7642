"""Tables whose columns are those of the contract, as comma-separated text.

An empty cell is a missing sample. The metadata come from the options, or from a first line
`# pup.recording: {json}` with the JSON object of the contract.
"""

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from pup.errors import InputError
from pup.importers.common import MAX_CELLS, Array, ImportOptions, item, parse_json, read_text
from pup.recording import Recording, from_columns

MARK = "# pup.recording:"
MAX_FILE = 256 * 2**20  # bytes
SHOWN = 60
"""Characters of a cell that a message shows."""


def read(path: Path, options: ImportOptions) -> list[Recording]:
    """Read one table."""
    lines = read_text(path, MAX_FILE).replace("\r\n", "\n").rstrip("\n").split("\n")
    if lines == [""]:
        raise InputError("line 1: the file is empty")
    known: dict[str, Any] = {"id": path.stem}
    skipped = 0
    if lines and lines[0].startswith(MARK):
        try:
            known |= _header(parse_json(lines[0][len(MARK) :]))
        except InputError as error:
            raise InputError(f"line 1, {MARK.rstrip(':')}: {error}") from error
        skipped = 1
    return [from_columns(options.metadata(known), _columns(lines[skipped:], skipped))]


def _header(metadata: object) -> dict[str, Any]:
    if item(metadata, "schema") != 1:
        raise InputError(f"schema is {item(metadata, 'schema')!r}; this version reads 1")
    assert isinstance(metadata, dict)  # as `item` has seen
    return metadata


def _columns(lines: list[str], skipped: int) -> dict[str, Array]:
    """Columns by name; `skipped` lines stand above, for the line numbers in messages."""
    try:
        table = csv.reader(lines, strict=True)
        names = [name.strip() for name in next(table, [])]
        if not names:
            raise InputError(f"line {skipped + 1}: no column names")
        if len(names) == 1:
            raise InputError(
                f"line {skipped + 1}: no comma in {_shown(names[0])}; column names and cells are "
                "separated by commas, and numbers have points"
            )
        for name in names:
            if not name or names.count(name) > 1:
                raise InputError(
                    f"line {skipped + 1}: column {_shown(name)} has no name or stands twice"
                )
        if len(lines) * len(names) > MAX_CELLS:
            raise InputError(f"more than {MAX_CELLS} numbers; cut the log")
        rows = []
        for cells in table:
            line = skipped + table.line_num
            if len(cells) != len(names):
                raise InputError(f"line {line}: {len(cells)} cells under {len(names)} columns")
            rows.append(_numbers(names, cells, line))
    except csv.Error as error:
        raise InputError(f"not comma-separated text ({error})") from error
    values = np.array(rows).reshape(len(rows), len(names))
    return {name: values[:, j] for j, name in enumerate(names)}


def _shown(cell: str) -> str:
    """A cell for a message; one of a file that is no table may be as long as that."""
    return repr(cell if len(cell) <= SHOWN else f"{cell[:SHOWN]}...")


def _numbers(names: Iterable[str], cells: Iterable[str], line: int) -> list[float]:
    """One row; NaN where a cell is empty."""
    values = []
    for name, cell in zip(names, cells, strict=True):
        try:
            value = float(cell.replace("_", "?")) if cell.strip() else None
        except ValueError as error:
            raise InputError(
                f"line {line}, column {_shown(name)}: {_shown(cell)} is no number"
            ) from error
        if value is not None and not np.isfinite(value):
            raise InputError(
                f"line {line}, column {_shown(name)}: {_shown(cell)} is not finite; leave a "
                "missing cell empty"
            )
        values.append(np.nan if value is None else value)
    return values
