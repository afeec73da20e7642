"""Recordings: what is refused, with file, column and row, and damaged files."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import COLUMNS, METADATA, make, write_table

from pup import recording_file as module
from pup.errors import InputError
from pup.recording import KEY, Recording


def column(name: str, row: int, value: float | None) -> dict[str, Any]:
    return {**COLUMNS, name: [*COLUMNS[name][:row], value, *COLUMNS[name][row + 1 :]]}


def without(name: str) -> dict[str, Any]:
    return {key: values for key, values in COLUMNS.items() if key != name}


NAN = pa.array([0.0, float("nan"), 0.0, 0.0])
REFUSED_COLUMNS = {
    "unsorted time": (column("time", 2, 0.01), ["'time'", "row 2", "is before"]),
    "duplicate time": (column("time", 2, 0.05), ["'time'", "row 2", "repeats"]),
    "no time in a row": (column("time", 1, None), ["'time'", "row 1", "missing"]),
    "time in milliseconds": (column("time", 3, 1e6), ["'time'", "seconds"]),
    "no time": (without("time"), ["'time' is missing"]),
    "one row": ({k: v[:1] for k, v in COLUMNS.items() if k != "velocity/a"}, ["'time'", "1 rows"]),
    "no rows": ({k: [] for k in COLUMNS}, ["no sample"]),
    "infinite": (column("position/a", 2, float("inf")), ["'position/a'", "row 2", "inf"]),
    "NaN": ({**COLUMNS, "position/b": NAN}, ["'position/b'", "row 1", "nan", "null"]),
    "NaN in an extra": ({**COLUMNS, "voltage": NAN}, ["'voltage'", "row 1", "nan"]),
    "no target": (
        {k: v for k, v in COLUMNS.items() if "/a" not in k and "/b" not in k},
        ["target"],
    ),
    "target without position": (without("position/b"), ["'target/b'", "'position/b'"]),
    "position without target": (without("target/b"), ["'position/b'", "'target/b'"]),
    "unmeasured joint": ({**COLUMNS, "position/a": [None] * 4}, ["'position/a'", "no sample"]),
    "unknown column": ({**COLUMNS, "speed/a": [0.0] * 4}, ["'speed/a'"]),
    "unknown IMU column": ({**COLUMNS, "imu/gyro_w": [0.0] * 4}, ["'imu/gyro_w'"]),
    "extra of a stranger": ({**COLUMNS, "velocity/c": [0.0] * 4}, ["'velocity/c'"]),
    "nameless joint": ({**COLUMNS, "target/": [0.0] * 4, "position/": [0.0] * 4}, ["joint ''"]),
    "torque half on": (column("torque_enabled", 2, 0.5), ["'torque_enabled'", "row 2"]),
    "integers": ({**COLUMNS, "voltage": pa.array([1, 2, 3, 4])}, ["'voltage'", "int64"]),
    "float32": (
        {**COLUMNS, "voltage": pa.array([1, 2, 3, 4], pa.float32())},
        ["'voltage'", "float", "float64"],
    ),
    "text": ({**COLUMNS, "voltage": pa.array(["1"] * 4)}, ["'voltage'", "string"]),
    "lists": ({**COLUMNS, "voltage": pa.array([[1.0]] * 4)}, ["'voltage'", "list"]),
}


@pytest.mark.parametrize("case", REFUSED_COLUMNS)
def test_refuses_columns_that_break_a_rule(tmp_path: Path, case: str) -> None:
    columns, told = REFUSED_COLUMNS[case]
    path = write_table(tmp_path / "bad.parquet", columns)
    with pytest.raises(InputError) as caught:
        Recording.read(path)
    for words in [str(path), *told]:
        assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_refuses_a_column_that_stands_twice(tmp_path: Path) -> None:
    arrays = [pa.array(values, pa.float64()) for values in COLUMNS.values()]
    table = pa.Table.from_arrays([*arrays, arrays[1]], names=[*COLUMNS, "target/a"])
    pq.write_table(table.replace_schema_metadata({KEY: json.dumps(METADATA)}), tmp_path / "x")
    with pytest.raises(InputError, match="'target/a' stands twice"):
        Recording.read(tmp_path / "x")


HALF = "half \ud800 a character"
"""JSON can hold it; no page, report or terminal can."""
REFUSED_METADATA: dict[str, Any] = {
    "schema": [2, 0, None, "1", True, 1.5],
    "id": ["", None, 3, "a/b", "..", ".hidden", "a\\b", "a\nb", "x" * 300],
    "robot": ["", None, 7, HALF],
    "motion": ["", None, ["step"], HALF],
    "support": ["table", None, 1, ["bench"]],
    "source": ["dream", None],
    "setup": [None, [], *({"mass": value} for value in ("1", None, True, 10**400)), {HALF: 1}],
    "repeat_of": ["", 5, HALF],
    "notes": [None, 5, HALF],
}


@pytest.mark.parametrize(
    ("key", "value"), [(k, v) for k, values in REFUSED_METADATA.items() for v in values]
)
def test_refuses_metadata_that_break_a_rule(tmp_path: Path, key: str, value: Any) -> None:
    path = write_table(tmp_path / "bad.parquet", COLUMNS, METADATA | {key: value})
    with pytest.raises(InputError, match=f"'{key}'") as caught:
        Recording.read(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    "raw", [b"", b"{", b"[]", b"1", b"\xff\xfe", b"[" * 100_000, b'{"schema": 1}', b"NaN"]
)
def test_refuses_metadata_that_are_no_metadata(tmp_path: Path, raw: bytes) -> None:
    with pytest.raises(InputError, match="metadata"):
        Recording.read(write_table(tmp_path / "bad.parquet", COLUMNS, raw))


def test_refuses_a_parquet_file_that_is_no_recording(tmp_path: Path) -> None:
    pq.write_table(pa.table({"time": [0.0, 1.0]}), tmp_path / "x.parquet")
    with pytest.raises(InputError, match=r"x\.parquet: no metadata 'pup\.recording'"):
        Recording.read(tmp_path / "x.parquet")


@pytest.mark.parametrize("content", [b"", b"PAR1", b"hello" * 100, b"PAR1" + bytes(8) + b"PAR1"])
def test_refuses_what_is_no_parquet_file(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "x.parquet").write_bytes(content)
    with pytest.raises(InputError, match="Parquet"):
        Recording.read(tmp_path / "x.parquet")
    with pytest.raises(InputError, match="cannot be read"):
        Recording.read(tmp_path / "absent.parquet")
    with pytest.raises(InputError, match="not a file"):
        Recording.read(tmp_path)


def test_refuses_by_the_footer_before_data_is_unpacked(tmp_path: Path, monkeypatch: Any) -> None:
    """Ten million equal numbers pack into a few kB: the footer tells what they would become."""
    path = tmp_path / "bomb.parquet"
    zeros = pa.array(np.zeros(10_000_000))
    pq.write_table(pa.table({name: zeros for name in ("a", "b", "c")}), path, compression="zstd")
    assert path.stat().st_size < 1_000_000

    def unpack(*_: Any, **__: Any) -> None:
        raise AssertionError("data was read")

    monkeypatch.setattr(pq.ParquetFile, "read", unpack)
    with pytest.raises(InputError, match="10000000 rows of 3 columns"):
        Recording.read(path)


def test_refuses_large_files_and_wide_tables(tmp_path: Path, monkeypatch: Any) -> None:
    path = write_table(tmp_path / "r.parquet", COLUMNS)
    for limit, value in (("MAX_FILE", 100), ("MAX_COLUMNS", 3), ("MAX_UNPACKED", 10)):
        with monkeypatch.context() as patch:
            patch.setattr(module, limit, value)
            with pytest.raises(InputError, match="at most"):
                Recording.read(path)
    monkeypatch.setattr(module, "MAX_METADATA", 10)
    with pytest.raises(InputError, match="metadata"):
        Recording.read(path)


def test_what_could_not_be_read_again_is_not_written(tmp_path: Path, monkeypatch: Any) -> None:
    path = tmp_path / "r.parquet"
    with pytest.raises(InputError, match=r"'r1': metadata 'pup\.recording' has 1048"):
        make(notes="x" * module.MAX_METADATA).write(path)
    monkeypatch.setattr(module, "MAX_CELLS", 14)
    with pytest.raises(InputError, match="'r1': 3 rows of 5 columns"):
        make().write(path)
    assert not path.exists()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: Any) -> bytes:
    path = tmp_path_factory.mktemp("whole") / "r.parquet"
    make(extras={"voltage": [1.0, np.nan, 2.0]}).write(path)
    return path.read_bytes()


@settings(max_examples=150)
@given(cut=st.integers(0, 10_000))
def test_refuses_every_truncated_file(tmp_path_factory: Any, whole: bytes, cut: int) -> None:
    path = tmp_path_factory.mktemp("cut") / "r.parquet"
    path.write_bytes(whole[: cut % len(whole)])
    with pytest.raises(InputError):
        Recording.read(path)


@settings(max_examples=300)
@given(place=st.integers(0, 10_000), bits=st.integers(1, 255))
def test_a_flipped_byte_is_refused_or_harmless(
    tmp_path_factory: Any, whole: bytes, place: int, bits: int
) -> None:
    """Never another exception; and never other samples, for the pages carry checksums."""
    damaged = bytearray(whole)
    damaged[place % len(whole)] ^= bits
    path = tmp_path_factory.mktemp("flip") / "r.parquet"
    path.write_bytes(damaged)
    try:
        recording = Recording.read(path)
    except InputError:
        return
    kept = dict(make(extras={"voltage": [1.0, np.nan, 2.0]}).columns())
    for name, values in recording.columns():
        assert np.array_equal(values, kept[name], equal_nan=True)


def test_an_id_is_as_long_as_a_file_s_name_may_be(tmp_path: Path) -> None:
    """File systems count bytes, of which most characters of the world have several."""
    make(id="é" * 115).write(tmp_path / f"{'é' * 115}.parquet")
    with pytest.raises(InputError, match="over 120 characters, or 230 bytes"):
        make(id="歩" * 80)


def test_construction_refuses_what_a_file_could_not_hold() -> None:
    cases: list[tuple[dict[str, Any], str]] = [
        ({"joints": ()}, "no target"),
        ({"joints": ("a", "a")}, "stands twice"),
        ({"target": np.zeros((3, 1))}, "target has shape"),
        ({"position": np.zeros((2, 2))}, "position has shape"),
        ({"time": np.zeros((3, 1))}, "one axis"),
        ({"time": 3.0}, "one axis"),
        ({"time": ["a", "b", "c"]}, "not made of numbers"),
        ({"extras": {"voltage": [1.0]}}, "'voltage' has shape"),
        ({"extras": {"volts": [1.0] * 3}}, "'volts' is not one"),
        ({"extras": {"target/a": [1.0] * 3}}, "'target/a'"),
        ({"setup": None}, "'setup'"),
        ({"setup": {"mass": np.inf}}, "'setup'"),
        ({"support": "air"}, "'support'"),
    ]
    for changes, told in cases:
        with pytest.raises(InputError, match=told):
            make(**changes)
