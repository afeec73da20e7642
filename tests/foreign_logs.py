"""Writes small whole logs as the formats' own tools write them, for the importers' tests."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
from mcap.writer import CompressionType, Writer
from mcap_ros2.writer import Writer as RosWriter

from pup.importers import ImportOptions, import_recordings, mcap_format
from pup.recording import Recording

ARM = ImportOptions(robot="arm", motion="step", support="bench")


def one(format: str, path: Path, options: ImportOptions | None = None) -> Recording:
    (recording,) = import_recordings(format, [path], options=options)
    return recording


def darwin_log(**changes: Any) -> dict[str, Any]:
    start, moved = [0.0] * 20, [0.1] * 20
    return {
        "control_dt": 0.05,
        "fix_root": True,
        "keyframes": [[0.0, start], [0.0, moved], [0.15000000000000002, start]],
        "pose": [start] * 3 + [moved] * 3,
        "vel": [start] * 6,
        "gyro": [[1.0, 2.0, 3.0]] * 6,
    } | changes


def bam_log(**changes: Any) -> dict[str, Any]:
    entries = [
        {
            "timestamp": 0.01 * i,
            "goal_position": 0.1 * i,
            "position": 0.1 * i - 0.05,
            "speed": 1.0,
            "load": 0.0,
            "temp": 0.0,
            "input_volts": 57.0,
            "torque_enable": i < 3,
        }
        for i in range(5)
    ]
    header = {"mass": 0.3, "length": 0.1, "kp": 16, "vin": 6.0, "trajectory": "sin_sin"}
    return header | {"entries": entries} | changes


def write_emps(path: Path, compressed: bool = False, **changes: Any) -> Path:
    t = np.arange(50.0)[:, None] / 1000
    arrays = {"t": t, "qg": t, "qm": t - 0.001, "vir": 0 * t + 5.0} | changes
    scipy.io.savemat(path, arrays, do_compression=compressed)
    return path


def write_sage(folder: Path, names: tuple[str, ...] = ("Hip", "Knee"), offset: int = 0) -> Path:
    folder.mkdir(parents=True)
    (folder / "joint_list.txt").write_text("\n".join(names))
    control, state = ["type,timestamp,positions"], ["type,timestamp,positions,velocities,torques"]
    for i in range(4):
        vector = [0.1 * i] * len(names)
        control.append(f'CONTROL,{20_000 * i},"{vector}"')
        state.append(f'STATE_MOTOR,{20_000 * i + offset},"{vector}","{vector}","{vector}"')
    (folder / "control.csv").write_text("\n".join(control) + "\n")
    (folder / "state_motor.csv").write_text("\n".join(state) + "\n")
    return folder


def npz_arrays(qpos: str = "sensordata") -> dict[str, Any]:
    """Arrays as `SystemTrajectory.save_to_disk` names them; readings come 10 ms after commands."""
    times, data = np.arange(4) * 0.02, np.arange(4.0)[:, None]
    sensor = "hip_pos" if qpos == "sensordata" else "unrelated"
    arrays = {
        "control_times": times,
        "control_data": data,
        "control_signal_mapping": np.asarray('{"hip_ctrl": [5, [0]]}'),
        "sensordata_times": times + 0.01,
        "sensordata_data": data / 2,
        "sensordata_signal_mapping": np.asarray(json.dumps({sensor: [0, [0]]})),
        "initial_state": np.zeros(3),
    }
    if qpos == "state":
        arrays["state_times"] = times + 0.01
        arrays["state_data"] = np.concatenate([data / 2, data], axis=1)
        mapping = {"hip_qpos": [2, [0]], "hip_qvel": [3, [1]], "base_qpos": [2, [0, 1]]}
        arrays["state_signal_mapping"] = np.asarray(json.dumps(mapping))
    return arrays


def write_npz(path: Path, qpos: str = "sensordata") -> Path:
    np.savez(path, **npz_arrays(qpos))
    return path


def write_ros(
    path: Path,
    stamped: bool = True,
    compression: CompressionType = CompressionType.ZSTD,
    commands: float | None = 0.0,
) -> Path:
    """A ROS 2 log; `commands` is how far their clock is ahead, s, or None for none."""
    with path.open("wb") as file:
        writer = RosWriter(file, compression=compression)
        definition = mcap_format.JOINT_STATE.data.decode()
        schema = writer.register_msgdef("sensor_msgs/msg/JointState", definition)
        for i in range(5):
            for late, topic, names in (
                (0, "/joint_command", ["b", "a"]),
                (10_000_000, "/joint_states", ["a", "b", "c"]),
            ):
                if commands is None and not late:
                    continue
                ahead = 0 if late else round((commands or 0.0) * 10**9)
                now = 1_700_000_000_000_000_000 + 20_000_000 * i + late + ahead
                stamp = {"sec": now // 10**9, "nanosec": now % 10**9} if stamped else {}
                message = {
                    "header": {"stamp": stamp, "frame_id": ""},
                    "name": names,
                    "position": [ord(name) + 0.1 * i for name in names],
                    "velocity": [1.0, float("nan"), 0.0] if late else [],
                    "effort": [],
                }
                writer.write_message(topic, schema, message, now, now)
        writer.finish()
    return path


def write_json_mcap(path: Path, rows: list[Any], compression: CompressionType) -> Path:
    with path.open("wb") as file:
        writer = Writer(file, compression=compression)
        writer.start()
        schema = writer.register_schema("row", "jsonschema", b"{}")
        channel = writer.register_channel("/rows", "json", schema)
        for i, row in enumerate(rows):
            writer.add_message(channel, i, json.dumps(row).encode(), i)
        writer.finish()
    return path


CSV = """time,target/a,position/a,voltage
0.0,0.0,0.01,12.0
0.05,1.0,,11.9
0.12,1.0,0.8,
"""
ROWS = [
    {"time": 0.0, "target/a": 0.0, "position/a": 0.01, "voltage": 12},
    {"time": 0.05, "target/a": 1.0, "position/a": None},
    {"time": 0.12, "target/a": 1.0, "position/a": 0.8},
]
