"""LeRobotDataset v3.0: Parquet tables of frames at a fixed rate, and tables about them.

An episode is a recording, its task the motion type. `action` has the targets, `observation.state`
the positions, in joint order; `observation.velocity` and the like the other columns,
`observation.simulated_state` a replay. The format knows neither uneven time nor missing samples:
readings are interpolated onto the frames, commands held. Layout: huggingface/lerobot, v3.0.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pup.errors import InputError
from pup.exporters.common import Array, Take
from pup.files import write_json
from pup.recording import Recording
from pup.recording_rules import PER_JOINT

VERSION = "v3.0"
CHUNK = 1000  # files in a folder
FILE_SIZE = 100  # MB of frames in a file, about
VIDEO_SIZE = 200  # of no meaning here; readers ask for it
PLACE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
ACTION, STATE, SIMULATED = "action", "observation.state", "observation.simulated_state"
COUNTERS = ("frame_index", "episode_index", "index", "task_index")
HELD = ("target", "torque_enabled")
TURNING = ("imu/roll", "imu/yaw")
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
RATES = (1, 1000)  # Hz

Frames = dict[str, np.ndarray[Any, Any]]
"""Feature to values, shape (n_frames, n_names), or (n_frames,) for the counters and the time."""


@dataclass(frozen=True)
class Feature:
    """A vector in every frame.

    Attributes:
      columns: of the recordings, or of their replays.
      names: of its components.
      replayed: whether it is of the replays.
    """

    columns: tuple[str, ...]
    names: tuple[str, ...]
    replayed: bool = False


def write(takes: Sequence[Take], folder: Path, rate: int | None = None) -> dict[str, Any]:
    """Write a data set.

    Args:
      takes: all of one robot.
      folder: of the data set, empty.
      rate: frames per second; None for what the readings have most often.

    Returns:
      The rate as `fps`, and as `left_out` the columns that not every recording has, and the
      replays where one of them broke down.

    Raises:
      InputError: recordings of several robots, or too short for the rate.
    """
    robots = sorted({take.recording.robot for take in takes})
    joints = takes[0].recording.joints
    if len(robots) > 1 or any(set(t.recording.joints) != set(joints) for t in takes):
        raise InputError(
            f"recordings of robots {', '.join(robots)}, or of different joints; a LeRobot data set "
            "is of one robot: export each by itself"
        )
    rate = rate or _usual_rate(takes)
    features, left_out = _features(takes, joints)
    tasks = sorted({take.recording.motion for take in takes})
    store = _Store(folder, features)
    for take in takes:
        store.add(take, _frames(take, features, rate), tasks.index(take.recording.motion))
    store.close()
    _write_tasks(tasks, folder / "meta" / "tasks.parquet")
    write_json(folder / "meta" / "stats.json", _statistics(store.all_frames()))
    info = _info(robots[0], rate, store, len(tasks), features)
    write_json(folder / "meta" / "info.json", info)
    return {"fps": rate, "left_out": left_out}


def _usual_rate(takes: Sequence[Take]) -> int:
    """Of the readings: commands of a log that has times of its own stand in rows between them."""
    gaps = np.concatenate([np.diff(_read_times(take.recording)) for take in takes])
    return int(np.clip(round(1 / float(np.median(gaps))), *RATES))


def _read_times(recording: Recording) -> Array:
    """When positions were read; all times where that was but once."""
    read = ~np.isnan(recording.position).all(axis=1)
    return recording.time[read] if read.sum() > 1 else recording.time


def _features(
    takes: Sequence[Take], joints: Sequence[str]
) -> tuple[dict[str, Feature], tuple[str, ...]]:
    """The features that all frames have, and the columns that some recordings lack."""
    measured = [_measured(dict(take.recording.columns())) for take in takes]
    everywhere = set.intersection(*measured)
    features = {
        ACTION: Feature(tuple(f"target/{name}" for name in joints), tuple(joints)),
        STATE: Feature(tuple(f"position/{name}" for name in joints), tuple(joints)),
    }
    replayed = all(_replayed(take, joints) for take in takes)
    if replayed:
        columns = tuple(f"position/{name}" for name in joints)
        features[SIMULATED] = Feature(columns, tuple(joints), replayed=True)
    for kind in (*PER_JOINT[2:], "imu"):
        parts = [n for n in _columns(takes) if n.startswith(f"{kind}/") and n in everywhere]
        if parts:
            names = tuple(name.partition("/")[2] for name in parts)
            features[f"observation.{kind}"] = Feature(tuple(parts), names)
    for name in ("voltage", "torque_enabled"):
        if name in everywhere:
            features[f"observation.{name}"] = Feature((name,), (name,))
    some = set.union(*measured) - everywhere
    left_out = [name for name in _columns(takes) if name in some]
    left_out += [SIMULATED] if not replayed and any(take.simulated for take in takes) else []
    return features, tuple(left_out)


def _replayed(take: Take, joints: Sequence[str]) -> bool:
    """Whether there is a replay, and to the end."""
    columns = [take.simulated.get(f"position/{name}") for name in joints]
    return all(values is not None and not np.isnan(values).any() for values in columns)


def _measured(columns: Any) -> set[str]:
    """Columns with any sample."""
    return {name for name, values in columns.items() if not np.isnan(values).all()}


def _columns(takes: Sequence[Take]) -> list[str]:
    """All columns that there are, in their order."""
    return list(dict.fromkeys(name for take in takes for name, _ in take.recording.columns()))


def _frames(take: Take, features: dict[str, Feature], rate: int) -> Frames:
    """The features at the frames' times."""
    recording = take.recording
    elapsed = recording.time - recording.time[0]
    count = int(elapsed[-1] * rate + 1e-9) + 1
    if count < 2:
        raise InputError(
            f"recording {recording.id!r} lasts {elapsed[-1]:g} s, which gives one frame at {rate} "
            "fps; use a higher --fps"
        )
    time = np.arange(count) / rate
    own, replayed = dict(recording.columns()), take.simulated
    frames: Frames = {}
    for key, feature in features.items():
        source = replayed if feature.replayed else own
        values = [_resampled(name, elapsed, source[name], time) for name in feature.columns]
        frames[key] = np.stack(values, axis=1).astype(np.float32)
    return frames | {"timestamp": time.astype(np.float32)}


