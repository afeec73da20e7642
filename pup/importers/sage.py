"""Logs of SAGE (isaac-sim2real/sage): a folder with `control.csv` and `state_motor.csv`.

Timestamps are microseconds, vectors JSON lists in the order of `joint_list.txt`. The collector
takes the time, writes the commands and then reads the servos one by one, so a position is younger
than its row by up to the 20 ms of a loop. Torques are estimates from current and have no column in
a recording. The SO-101's jaw is logged as a fraction of its range, not in rad (its position steps
by 1/1522, those of the other joints by 2 pi/4096), and is left out. The recording notes both.
"""

import csv
import io
from pathlib import Path

import numpy as np

from pup.errors import InputError
from pup.importers.common import (
    MAX_CELLS,
    Array,
    ImportOptions,
    finite,
    join,
    joint_columns,
    parse_json,
    read_text,
)
from pup.recording import Recording, from_columns

MICROSECOND = 1e-6
MOTIONS = {"chirp": "chirp", "triangle": "triangle", "step": "step", "hold": "hold"}
SO101 = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw")


def read(path: Path, options: ImportOptions) -> list[Recording]:
    """Read one folder, given by itself or by its `control.csv`."""
    folder = path if path.is_dir() else path.parent
    names = [line.strip() for line in _read(folder / "joint_list.txt").splitlines()]
    names = [name for name in names if name]
    if len(set(names)) < len(names) or not names:
        raise InputError("joint_list.txt: needs one line per joint, each with its own name")
    command_time, commands = _table(folder / "control.csv", ("positions",), len(names))
    state_time, states = _table(folder / "state_motor.csv", ("positions", "velocities"), len(names))
    so101 = tuple(names) == SO101
    kept = [j for j, name in enumerate(names) if not (so101 and name == "Jaw")]
    joints = [names[j] for j in kept]
    columns, left_out = join(
        command_time,
        state_time,
        joint_columns("target", joints, commands["positions"][:, kept]),
        joint_columns("position", joints, states["positions"][:, kept])
        | joint_columns("velocity", joints, states["velocities"][:, kept]),
    )
    notes = "Torques estimated from current left out."
    if len(joints) < len(names):
        notes += " Jaw left out: logged as a fraction of its range, not in rad."
    stem = folder.resolve().name
    return [
        from_columns(
            options.metadata(
                {
                    "id": stem,
                    "robot": "so101" if so101 else None,
                    "motion": next((kind for word, kind in MOTIONS.items() if word in stem), stem),
                    "support": "bench" if so101 else None,
                    "source": "hardware",
                    "notes": f"{notes} {left_out}".strip(),
                }
            ),
            columns,
        )
    ]


def _read(path: Path) -> str:
    try:
        return read_text(path)
    except InputError as error:
        raise InputError(f"{path.name}: {error}") from error


def _table(path: Path, wanted: tuple[str, ...], joints: int) -> tuple[Array, dict[str, Array]]:
    """Times in s, shape (n_rows,), and vectors, shape (n_rows, n_joints)."""
    lines = io.StringIO(_read(path), newline="")
    rows: dict[str, list[object]] = {name: [] for name in ("timestamp", *wanted)}
    try:
        table = csv.DictReader(lines, strict=True)
        for cells in table:
            for name, values in rows.items():
                cell = cells.get(name)
                if cell is None:
                    raise InputError(f"line {table.line_num}: column {name!r} is missing")
                try:
                    values.append(parse_json(cell))
                except InputError as error:
                    raise InputError(f"line {table.line_num}, column {name!r}: {error}") from error
            if len(rows["timestamp"]) * joints > MAX_CELLS:
                raise InputError(f"more than {MAX_CELLS} numbers; cut the log")
        time = finite(rows["timestamp"], "timestamp", (None,)) * MICROSECOND
        vectors = {
            name: finite(rows[name], name, (len(time), joints))
            if len(time)
            else np.empty((0, joints))
            for name in wanted
        }
    except (InputError, csv.Error) as error:
        raise InputError(f"{path.name}: {error}") from error
    return time, vectors
