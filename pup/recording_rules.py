"""The rules a recording keeps, and the messages of those it breaks.

Rows are counted from 0. A message says what and where in the recording; the caller says in which.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.robot_parts import Joint

Array = NDArray[np.float64]

SCHEMA = 1
SUPPORTS = ("suspended", "ground", "bench")
SOURCES = ("hardware", "simulation", "unknown")
PER_JOINT = ("target", "position", "velocity", "current", "load", "temperature")
IMU = tuple(f"imu/{sensor}_{axis}" for sensor in ("gyro", "accel") for axis in "xyz")
WHOLE = ("voltage", "torque_enabled", "imu/roll", "imu/pitch", "imu/yaw", *IMU)

MAX_ID, MAX_ID_BYTES = 120, 230
"""Longest id; file systems let a name have 255 bytes, and a file on its way to it has a longer."""
MAX_DURATION = 86_400.0  # s; longer means other units or a clock that jumped
MAX_TICK = 0.5  # s; no servo is driven as slowly, but a clock in ms looks so
MAX_GAP = 60.0  # s; no bus is silent as long while a robot moves, and a replay would wait it out
BEYOND, MARGIN = 4.0, 2.0
"""Play, a fall or a turn of its servo may bring a joint beyond its limits, but not beyond so many
times the larger one, and so much more, rad; degrees and encoder ticks are."""
TILTS = {"imu/roll": 2 * math.pi, "imu/pitch": math.pi / 2 + 0.1}
"""Largest angles of the torso, rad: the pitch of Z-Y-X Euler angles ends at a quarter of a turn;
the roll ends at a half, and may be unwrapped."""
JUMP, FASTEST = math.pi, 50.0
"""A joint whose readings differ by more than half a turn, and by more rad/s than a servo turns by,
has an encoder that begins anew after a turn."""
MOVING, FASTER = 0.1, 6.0
"""A joint that moves by more, rad/s rms, tells the unit of its velocity: deg/s are 57 times what
its positions change by, rpm 9.5 times. One that rattles between readings may be far above 1."""


def check_metadata(metadata: object) -> dict[str, Any]:
    """Check what a file says of itself; keys the contract does not know are let pass.

    Args:
      metadata: the JSON value under `pup.recording`.
    """
    if not isinstance(metadata, dict):
        raise InputError("metadata 'pup.recording' is not a JSON object")
    if type(metadata.get("schema")) is not int or metadata["schema"] != SCHEMA:
        raise InputError(
            f"metadata 'schema' is {metadata.get('schema')!r}; this version reads schema {SCHEMA}"
        )
    for key in ("id", "robot", "motion"):
        if not isinstance(metadata.get(key), str) or not metadata[key]:
            raise InputError(f"metadata {key!r} is {metadata.get(key)!r}; it must be a text")
    check_id(metadata["id"])
    for key, choices in (("support", SUPPORTS), ("source", SOURCES)):
        if metadata.get(key) not in choices:
            raise InputError(f"metadata {key!r} is {metadata.get(key)!r}; use {', '.join(choices)}")
    _check_setup(metadata.get("setup", {}))
    repeated = metadata.get("repeat_of")
    if repeated is not None and (not isinstance(repeated, str) or not repeated):
        raise InputError(f"metadata 'repeat_of' is {repeated!r}; use an id or null")
    if not isinstance(metadata.get("notes", ""), str):
        raise InputError("metadata 'notes' is not a text")
    for key in ("robot", "motion", "repeat_of", "notes"):
        _check_encodable(key, metadata.get(key) or "")
    return metadata


def _check_encodable(key: str, text: str) -> None:
    """Refuse halves of characters, which JSON can hold but no page, report or terminal."""
    try:
        text.encode()
    except UnicodeEncodeError as error:
        broken = text[error.start : error.end]
        raise InputError(
            f"metadata {key!r} holds {broken!r}, which is no character of UTF-8"
        ) from error


def check_id(name: str) -> None:
    """Check an id: it becomes a file name, so nothing in it may lead out of the folder."""
    if not name.isprintable() or "/" in name or "\\" in name:
        raise InputError(f"metadata 'id' {name!r} holds a slash or a control character")
    if name.startswith(".") or len(name) > MAX_ID or len(name.encode()) > MAX_ID_BYTES:
        raise InputError(
            f"metadata 'id' {name!r} begins with a dot or is over {MAX_ID} characters, or "
            f"{MAX_ID_BYTES} bytes"
        )


def check_joints(joints: tuple[str, ...]) -> None:
    """Check that there are joints and each has a name of its own."""
    if not joints:
        raise InputError("no target: there is no column target/<joint>")
    seen: set[str] = set()
    for name in joints:
        if not isinstance(name, str) or not name or not name.isprintable() or name in seen:
            raise InputError(f"joint {name!r} is no name, or stands twice")
        seen.add(name)


def check_extra(name: str, joints: tuple[str, ...]) -> None:
    """Check the name of a column other than time, targets and positions."""
    kind, _, joint = name.partition("/")
    if name in WHOLE:
        return
    if kind not in PER_JOINT:
        raise InputError(f"column {name!r} is not one a recording can have")
    if joint not in joints or kind in ("target", "position"):
        raise InputError(f"column {name!r} is of a joint without target and position")


def check_values(columns: Mapping[str, Array]) -> None:
    """Check the samples.

    Args:
      columns: contract name to values of shape (n_ticks,); NaN is a missing sample.
    """
    for name, values in columns.items():
        for row in np.flatnonzero(np.isinf(values)):
            raise InputError(f"column {name!r}, row {row}: infinite")
        needed = name.startswith(("target/", "position/", "torque_enabled"))
        if needed and np.isnan(values).all():
            raise InputError(f"column {name!r} has no sample at all")
    _check_time(columns["time"])
    power = columns.get("torque_enabled", np.ones(0))
    for row in np.flatnonzero(~np.isnan(power) & (power != 0) & (power != 1)):
        raise InputError(f"column 'torque_enabled', row {row}: {power[row]:g} is neither 0 nor 1")


def _check_time(time: Array) -> None:
    if len(time) < 2:
        raise InputError(f"column 'time' has {len(time)} rows; a recording needs at least two")
    for row in np.flatnonzero(np.isnan(time)):
        raise InputError(f"column 'time', row {row}: missing; every row needs its time")
    for row in np.flatnonzero(np.diff(time) <= 0) + 1:
        which = "repeats" if time[row] == time[row - 1] else "is before"
        raise InputError(
            f"column 'time', row {row}: {time[row]:.9g} s {which} {time[row - 1]:.9g} s of the "
            "row before; time must increase strictly"
        )
    if not time[-1] - time[0] <= MAX_DURATION:
        raise InputError(
            f"column 'time' spans {time[-1] - time[0]:g} s; is it in seconds, did the clock jump?"
        )


def check_units(joints: Sequence[Joint], columns: Mapping[str, Array]) -> None:
    """Refuse what cannot be in s and rad (of a slide in m), by the robot's joints.

    Args:
      joints: of the robot.
      columns: as for `check_values`, valid.
    """
    _check_ticks(columns["time"])
    for joint in joints:
        largest = BEYOND * max(abs(joint.lower), abs(joint.upper)) + MARGIN
        for name in (f"target/{joint.name}", f"position/{joint.name}"):
            values = columns[name]
            for row in np.flatnonzero(np.abs(values) > largest):
                raise InputError(
                    f"column {name!r}, row {row}: {values[row]:g}, but robot.toml limits the joint "
                    f"to [{joint.lower:g}, {joint.upper:g}]; are these degrees, encoder ticks or "
                    "mm?"
                )
    _check_turns([joint.name for joint in joints], columns)
    _check_velocities([joint.name for joint in joints], columns)
    for name, largest in TILTS.items():
        values = columns.get(name, np.zeros(0))
        for row in np.flatnonzero(np.abs(values) > largest):
            raise InputError(
                f"column {name!r}, row {row}: {values[row]:g}, beyond {largest:.3g} rad; are these "
                "degrees?"
            )


def _check_ticks(time: Array) -> None:
    """Refuse rows that are further apart than those of a robot that is driven."""
    gaps = np.diff(time)
    if (tick := float(np.median(gaps))) > MAX_TICK:
        raise InputError(f"column 'time': rows are {tick:g} s apart; is time in ms?")
    for row in np.flatnonzero(gaps > MAX_GAP) + 1:
        raise InputError(
            f"column 'time', row {row}: {gaps[row - 1]:g} s after the row before; did the clock "
            "jump? Mend it, or make two recordings of it"
        )


def _check_turns(joints: Sequence[str], columns: Mapping[str, Array]) -> None:
    """Refuse angles that jump from one end of their encoder's turn to the other."""
    for name in (f"position/{joint}" for joint in joints):
        read = np.flatnonzero(~np.isnan(columns[name]))
        angle, time = columns[name][read], columns["time"][read]
        jump, gap = np.abs(np.diff(angle)), np.diff(time)
        for i in np.flatnonzero((jump > JUMP) & (jump > FASTEST * gap)):
            raise InputError(
                f"column {name!r}, row {read[i + 1]}: {angle[i + 1]:.3g}, but {angle[i]:.3g} only "
                f"{gap[i]:.3g} s before; does its encoder begin anew after a turn? unwrap it"
            )