def _resampled(name: str, time: Array, values: Array, at: Array) -> Array:
    """A column at other times, from its samples; the first and last one hold beyond them."""
    known = ~np.isnan(values)
    time, values = time[known], values[known]
    if name.partition("/")[0] in HELD:
        before = np.searchsorted(time, at + 1e-9, side="right") - 1
        return np.asarray(values[np.maximum(before, 0)])
    return _turned(time, values, at) if name in TURNING else np.asarray(np.interp(at, time, values))


def _turned(time: Array, values: Array, at: Array) -> Array:
    """An angle at other times, rad: from one side of half a turn it goes to the other, not back."""
    told = np.asarray(np.interp(at, time, np.unwrap(values)))
    whole = np.abs(values).max() > np.pi  # told unwrapped already
    return told if whole else np.asarray((told + np.pi) % (2 * np.pi) - np.pi)


class _Store:
    """Writes episodes one after the other, and then the table of them."""

    def __init__(self, folder: Path, features: dict[str, Feature]) -> None:
        self.folder = folder
        self.total = 0
        self.episodes: list[dict[str, Any]] = []
        self._frames: list[Frames] = []
        self._size, self._file = 0, 0
        self._writer: Any = None
        self._schema = pa.schema(
            [(key, _type(len(feature.names))) for key, feature in features.items()]
            + [("timestamp", pa.float32())]
            + [(key, pa.int64()) for key in COUNTERS]
        )

    def add(self, take: Take, frames: Frames, task: int) -> None:
        count, episode = len(frames["timestamp"]), len(self.episodes)
        frames |= {
            "frame_index": np.arange(count),
            "episode_index": np.full(count, episode),
            "index": self.total + np.arange(count),
            "task_index": np.full(count, task),
        }
        size = sum(values.nbytes for values in frames.values())
        if self._size and self._size + size > FILE_SIZE * 10**6:
            self._end_file()
            self._size, self._file = 0, self._file + 1
        self._size += size
        table = pa.table([_array(frames[f.name]) for f in self._schema], schema=self._schema)
        if self._writer is None:
            path = self.folder / "data" / PLACE.format(**_place(self._file))
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = pq.ParquetWriter(path, self._schema)
        self._writer.write_table(table)
        self._frames.append(frames)
        self.episodes.append(self._episode(take, frames, count))
        self.total += count

    def _episode(self, take: Take, frames: Frames, count: int) -> dict[str, Any]:
        row: dict[str, Any] = {
            "episode_index": len(self.episodes),
            "tasks": [take.recording.motion],
            "length": count,
            **{f"data/{key}": value for key, value in _place(self._file).items()},
            "dataset_from_index": self.total,
            "dataset_to_index": self.total + count,
            **{f"meta/episodes/{key}": value for key, value in _place(0).items()},
            "pup.recording": json.dumps(take.recording.metadata()),
        }
        for feature, told in _statistics(frames).items():
            row |= {f"stats/{feature}/{name}": values for name, values in told.items()}
        return row

    def _end_file(self) -> None:
        self._writer.close()
        self._writer = None

    def close(self) -> None:
        """End the last file and write the table of episodes."""
        self._end_file()
        path = self.folder / "meta" / "episodes" / PLACE.format(**_place(0))
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.Table.from_pylist(self.episodes), path)

    def all_frames(self) -> Frames:
        """The frames of all episodes."""
        return {key: np.concatenate([f[key] for f in self._frames]) for key in self._frames[0]}


