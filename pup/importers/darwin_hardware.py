"""Logs of the paper's authors from their Darwin OP2 (dabs, `hw_generate_data.py`, as JSON).

Timing, from the authors' loop and confirmed on the recordings: row 0 is read before the loop
starts, while the robot holds the first keyframe; row i >= 1 is read 1 to 4 ms (by the bus's speed)
after the command of loop tick i - 1, due at (i - 1) dt, is sent. So the command of row i is the
last keyframe due by (i - 1) dt, not by i dt. In all 60 moves of the 15 step tests the joints travel
at most 3.5 % of a step up to the row of its command and 30 to 88 % of it by the next; in the first
moves, which start from rest, at most 0.4 %, more in servos that the bulk read reaches later (0.16
mrad for ids 1 to 6, 0.70 mrad for 19 and 20). A servo model fitted with this timing leaves 0.015
rad RMS; read a row earlier it would leave 0.076 rad.

The gyroscope is that of the CM-730 board, registers Z, Y, X in this order, which the authors scaled
to 500 deg/s. In the three faster stand-ups, where the feet stand flat, its Y is minus the pitch
rate of the leg kinematics (correlation 0.95 to 0.98) with a slope of 0.23 to 0.27, near the 0.31
that a full scale of 1600 deg/s gives. Y is taken so; X and Z, whose signs the recordings do not
show, are left out.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np

from pup.errors import InputError
from pup.importers.common import (
    Array,
    ImportOptions,
    finite,
    item,
    joint_columns,
    number,
    parse_json,
    read_text,
)
from pup.recording import Recording, from_columns

JOINTS = (
    *("l_sho_pitch", "l_sho_roll", "l_el", "r_sho_pitch", "r_sho_roll", "r_el"),
    *("head_pan", "head_tilt"),
    *("l_hip_yaw", "l_hip_roll", "l_hip_pitch", "l_knee", "l_ank_pitch", "l_ank_roll"),
    *("r_hip_yaw", "r_hip_roll", "r_hip_pitch", "r_knee", "r_ank_pitch", "r_ank_roll"),
)
STEP = re.compile(r"[\d.]+_([\d.]+_\d+)")
STANDUP = re.compile(r"[\d.]+_([\d.]+)_standup")
GYRO_SCALE = 1600 / 500
EARLY = 1e-6  # s; keyframe times are sums of 0.05 s and end up beside the tick they mean


def read(path: Path, options: ImportOptions) -> list[Recording]:
    """Read one log."""
    document = parse_json(read_text(path))
    dt = number(document, "control_dt")
    if dt <= 0:
        raise InputError(f"'control_dt' is {dt:g}; expected a positive time in s")
    position = finite(item(document, "pose"), "pose", (None, len(JOINTS)))
    time = np.arange(len(position), dtype=np.float64) * dt
    columns: dict[str, Array] = {"time": time}
    columns |= joint_columns("target", JOINTS, _targets(document, time - dt))
    columns |= joint_columns("position", JOINTS, position)
    columns |= _measured(document, len(position))
    suspended = item(document, "fix_root")
    if not isinstance(suspended, bool):
        raise InputError(f"'fix_root' is {suspended!r}; expected true or false")
    name, motion = _name(path.stem)
    notes = "Positions are read 1 to 4 ms after the command of their row is sent."
    if "imu/gyro_y" in columns:
        notes += " imu/gyro_y: CM-730 gyroscope at 1600 deg/s full scale; X and Z left out."
    return [
        from_columns(
            options.metadata(
                {
                    "id": name,
                    "robot": "darwin_op2",
                    "motion": motion,
                    "support": "suspended" if suspended else "ground",
                    "source": "hardware",
                    "notes": notes,
                }
            ),
            columns,
        )
    ]


def _targets(document: Any, due: Array) -> Array:
    """The keyframe in force at each time, shape (n_rows, n_joints); the first one before all."""
    keyframes = item(document, "keyframes")
    if not isinstance(keyframes, list) or not keyframes:
        raise InputError("'keyframes' is not a list of [time, targets]")
    if not all(isinstance(frame, list) and len(frame) == 2 for frame in keyframes):
        raise InputError("'keyframes' is not a list of [time, targets]")
    start = finite([frame[0] for frame in keyframes], "keyframes", (None,))
    for row in np.flatnonzero(np.diff(start) < 0) + 1:
        raise InputError(f"column 'keyframes', row {row}: starts before the row above")
    values = finite([frame[1] for frame in keyframes], "keyframes", (None, len(JOINTS)))
    last = np.searchsorted(start, due + EARLY, side="right") - 1
    return values[np.maximum(last, 0)]


def _measured(document: Any, rows: int) -> dict[str, Array]:
    """Speeds and gyroscope; a table that is zero throughout was not measured."""
    columns: dict[str, Array] = {}
    if "vel" in document:
        speed = finite(document["vel"], "vel", (rows, len(JOINTS)))
        if speed.any():
            columns |= joint_columns("velocity", JOINTS, speed)
    if "gyro" in document:
        gyro = finite(document["gyro"], "gyro", (rows, 3))
        if gyro.any():
            columns["imu/gyro_y"] = -GYRO_SCALE * gyro[:, 1]
    return columns


def _name(stem: str) -> tuple[str, str | None]:
    """Id and motion type from a file name such as `0.05_0.3_1` or `0.05_2.0_standup`."""
    if match := STANDUP.fullmatch(stem):
        return f"standup_{match[1]}", "standup"
    if match := STEP.fullmatch(stem):
        return f"step_{match[1]}", "step"
    return stem, None
