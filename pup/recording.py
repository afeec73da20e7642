"""A recording: what a robot was told and what it did, one Parquet file each, read strictly.

Columns are float64 in SI units and radians, one row per control tick, and time need not be uniform.
A missing sample is null in the file and NaN in memory; a NaN in the file is refused.
"""

import hashlib
import io
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from pup.errors import InputError
from pup.files import write_atomic
from pup.recording_file import KEY, check_footer, read_columns, visible
from pup.recording_rules import (
    SCHEMA,
    check_extra,
    check_joints,
    check_metadata,
    check_units,
    check_values,
)
from pup.robot import RobotDescription

Array = NDArray[np.float64]

_CORE = ("time", "target", "position")


@dataclass(frozen=True, eq=False)
class Recording:
    """One recording, complete and valid: making an invalid one raises `InputError`.

    Attributes:
      id: its name, unique within a set; also its file name without `.parquet`.
      robot: name of the robot.
      motion: motion type, such as `step` or `standup`.
      support: `suspended`, `ground` or `bench`.
      source: `hardware`, `simulation` or `unknown`.
      joints: joint names in file order.
      time: shape (n_ticks,), s, strictly increasing.
      target: commands sent at `time` and held, shape (n_ticks, n_joints), rad.
      position: encoder readings taken at `time`, shape (n_ticks, n_joints), rad.
      extras: the other columns under their names in the file, each of shape (n_ticks,).
      setup: what was knowingly changed for this recording, by the robot's knobs.
      repeat_of: id of the recording this one repeats.
      notes: free text.
    """

    id: str
    robot: str
    motion: str
    support: str
    source: str
    joints: tuple[str, ...]
    time: Array
    target: Array
    position: Array
    extras: Mapping[str, Array] = field(default_factory=dict)
    setup: Mapping[str, float] = field(default_factory=dict)
    repeat_of: str | None = None
    notes: str = ""

    def __post_init__(self) -> None:
        """Check everything and take read-only copies of the arrays."""
        try:
            if not isinstance(self.setup, Mapping):
                raise InputError("metadata 'setup' is not an object of knobs and numbers")
            check_metadata(self.metadata())
            check_joints(tuple(self.joints))
            own: dict[str, Any] = {"joints": tuple(self.joints)}
            own |= {name: _frozen(name, getattr(self, name)) for name in _CORE}
            own["extras"] = {name: _frozen(name, values) for name, values in self.extras.items()}
            own["setup"] = {name: float(value) for name, value in self.setup.items()}
            for name, value in own.items():
                object.__setattr__(self, name, value)
            self._check_shapes()
            check_values(dict(self.columns()))
        except InputError as error:
            raise InputError(f"recording {self.id!r}: {error}") from error

    def _check_shapes(self) -> None:
        if self.time.ndim != 1:
            raise InputError(f"column 'time' has shape {self.time.shape}; it must have one axis")
        rows = (len(self.time),)
        for name, values in (("target", self.target), ("position", self.position)):
            if values.shape != (*rows, len(self.joints)):
                raise InputError(
                    f"{name} has shape {values.shape}; the time and joints given need "
                    f"{(*rows, len(self.joints))}"
                )
        for name, values in self.extras.items():
            check_extra(name, self.joints)
            if values.shape != rows:
                raise InputError(f"column {name!r} has shape {values.shape}, time has {rows}")

    def _check_first_targets(self) -> None:
        """Refuse what no replay can begin with: what held a joint until its first command."""
        for name, told in zip(self.joints, ~np.isnan(self.target.T), strict=True):
            if not told[0]:
                row = int(np.argmax(told))
                raise InputError(
                    f"column 'target/{name}' has no value before row {row}, so nobody knows what "
                    f"held the joint until then; leave the rows before {row} out"
                )

    def columns(self) -> Iterator[tuple[str, Array]]:
        """The columns of the file in order: time, targets, positions, the rest."""
        yield "time", self.time
        for kind in ("target", "position"):
            values = getattr(self, kind)
            yield from ((f"{kind}/{name}", values[:, j]) for j, name in enumerate(self.joints))
        yield from self.extras.items()

    def metadata(self) -> dict[str, Any]:
        """What the file says of itself, as JSON values."""
        return {
            "schema": SCHEMA,
            "id": self.id,
            "robot": self.robot,
            "motion": self.motion,
            "support": self.support,
            "setup": dict(self.setup),
            "source": self.source,
            "repeat_of": self.repeat_of,
            "notes": self.notes,
        }

    @property
    def digest(self) -> str:
        """SHA-256 over metadata and columns, in hexadecimal; independent of the column order."""
        digest = hashlib.sha256(json.dumps(self.metadata(), sort_keys=True).encode())
        for name, values in sorted(self.columns()):
            digest.update(f"\n{name}\n".encode())
            digest.update(np.ascontiguousarray(values).tobytes())
        return digest.hexdigest()

    def validate(self, robot: RobotDescription) -> None:
        """Check that it can be replayed with this robot: joints, name, base, knobs and units.

        Raises:
          InputError: one of them does not fit.
        """
        unknown = [name for name in self.joints if name not in robot.joint_names]
        absent = [name for name in robot.joint_names if name not in self.joints]
        if unknown or absent:
            told = [f"unknown joints {', '.join(unknown)}"] if unknown else []
            told += [f"joints {', '.join(absent)} not recorded"] if absent else []
            raise InputError(
                f"recording {self.id!r} (of robot {self.robot!r}): {' and '.join(told)} for robot "
                f"{robot.name!r}; a recording must cover exactly the robot's joints"
            )
        if self.robot != robot.name:
            raise InputError(
                f"recording {self.id!r} is of robot {self.robot!r}, not of {robot.name!r}; name "
                "that one with --robot, or import the logs again for this one"
            )
        wrong = "bench" if robot.floating else "ground"
        if self.support == wrong:
            base, right = ("free", "suspended") if robot.floating else ("fixed", "bench")
            raise InputError(
                f"recording {self.id!r}: its support is {wrong!r}, but the base of robot "
                f"{robot.name!r} is {base} in model.xml; should the support be {right!r}?"
            )
        try:
            self._check_first_targets()
            robot.setup(self.setup)
            check_units(robot.joints, dict(self.columns()))
        except InputError as error:
            raise InputError(f"recording {self.id!r}: {error}") from error

    def write(self, path: Path) -> None:
        """Write the recording as Parquet, whole or not at all.

        Raises:
          InputError: it is larger than what `read` takes.
        """
        columns = {name: _nullable(values) for name, values in self.columns()}
        table = pa.table(columns).replace_schema_metadata({KEY: json.dumps(self.metadata())})
        buffer = io.BytesIO()
        pq.write_table(table, buffer, compression="zstd", write_page_checksum=True)
        try:
            check_footer(pq.ParquetFile(buffer))
        except InputError as error:
            raise InputError(f"recording {self.id!r}: {error}") from error
        write_atomic(path, buffer.getvalue())

    @classmethod
    def read(cls, path: Path) -> "Recording":
        """Read a recording.

        Raises:
          InputError: the file breaks a rule; the message names file, column and row.
        """
        try:
            metadata, columns = read_columns(path)
            return from_columns(metadata, columns)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error


