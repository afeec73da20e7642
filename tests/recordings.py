"""A small recording and the raw file behind one, for the tests of recordings."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pup.recording import KEY, Recording

METADATA: dict[str, Any] = {
    "schema": 1,
    "id": "step_1",
    "robot": "arm",
    "motion": "step",
    "support": "bench",
    "setup": {"mass": 0.5},
    "source": "hardware",
    "repeat_of": None,
    "notes": "",
}
COLUMNS: dict[str, list[float | None]] = {
    "time": [0.0, 0.05, 0.1, 0.17],
    "target/a": [0.0, 1.0, 1.0, None],
    "target/b": [0.0, -1.0, -1.0, -1.0],
    "position/a": [0.0, 0.0, 0.5, 0.9],
    "position/b": [0.0, None, -0.5, -0.9],
    "velocity/a": [None, None, 8.0, 6.0],
    "voltage": [12.0, 11.5, 11.0, None],
    "imu/gyro_y": [0.0, 0.1, 0.2, 0.3],
    "torque_enabled": [1.0, 1.0, 0.0, None],
}


def write_table(path: Path, columns: dict[str, Any], metadata: object = None) -> Path:
    """A Parquet file of raw columns; nothing checks them here."""
    arrays = {
        name: values if isinstance(values, pa.Array) else pa.array(values, pa.float64())
        for name, values in columns.items()
    }
    told = METADATA if metadata is None else metadata
    raw = told if isinstance(told, bytes) else json.dumps(told).encode()
    pq.write_table(pa.table(arrays).replace_schema_metadata({KEY: raw}), path)
    return path


def make(**changes: Any) -> Recording:
    known = {
        "id": "r1",
        "robot": "arm",
        "motion": "step",
        "support": "bench",
        "source": "simulation",
        "joints": ("a", "b"),
        "time": [0.0, 0.1, 0.3],
        "target": [[0.0, 1.0], [1.0, 0.0], [1.0, 0.0]],
        "position": [[0.0, 1.0], [0.1, 0.9], [np.nan, 0.2]],
    }
    return Recording(**(known | changes))
