"""Importers: what they make of each format, and of the real logs."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from commandline import pup
from foreign_logs import (
    ARM,
    CSV,
    ROWS,
    bam_log,
    darwin_log,
    npz_arrays,
    one,
    write_emps,
    write_json_mcap,
    write_npz,
    write_ros,
    write_sage,
)
from mcap.writer import CompressionType

from pup.errors import InputError
from pup.importers import ImportOptions, import_recordings, overlooked, write_imported
from pup.importers.common import join
from pup.importers.darwin_hardware import JOINTS
from pup.recording import load_recordings
from pup.robot import RobotDescription


def test_darwin_commands_lag_their_rows_by_the_row_read_before_the_loop(tmp_path: Path) -> None:
    """Row 0 is read while the first keyframe is held; row i follows the command of tick i - 1."""
    path = tmp_path / "0.05_0.1_0.json"
    path.write_text(json.dumps(darwin_log()))
    recording = one("darwin-hardware", path)
    assert recording.joints == JOINTS
    assert recording.target[:, 0].tolist() == [0.0, 0.1, 0.1, 0.1, 0.0, 0.0]
    np.testing.assert_allclose(recording.time, np.arange(6) * 0.05)
    assert (recording.id, recording.motion, recording.support) == (
        "step_0.1_0",
        "step",
        "suspended",
    )
    assert "velocity/l_el" not in recording.extras  # zero throughout: not measured
    assert set(recording.extras) == {"imu/gyro_y"}
    np.testing.assert_allclose(recording.extras["imu/gyro_y"], -6.4)


def test_darwin_standups_stand_on_the_ground(tmp_path: Path) -> None:
    path = tmp_path / "0.05_2.0_standup.json"
    path.write_text(json.dumps(darwin_log(fix_root=False, vel=[[0.5] * 20] * 6)))
    recording = one("darwin-hardware", path)
    assert (recording.id, recording.motion, recording.support) == (
        "standup_2.0",
        "standup",
        "ground",
    )
    assert (recording.extras["velocity/l_el"] == 0.5).all()


def test_bam_header_becomes_the_setup(tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    path.write_text(json.dumps(bam_log()))
    recording = one("bam", path)
    assert recording.setup == {"mass": 0.3, "length": 0.1, "kp": 16.0, "vin": 6.0}
    assert (recording.robot, recording.motion, recording.support) == (
        "servo_bench",
        "sin_sin",
        "bench",
    )
    np.testing.assert_allclose(recording.extras["voltage"], 5.7)
    assert recording.extras["torque_enabled"].tolist() == [1, 1, 1, 0, 0]
    recording.validate(RobotDescription.load("servo_bench"))


def test_bam_voltage_may_be_in_volts_already(tmp_path: Path) -> None:
    log = bam_log()
    for entry in log["entries"]:
        entry["input_volts"] = 6.1
    (tmp_path / "run.json").write_text(json.dumps(log))
    np.testing.assert_allclose(one("bam", tmp_path / "run.json").extras["voltage"], 6.1)


def test_bam_repeated_timestamps_go_with_a_note_and_backward_ones_are_refused(
    tmp_path: Path,
) -> None:
    path = tmp_path / "run.json"
    log = bam_log()
    log["entries"][3]["timestamp"] = log["entries"][2]["timestamp"]
    path.write_text(json.dumps(log))
    recording = one("bam", path)
    assert len(recording.time) == 4
    assert "1 rows that repeat a timestamp left out" in recording.notes
    log["entries"][4]["timestamp"] = 0.001
    path.write_text(json.dumps(log))
    with pytest.raises(InputError, match="'timestamp', row 4: is before"):
        one("bam", path)


def test_emps_is_a_position_loop_with_its_output_as_load(tmp_path: Path) -> None:
    recording = one("emps", write_emps(tmp_path / "DATA_EMPS.mat"))
    assert (recording.id, recording.robot, recording.joints) == ("data_emps", "emps", ("axis",))
    np.testing.assert_allclose(recording.target[:, 0] - recording.position[:, 0], 0.001)
    np.testing.assert_allclose(recording.extras["load/axis"], 0.5)


def test_sage_folders_keep_joint_names_and_note_what_is_left_out(tmp_path: Path) -> None:
    names = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw")
    for motion in ("chirp_sweep", "hold_under_gravity"):
        write_sage(tmp_path / "logs" / motion, names)
    chirp, hold = import_recordings("sage", [tmp_path / "logs"])
    assert (chirp.motion, hold.motion) == ("chirp", "hold")
    assert (chirp.robot, chirp.support, chirp.joints) == ("so101", "bench", names[:5])
    np.testing.assert_allclose(chirp.time, np.arange(4) * 0.02)
    assert "Torques" in chirp.notes and "Jaw" in chirp.notes


def test_sage_readings_between_commands_get_rows_of_their_own(tmp_path: Path) -> None:
    folder = write_sage(tmp_path / "walk", offset=5_000)
    recording = one("sage", folder, ImportOptions(robot="biped", support="ground"))
    assert (recording.motion, recording.joints) == ("walk", ("Hip", "Knee"))
    np.testing.assert_allclose(recording.time[:4], [0.0, 0.005, 0.02, 0.025])
    np.testing.assert_allclose(recording.target[:4, 0], [0.0, 0.0, 0.1, 0.1])
    np.testing.assert_allclose(recording.position[:4, 0], [np.nan, 0.0, np.nan, 0.1])


@pytest.mark.parametrize("where", ["sensordata", "state"])
def test_npz_is_read_as_mujoco_sysid_saves_it(tmp_path: Path, where: str) -> None:
    recording = one("npz", write_npz(tmp_path / "t.npz", where), ARM)
    assert recording.joints == ("hip",)
    np.testing.assert_allclose(recording.time[:3], [0.0, 0.01, 0.02])
    np.testing.assert_allclose(recording.target[:3, 0], [0.0, 0.0, 1.0])
    np.testing.assert_allclose(recording.position[:4, 0], [np.nan, 0.0, np.nan, 0.5])
    assert ("velocity/hip" in recording.extras) == (where == "state")


def test_npz_is_read_as_mujoco_sysid_itself_saves_it(tmp_path: Path) -> None:
    trajectory = pytest.importorskip(
        "mujoco.sysid._src.trajectory", reason="mujoco.sysid needs its extra"
    )
    model = mujoco.MjModel.from_xml_string("""<mujoco>
      <worldbody><body><joint name="hip"/><geom size="0.1"/></body></worldbody>
      <actuator><position name="hip" joint="hip"/></actuator>
      <sensor><jointpos name="hip_pos" joint="hip"/></sensor>
    </mujoco>""")
    wanted = npz_arrays()
    series = trajectory.timeseries.TimeSeries
    control = (wanted["control_times"], wanted["control_data"], model)
    readings = (wanted["sensordata_times"], wanted["sensordata_data"], model)
    trajectory.SystemTrajectory(
        model,
        series.from_control_names(*control),
        series.from_names(*readings),
        wanted["initial_state"],
        None,
    ).save_to_disk(tmp_path / "a.npz")
    one_way = one("npz", tmp_path / "a.npz", ARM)
    other = one("npz", write_npz(tmp_path / "b.npz"), ARM)
    for (name, values), (same_name, same_values) in zip(
        one_way.columns(), other.columns(), strict=True
    ):
        assert name == same_name
        np.testing.assert_array_equal(values, same_values)


def test_npz_without_names_needs_them(tmp_path: Path) -> None:
    arrays = npz_arrays()
    np.savez(tmp_path / "t.npz", **{k: v for k, v in arrays.items() if not k.endswith("_mapping")})
    with pytest.raises(InputError, match="--joints"):
        one("npz", tmp_path / "t.npz", ARM)
    options = ImportOptions(robot="arm", motion="step", support="bench", joints=("hip",))
    assert one("npz", tmp_path / "t.npz", options).joints == ("hip",)


def test_csv_takes_metadata_from_options_or_its_first_line(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(CSV)
    options = ImportOptions("arm", "step", "bench", setup={"mass": 2.0}, notes="by hand")
    recording = one("csv", path, options)
    assert (recording.id, recording.robot, recording.source) == ("log", "arm", "unknown")
    assert (recording.setup, recording.notes) == ({"mass": 2.0}, "by hand")
    np.testing.assert_allclose(recording.position[:, 0], [0.01, np.nan, 0.8])
    np.testing.assert_allclose(recording.extras["voltage"], [12.0, 11.9, np.nan])
    told = recording.metadata() | {"id": "named", "motion": "chirp"}
    path.write_text(f"# pup.recording: {json.dumps(told)}\r\n" + CSV.replace("\n", "\r\n"))
    assert one("csv", path).metadata() == told
    assert one("csv", path, ImportOptions(motion="hold")).motion == "hold"


def test_what_was_imported_is_written_again_only_where_it_is_the_same(tmp_path: Path) -> None:
    (tmp_path / "1.csv").write_text(CSV)
    first = import_recordings("csv", [tmp_path / "1.csv"], options=ARM)
    (written,) = write_imported(first, tmp_path / "out")
    before = written.read_bytes()
    assert write_imported(first, tmp_path / "out") == (written,)
    more = import_recordings("csv", [tmp_path], options=replace(ARM, motion="triangle"))
    beside = [replace(first[0], id="0"), *more]
    with pytest.raises(InputError, match=r"1\.parquet: is another recording; rename the log"):
        write_imported(beside, tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == [written] and written.read_bytes() == before


def test_csv_names_what_nobody_told(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(CSV)
    with pytest.raises(InputError, match=r"log\.csv: the file does not tell the robot.*--robot"):
        one("csv", tmp_path / "log.csv")


@pytest.mark.parametrize("stamped", [True, False])
@pytest.mark.parametrize("compression", list(CompressionType))
def test_mcap_joins_joint_states_with_commands(
    tmp_path: Path, stamped: bool, compression: CompressionType
) -> None:
    recording = one("mcap", write_ros(tmp_path / "log.mcap", stamped, compression), ARM)
    assert recording.joints == ("b", "a")
    np.testing.assert_allclose(recording.time, np.arange(10) * 0.01, atol=1e-9)
    np.testing.assert_allclose(recording.target[:3, 1], [97.0, 97.0, 97.1])
    np.testing.assert_allclose(recording.position[:4, 0], [np.nan, 98.0, np.nan, 98.1])
    np.testing.assert_allclose(recording.extras["velocity/a"][:2], [np.nan, 1.0])
    assert np.isnan(recording.extras["velocity/b"]).all()
    assert "c" in recording.notes


def test_mcap_topics_can_be_chosen(tmp_path: Path) -> None:
    path = write_ros(tmp_path / "log.mcap")
    chosen = ImportOptions("arm", "step", "bench", state_topic="/joint_states")
    assert one("mcap", path, chosen).joints == ("b", "a")
    for state, command in (("/joint_command", None), ("/absent", None), (None, "/joint_states")):
        options = ImportOptions("arm", "step", "bench", state_topic=state, command_topic=command)
        with pytest.raises(InputError, match="topic"):
            one("mcap", path, options)


@pytest.mark.parametrize("compression", list(CompressionType))
def test_mcap_json_messages_are_rows(tmp_path: Path, compression: CompressionType) -> None:
    recording = one("mcap", write_json_mcap(tmp_path / "log.mcap", ROWS, compression), ARM)
    np.testing.assert_allclose(recording.time, [0.0, 0.05, 0.12])
    np.testing.assert_allclose(recording.position[:, 0], [0.01, np.nan, 0.8])
    np.testing.assert_allclose(recording.extras["voltage"], [12.0, np.nan, np.nan])


def test_readings_before_the_first_command_are_left_out_and_told() -> None:
    columns, note = join(
        np.array([1.0, 2.0]), np.array([0.5, 1.0, 1.5]), {"c": np.array([7.0, 8.0])},
        {"s": np.array([1.0, 2.0, 3.0])},
    )  # fmt: skip
    assert columns["time"].tolist() == [0.0, 0.5, 1.0]
    assert columns["c"].tolist() == [7.0, 7.0, 8.0]
    np.testing.assert_allclose(columns["s"], [2.0, 3.0, np.nan])
    assert note.startswith("1 readings")


def test_times_that_differ_by_rounding_are_one_row() -> None:
    """Simulators add their steps up, others multiply them."""
    sent, read = np.arange(50) * 0.02, np.cumsum(np.full(50, 0.02)) - 0.02
    assert (sent != read).any()
    columns, note = join(sent, read - 1e-17, {"c": sent}, {"s": read})
    np.testing.assert_array_equal(columns["time"], sent)
    np.testing.assert_array_equal(columns["s"], read)
    assert note == ""


def test_a_robot_gives_its_name_and_must_fit(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(CSV)
    robot = RobotDescription.load("servo_bench")
    options = ImportOptions(motion="step", support="bench")
    with pytest.raises(InputError, match=r"log\.csv: .*unknown joints a "):
        import_recordings("csv", [tmp_path / "log.csv"], robot, options)
    (tmp_path / "log.csv").write_text(CSV.replace("/a", "/servo"))
    (recording,) = import_recordings("csv", [tmp_path], robot, options)
    assert recording.robot == "servo_bench"


def test_refuses_unknown_formats_absent_paths_and_equal_ids(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="csv, darwin-hardware"):
        import_recordings("pickle", [tmp_path])
    with pytest.raises(InputError, match="no such file"):
        import_recordings("csv", [tmp_path / "absent.csv"])
    with pytest.raises(InputError, match=r"no \*\.csv"):
        import_recordings("csv", [tmp_path])
    with pytest.raises(InputError, match="no log given"):
        import_recordings("csv", [])
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "log.csv").write_text(CSV)
    with pytest.raises(InputError, match="id 'log' is also that of"):
        import_recordings("csv", [tmp_path / "one", tmp_path / "two"], options=ARM)


def test_hidden_logs_of_a_folder_are_left_out(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(CSV)
    (tmp_path / "._log.csv").write_bytes(b"\0\5\x16\7\xb0")
    assert [r.id for r in import_recordings("csv", [tmp_path], options=ARM)] == ["log"]
    write_sage(tmp_path / "s" / "step")
    write_sage(tmp_path / "s" / ".Trash" / "old")
    assert [r.id for r in import_recordings("sage", [tmp_path / "s"], options=ARM)] == ["step"]
    with pytest.raises(InputError, match=r"log\.csv: is given twice"):
        import_recordings("csv", [tmp_path, tmp_path / "log.csv"], options=ARM)


def test_no_log_of_a_folder_is_left_out_in_silence(tmp_path: Path) -> None:
    logs, out = tmp_path / "logs", tmp_path / "out"
    for name in ("1.csv", "2.CSV", "monday/3.csv", "monday/deeper/4.csv"):
        (logs / name).parent.mkdir(parents=True, exist_ok=True)
        (logs / name).write_text(CSV)
    command = ["import", "csv", logs, "--robot-name", "arm", "--motion", "step", "--out", out]
    done = pup(*command, "--support", "bench")
    assert (done.code, done.out.split()) == (0, [str(out / f"{i}.parquet") for i in (1, 2)])
    told = f"warning: {logs / 'monday'} holds logs too, which are not imported; name it as well"
    assert done.err.splitlines() == [told]
    assert overlooked("csv", [logs, logs / "monday"]) == [logs / "monday" / "deeper"]
    for name in ("1.csv", "2.CSV"):
        (logs / name).unlink()
    with pytest.raises(InputError, match=r"no \*\.csv in this folder, but in .*monday; name that"):
        import_recordings("csv", [logs], options=ARM)


def test_a_folder_may_be_called_as_a_log(tmp_path: Path) -> None:
    """As the folders of ROS 2 may be; each has its logs in it."""
    write_ros(tmp_path / "a.mcap")
    (tmp_path / "walk.mcap").mkdir()
    write_ros(tmp_path / "walk.mcap" / "walk_0.mcap")
    assert [r.id for r in import_recordings("mcap", [tmp_path], options=ARM)] == ["a"]
    assert overlooked("mcap", [tmp_path]) == [tmp_path / "walk.mcap"]


def test_what_was_imported_into_a_folder_of_any_name_is_told(tmp_path: Path) -> None:
    """Where the terminal is strict, as with most locales, the name is written as it is."""
    (tmp_path / "log.csv").write_text(CSV)
    out = tmp_path / "\udcff"
    command = [*(sys.executable, "-m", "services.cli", "import", "csv"), tmp_path / "log.csv"]
    command += [*("--robot-name", "arm", "--motion", "step", "--support", "bench"), "--out", out]
    strict = os.environ | {"PYTHONIOENCODING": "utf-8:strict"}
    for _ in range(2):  # the second finds the first there
        done = subprocess.run(command, capture_output=True, timeout=300, env=strict)
        assert done.returncode == 0, done.stderr
        assert done.stdout.strip() == os.fsencode(out / "log.parquet")


# The real logs


@pytest.mark.parametrize(
    ("format", "folder", "robot", "count"),
    [
        ("darwin-hardware", "darwin_op2_hardware", "darwin_op2", 19),
        ("bam", "servo_sts3032", "servo_bench", 48),
        ("emps", "emps", "emps", 1),
        ("sage", "so101", "so101", 5),
    ],
)
def test_the_real_logs_become_recordings_of_the_contract(
    shared: Path,
    check_contract: Callable[[Path], None],
    tmp_path: Path,
    format: str,
    folder: str,
    robot: str | None,
    count: int,
) -> None:
    description = RobotDescription.load(robot) if robot else None
    found = import_recordings(format, [shared / "recordings" / folder], description)
    assert len(found) == count
    for recording in found:
        recording.write(tmp_path / f"{recording.id}.parquet")
    check_contract(tmp_path)
    assert [r.digest for r in load_recordings([tmp_path])] == [r.digest for r in found]


def test_real_darwin_joints_move_after_their_command_and_not_before(shared: Path) -> None:
    """The evidence for the importer's timing, from all 60 moves of the 15 step tests."""
    found = import_recordings("darwin-hardware", [shared / "recordings" / "darwin_op2_hardware"])
    steps = [recording for recording in found if recording.motion == "step"]
    assert len(steps) == 15
    for recording in steps:
        sent = np.flatnonzero(np.abs(np.diff(recording.target, axis=0)).max(axis=1) > 0) + 1
        assert sent.tolist() == [1, 6, 11, 16]
        for row in sent:
            step = recording.target[row] - recording.target[row - 1]
            size = np.abs(step).sum()
            before, after = np.diff(recording.position[row - 1 : row + 2], axis=0) @ np.sign(step)
            assert before < 0.05 * size
            assert after > 0.25 * size


def test_real_emps_readings_and_commands_are_of_one_instant(shared: Path) -> None:
    """The known controller, v = kp kv (target - q) - kv dq, gives the logged output."""
    (recording,) = import_recordings("emps", [shared / "recordings" / "emps"])
    q, target = recording.position[:, 0], recording.target[:, 0]
    output = 10 * recording.extras["load/axis"]
    speed = np.convolve(np.gradient(q, recording.time), np.ones(9) / 9, "same")
    expected = 160.18 * 243.45 * (target - q) - 243.45 * speed
    assert np.sqrt(np.mean((output - expected)[100:-100] ** 2)) < 0.2