def _nullable(values: Array) -> pa.Array:
    """Numbers with NaN as null; by their buffers, as `pa.array` would import pandas: 50 MB."""
    there = ~np.isnan(values)
    bits = None if there.all() else pa.py_buffer(np.packbits(there, bitorder="little"))
    data = pa.py_buffer(np.ascontiguousarray(values, dtype=np.float64))
    return pa.Array.from_buffers(pa.float64(), len(values), [bits, data])


def from_columns(metadata: object, columns: Mapping[str, Array]) -> Recording:
    """Make a recording of named columns, as a file holds them.

    Args:
      metadata: the JSON object of the contract.
      columns: contract name to values of shape (n_ticks,); NaN is a missing sample.

    Raises:
      InputError: something does not follow the contract.
    """
    known = check_metadata(metadata)
    if "time" not in columns:
        raise InputError("column 'time' is missing")
    joints = tuple(name.split("/", 1)[1] for name in columns if name.startswith("target/"))
    check_joints(joints)
    measured = {name.split("/", 1)[1] for name in columns if name.startswith("position/")}
    for name in joints:
        if name not in measured:
            raise InputError(f"column 'target/{name}' has no column 'position/{name}' beside it")
    for name in sorted(measured.difference(joints)):
        raise InputError(f"column 'position/{name}' has no column 'target/{name}' beside it")
    core = {"time"} | {f"{kind}/{name}" for kind in ("target", "position") for name in joints}
    for name in columns:
        if name not in core:
            check_extra(name, joints)
    return Recording(
        id=known["id"],
        robot=known["robot"],
        motion=known["motion"],
        support=known["support"],
        source=known["source"],
        joints=joints,
        time=columns["time"],
        target=np.stack([columns[f"target/{name}"] for name in joints], axis=1),
        position=np.stack([columns[f"position/{name}"] for name in joints], axis=1),
        extras={name: values for name, values in columns.items() if name not in core},
        setup=known.get("setup", {}),
        repeat_of=known.get("repeat_of"),
        notes=known.get("notes", ""),
    )