def _check_velocities(joints: Sequence[str], columns: Mapping[str, Array]) -> None:
    """Refuse velocities that are, at most joints, many times what the positions change by."""
    factors: dict[str, float] = {}
    for joint in joints:
        position, told = columns[f"position/{joint}"], columns.get(f"velocity/{joint}")
        both = np.zeros(0, bool) if told is None else ~np.isnan(position) & ~np.isnan(told)
        if told is not None and both.sum() > 2:
            changes = np.diff(position[both]) / np.diff(columns["time"][both])
            if (moved := _rms(changes)) > MOVING:
                factors[joint] = _rms(told[both]) / moved
    if factors and float(np.median(list(factors.values()))) > FASTER:
        joint, factor = max(factors.items(), key=lambda item: item[1])
        raise InputError(
            f"column 'velocity/{joint}': {factor:.2g} times what its positions change by; is it in "
            "deg/s, rpm or ticks?"
        )


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _check_setup(setup: object) -> None:
    if not isinstance(setup, dict):
        raise InputError("metadata 'setup' is not an object of knobs and numbers")
    for knob, value in setup.items():
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not isinstance(knob, str) or not number or not _is_finite(value):
            raise InputError(f"metadata 'setup': {knob!r} is {value!r}; use a finite number")
        _check_encodable("setup", knob)


def _is_finite(value: float) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer beyond float64
        return False
