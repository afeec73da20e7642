"""The electro-mechanical positioning system of Janot, Gautier and Brunot (2019), a MATLAB file.

`load/axis` is the controller's output over its limit of 10 V. Readings and commands of a row are of
one instant: the known controller, v = kp kv (target - q) - kv dq, gives the logged output to 0.1 V
with both taken from its own row, and to 3.4 V with either taken from a neighbouring one.

MATLAB's format 5 is read here, as far as columns of numbers go: SciPy's reader can crash the whole
process on a damaged file.
"""

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pup.errors import InputError
from pup.files import MISTAKES
from pup.importers.common import MAX_CELLS, Array, ImportOptions, finite
from pup.recording import Recording, from_columns

JOINT = "axis"
FULL_OUTPUT = 10.0  # V
COLUMNS = {"t": "time", "qg": f"target/{JOINT}", "qm": f"position/{JOINT}", "vir": f"load/{JOINT}"}

MAX_FILE = 64 * 2**20  # bytes
MAX_UNPACKED = 256 * 2**20  # bytes
HEADER = 128  # bytes; the last two tell the byte order
MATRIX, COMPRESSED = 14, 15
NUMBERS = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
NUMERIC_CLASSES = range(6, 16)  # double to uint64; the others are cells, structures, text, sparse
COMPLEX = 0x0800


def read(path: Path, options: ImportOptions) -> list[Recording]:
    """Read one file."""
    columns = {COLUMNS[name]: values for name, values in _load(path).items()}
    columns[f"load/{JOINT}"] = columns[f"load/{JOINT}"] / FULL_OUTPUT
    return [
        from_columns(
            options.metadata(
                {
                    "id": path.stem.lower(),
                    "robot": "emps",
                    "motion": "point_to_point",
                    "support": "bench",
                    "source": "hardware",
                }
            ),
            columns,
        )
    ]


def _load(path: Path) -> dict[str, Array]:
    """The variables of `COLUMNS`, each of shape (n_rows,)."""
    try:
        if path.stat().st_size > MAX_FILE:
            raise InputError(f"larger than {MAX_FILE} bytes; is this the right file?")
        content = path.read_bytes()
    except MISTAKES as error:
        raise InputError(f"cannot be read ({error.strerror})") from error
    order = {b"IM": "<", b"MI": ">"}.get(content[HEADER - 2 : HEADER])
    if order is None:
        raise InputError("not a MATLAB file of format 5")
    try:
        found = dict(_variables(content, order))
    except (struct.error, zlib.error, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"damaged MATLAB file ({error})") from error
    for name in COLUMNS:
        if name not in found:
            raise InputError(f"variable {name!r} is missing, or is not made of numbers")
    columns = {name: finite(found[name], name, (None, 1))[:, 0] for name in COLUMNS}
    if len({len(values) for values in columns.values()}) > 1:
        raise InputError(f"variables {', '.join(COLUMNS)} are not of one length")
    return columns


def _variables(content: bytes, order: str) -> Iterator[tuple[str, Array]]:
    """Numeric matrices by name."""
    left = MAX_UNPACKED
    for kind, data in _elements(content[HEADER:], order):
        if kind == COMPRESSED:
            data = zlib.decompressobj().decompress(data, left + 1)
            left -= len(data)
            if left < 0:
                raise InputError(f"more than {MAX_UNPACKED} bytes unpacked")
            kind, data = next(_elements(data, order), (0, b""))
        if kind == MATRIX and (variable := _matrix(data, order)) is not None:
            yield variable


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Type and content of the elements that stand behind one another."""
    at = 0
    while at < len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        start = at + 8
        if kind >> 16:  # a small element: size and type share four bytes, the content the next
            kind, size, start = kind & 0xFFFF, kind >> 16, at + 4
        content = data[start : start + size]
        if len(content) < size:
            raise ValueError("an element ends beyond the end")
        yield kind, content
        # Elements begin at multiples of 8 bytes, except behind a compressed one.
        at = start + size if kind == COMPRESSED else -(-(start + size) // 8) * 8


def _matrix(data: bytes, order: str) -> tuple[str, Array] | None:
    """Name and values of a real numeric matrix; None for anything else."""
    parts = list(_elements(data, order))
    if len(parts) < 4:
        return None
    (_, flags), (_, dimensions), (_, name), (kind, values) = parts[:4]
    (flag,) = struct.unpack_from(f"{order}I", flags)
    if flag & 0xFF not in NUMERIC_CLASSES or flag & COMPLEX or kind not in NUMBERS:
        return None
    shape = struct.unpack(f"{order}{len(dimensions) // 4}i", dimensions)
    if min(shape) < 0 or math.prod(shape) > MAX_CELLS // len(COLUMNS):
        raise InputError(f"variable {name.decode(errors='replace')!r} has shape {shape}")
    array = np.frombuffer(values, order + NUMBERS[kind]).astype(np.float64)
    return name.decode(errors="replace"), array.reshape(shape, order="F")