def _in_folder(folder: Path) -> list[Path]:
    """Recordings of a folder; those of its own folders are not left out in silence."""
    found = visible(folder, "*.parquet")
    if found and (others := visible(folder, "*/*.parquet")):
        raise InputError(
            f"{folder}: {others[0].parent.name} in it holds recordings too; move them up, or "
            "elsewhere"
        )
    if not found and (others := visible(folder, "**/*.parquet")):
        raise InputError(
            f"{folder}: no *.parquet in this folder, but in {others[0].parent}; name that"
        )
    if not found:
        raise InputError(f"{folder}: no *.parquet in this folder; see `pup import`")
    return found


def load_recordings(
    paths: Sequence[Path], robot: RobotDescription | None = None
) -> tuple[Recording, ...]:
    """Read recordings from files and folders, sorted by id.

    Args:
      paths: Parquet files, or folders that hold some.
      robot: when given, every recording must be one that this robot can replay.

    Raises:
      InputError: nothing found, a folder's own folders hold some, an id stands twice, or a
        recording breaks a rule; the message names the file.
    """
    files: list[Path] = []
    for path in map(Path, paths):
        files += _in_folder(path) if path.is_dir() else [path]
    if not files:
        raise InputError("no recording given; name Parquet files or folders of them")
    origin: dict[str, Path] = {}
    recordings = []
    for file in files:
        recording = Recording.read(file)
        if robot is not None:
            try:
                recording.validate(robot)
            except InputError as error:
                raise InputError(f"{file}: {error}") from error
        if recording.id in origin:
            if file.resolve() == origin[recording.id].resolve():
                raise InputError(f"{file}: is given twice; name it once")
            raise InputError(
                f"{file}: id {recording.id!r} is also that of {origin[recording.id]}; "
                "every recording needs its own"
            )
        origin[recording.id] = file
        recordings.append(recording)
    return tuple(sorted(recordings, key=lambda recording: recording.id))


def originals(recordings: Sequence[Recording]) -> list[str]:
    """The id of what each recording repeats in the end, its own where that is nothing.

    Where several repeat one another, it is one of them.
    """
    repeats = {recording.id: recording.repeat_of for recording in recordings}

    def first(name: str) -> str:
        seen: list[str] = []
        while (before := repeats.get(name)) is not None and name not in seen:
            seen.append(name)
            name = before
        return min(seen[seen.index(name) :]) if name in seen else name

    return [first(recording.id) for recording in recordings]


def check_distinct(recordings: Iterable[Recording]) -> None:
    """Refuse two recordings of one id: a file of its name would hold one of them.

    Raises:
      InputError: an id stands twice.
    """
    seen: set[str] = set()
    for recording in recordings:
        if recording.id in seen:
            raise InputError(f"two recordings have the id {recording.id!r}; each needs its own")
        seen.add(recording.id)


def write_recordings(recordings: Sequence[Recording], folder: Path) -> tuple[Path, ...]:
    """Write recordings into a folder, named by their ids: all of them or, on an error, none.

    Args:
      recordings: each with an id of its own.
      folder: made when absent.

    Returns:
      The files, in the order of the recordings.

    Raises:
      InputError: an id stands twice, as of two cuts that begin together.
    """
    check_distinct(recordings)
    folder.mkdir(parents=True, exist_ok=True)
    files = tuple(folder / f"{recording.id}.parquet" for recording in recordings)
    with TemporaryDirectory(dir=folder, prefix=".new-") as new:
        for recording, file in zip(recordings, files, strict=True):
            recording.write(Path(new) / file.name)
        for file in files:
            os.replace(Path(new) / file.name, file)
    return files


def _frozen(name: str, values: object) -> Array:
    """A read-only float64 copy in which every NaN has the same bits."""
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"column {name!r} is not made of numbers ({error})") from error
    array[np.isnan(array)] = np.nan
    array.setflags(write=False)
    return array