def _place(file: int) -> dict[str, int]:
    return {"chunk_index": file // CHUNK, "file_index": file % CHUNK}


def _type(width: int) -> pa.DataType:
    """Of a feature; those of one component are plain numbers, as in LeRobot's own files."""
    return pa.float32() if width == 1 else pa.list_(pa.float32(), width)


def _array(values: np.ndarray[Any, Any]) -> pa.Array:
    if values.ndim == 2 and values.shape[1] > 1:
        return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])
    return pa.array(values.ravel())


def _statistics(frames: Frames) -> dict[str, dict[str, list[float]]]:
    """Of every feature, by component."""
    told = {}
    for key, values in frames.items():
        table = values.reshape(len(values), -1).astype(np.float64)
        told[key] = {
            "min": table.min(axis=0).tolist(),
            "max": table.max(axis=0).tolist(),
            "mean": table.mean(axis=0).tolist(),
            "std": table.std(axis=0).tolist(),
            "count": [len(table)],
        } | {n: np.quantile(table, q, axis=0).tolist() for n, q in QUANTILES.items()}
    return told


def _write_tasks(tasks: list[str], path: Path) -> None:
    """The tasks as the data frame that LeRobot reads: their texts are its index."""
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": tasks})
    kinds = (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    columns = [
        {"name": n, "field_name": n, "pandas_type": p, "numpy_type": t, "metadata": None}
        for n, p, t in kinds
    ]
    frame = {"index_columns": ["task"], "column_indexes": [], "columns": columns}
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(frame)}), path)


def _info(
    robot: str, rate: int, store: _Store, tasks: int, features: dict[str, Feature]
) -> dict[str, Any]:
    told: dict[str, Any] = {
        key: {"dtype": "float32", "shape": [len(f.names)], "names": list(f.names)}
        for key, f in features.items()
    }
    told["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    told |= {key: {"dtype": "int64", "shape": [1], "names": None} for key in COUNTERS}
    return {
        "codebase_version": VERSION,
        "robot_type": robot,
        "total_episodes": len(store.episodes),
        "total_frames": store.total,
        "total_tasks": tasks,
        "chunks_size": CHUNK,
        "data_files_size_in_mb": FILE_SIZE,
        "video_files_size_in_mb": VIDEO_SIZE,
        "fps": rate,
        "splits": {"train": f"0:{len(store.episodes)}"},
        "data_path": f"data/{PLACE}",
        "video_path": None,
        "features": told,
    }
