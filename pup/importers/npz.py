"""Trajectories that mujoco.sysid saved (`SystemTrajectory.save_to_disk`), a NumPy archive.

`control_*` are the commands, `sensordata_*` the readings (else `state_*`), each with its own times
and a JSON map from signal name to type and columns. A control is of the joint whose name its
actuator has; a reading of joint J is the state `J_qpos` or a sensor `J`, `J_pos`, `J_position` or
`J_qpos`, and for the speed `J_qvel`, `J_vel` or `J_velocity`. Without maps the options name the
joints, and there must be one control and one reading per joint. Pickled objects are never loaded.
"""

import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from pup.errors import InputError
from pup.importers.common import (
    MAX_CELLS,
    MAX_UNPACKED,
    Array,
    ImportOptions,
    finite,
    join,
    opened,
    parse_json,
)
from pup.recording import Recording, from_columns

POSITION = ("_qpos", "_pos", "_position", "")
VELOCITY = ("_qvel", "_vel", "_velocity")
MAX_MEMBERS = 64


def read(path: Path, options: ImportOptions) -> list[Recording]:
    """Read one archive."""
    arrays = _load(path)
    control = _signals(arrays, "control", options.joints)
    joints = [name.removesuffix("_ctrl") for name in control[1]]
    for name in joints:
        if joints.count(name) > 1:
            raise InputError(f"two controls of joint {name!r}")
    state_time, readings = _signals(arrays, "sensordata", options.joints)
    if _find(readings, joints[0], POSITION) is None and "state_times" in arrays:
        state_time, readings = _signals(arrays, "state", options.joints)
    states = {}
    for joint in joints:
        position = _find(readings, joint, POSITION)
        if position is None:
            raise InputError(
                f"no position of joint {joint!r}; the readings are {', '.join(readings) or 'none'}"
            )
        states[f"position/{joint}"] = position
        if (velocity := _find(readings, joint, VELOCITY)) is not None:
            states[f"velocity/{joint}"] = velocity
    commands = {f"target/{j}": v for j, v in zip(joints, control[1].values(), strict=True)}
    columns, notes = join(control[0], state_time, commands, states)
    return [from_columns(options.metadata({"id": path.stem, "notes": notes}), columns)]


def _find(signals: dict[str, Array], joint: str, suffixes: tuple[str, ...]) -> Array | None:
    return next((signals[joint + s] for s in suffixes if joint + s in signals), None)


def _signals(
    arrays: dict[str, Any], kind: str, joints: tuple[str, ...]
) -> tuple[Array, dict[str, Array]]:
    """Times and scalar signals by name; vectors such as a free joint's state are passed over."""
    for part in ("times", "data"):
        if f"{kind}_{part}" not in arrays:
            raise InputError(f"array '{kind}_{part}' is missing: not saved by SystemTrajectory?")
    time = finite(arrays[f"{kind}_times"], f"{kind}_times", (None,))
    data = finite(arrays[f"{kind}_data"], f"{kind}_data", (len(time), None))
    encoded = arrays.get(f"{kind}_signal_mapping")
    if encoded is None:
        if len(joints) != data.shape[1] or not joints:
            raise InputError(
                f"'{kind}_data' has {data.shape[1]} unnamed columns; name as many with --joints"
            )
        if len(set(joints)) < len(joints):
            raise InputError(f"--joints {','.join(joints)}: names a joint twice; name each once")
        return time, {name: data[:, j] for j, name in enumerate(joints)}
    mapping = parse_json(str(encoded))
    if not isinstance(mapping, dict) or not mapping:
        raise InputError(f"'{kind}_signal_mapping' is not an object of signals")
    signals = {}
    for name, entry in mapping.items():
        pair = isinstance(entry, list) and len(entry) == 2 and isinstance(entry[1], list)
        if not pair or not all(type(i) is int and 0 <= i < data.shape[1] for i in entry[1]):
            raise InputError(f"'{kind}_signal_mapping': {name!r} does not fit the data")
        if len(entry[1]) == 1:
            signals[name] = data[:, entry[1][0]]
    if not signals:
        raise InputError(f"'{kind}_signal_mapping' names no scalar signal")
    return time, signals


def _load(path: Path) -> dict[str, Any]:
    """The arrays of the layout; their sizes are judged by their headers before they are read."""
    try:
        with opened(path) as file, zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            if len(members) > MAX_MEMBERS or sum(m.file_size for m in members) > MAX_UNPACKED:
                raise InputError(
                    f"{len(members)} arrays of {sum(m.file_size for m in members)} bytes; at most "
                    f"{MAX_MEMBERS} of {MAX_UNPACKED} bytes are read"
                )
            for member in members:
                _check_header(archive, member)
        with opened(path) as file, np.load(file, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except InputError:
        raise
    except Exception as error:  # damaged archives make zipfile and NumPy raise nearly anything
        told = " ".join(str(error).split())[:200]
        raise InputError(f"not a readable NumPy archive ({told})") from error


def _check_header(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> None:
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        reader = {(1, 0): np.lib.format.read_array_header_1_0}.get(
            version, np.lib.format.read_array_header_2_0
        )
        shape, _, dtype = reader(file)
    size = math.prod(shape) * dtype.itemsize
    if dtype.hasobject or dtype.kind not in "biufU":
        raise InputError(f"array {member.filename!r} holds objects, which are never loaded")
    if size > member.file_size or math.prod(shape) > MAX_CELLS:
        raise InputError(f"array {member.filename!r} claims shape {shape}, too large")
