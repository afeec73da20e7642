"""Importers: what they refuse, with file, column and row, and damaged logs."""

import io
import json
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
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
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType

from pup.errors import InputError
from pup.importers import FORMATS, ImportOptions, import_recordings, mcap_format, npz
from pup.importers.common import join
from pup.recording import Recording

DARWIN_WRONG: list[tuple[dict[str, Any], str]] = [
    ({"pose": [[0.0] * 20] * 5 + [[0.0] * 19]}, "'pose' has rows of different lengths"),
    ({"pose": [[0.0] * 19] * 6}, "'pose' has shape"),
    ({"pose": [[0.0] * 20] * 5 + [[float("nan")] * 20]}, "'pose', row 5"),
    ({"pose": [[None] * 20] * 6}, "'pose' is not made of numbers"),
    ({"pose": "none"}, "'pose'"),
    ({"vel": [[0.0] * 20] * 5}, "'vel' has shape"),
    ({"keyframes": []}, "'keyframes'"),
    ({"keyframes": [[0.0]]}, "'keyframes'"),
    ({"keyframes": [[0.1, [0.0] * 20], [0.0, [0.0] * 20]]}, "'keyframes', row 1"),
    ({"keyframes": [[0.0, [10**400] * 20]]}, "'keyframes'"),
    ({"control_dt": 0}, "'control_dt'"),
    ({"control_dt": True}, "'control_dt'"),
    ({"fix_root": "yes"}, "'fix_root'"),
]


@pytest.mark.parametrize(("changes", "told"), DARWIN_WRONG)
def test_darwin_logs_are_refused(tmp_path: Path, changes: dict[str, Any], told: str) -> None:
    path = tmp_path / "0.05_0.1_0.json"
    path.write_text(json.dumps(darwin_log(**changes)))
    with pytest.raises(InputError, match=told) as caught:
        one("darwin-hardware", path)
    assert str(path) in str(caught.value)


BAM_WRONG: list[tuple[dict[str, Any], str]] = [
    ({"entries": 3}, "'entries'"),
    ({"entries": []}, "no sample"),
    ({"entries": [{}]}, "'timestamp', row 0"),
    ({"mass": "heavy"}, "'mass'"),
    ({"mass": float("inf")}, "'mass'"),
    ({"trajectory": 5}, "'trajectory'"),
]


@pytest.mark.parametrize(("changes", "told"), BAM_WRONG)
def test_bam_logs_are_refused(tmp_path: Path, changes: dict[str, Any], told: str) -> None:
    (tmp_path / "run.json").write_text(json.dumps(bam_log(**changes)))
    with pytest.raises(InputError, match=told):
        one("bam", tmp_path / "run.json")


@pytest.mark.parametrize("compressed", [True, False])
def test_emps_reads_what_scipy_writes(tmp_path: Path, compressed: bool) -> None:
    rng = np.random.default_rng(0)
    shorts = {"vir": np.arange(50, dtype=np.int16)[:, None], "cell": np.array([1, "a"], object)}
    arrays = {"t": np.arange(50.0)[:, None]} | {k: rng.normal(size=(50, 1)) for k in ("qg", "qm")}
    path = tmp_path / "x.mat"
    scipy.io.savemat(
        path, {"kp": 160.18, "s": {"a": 1}, **arrays, **shorts}, do_compression=compressed
    )
    recording = one("emps", path)
    np.testing.assert_array_equal(recording.target, arrays["qg"])
    np.testing.assert_array_equal(recording.position, arrays["qm"])
    np.testing.assert_allclose(recording.extras["load/axis"], np.arange(50) / 10)


def test_emps_files_are_refused(tmp_path: Path, monkeypatch: Any) -> None:
    column = np.arange(50.0)[:, None]
    path = tmp_path / "x.mat"
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"qm": column[:40]}, "one length"),
        ({"qm": np.where(column == 7, np.nan, column)}, "'qm', row 7"),
        ({"qm": column.T}, "'qm' has shape"),
        ({"qm": "text"}, "'qm' is missing, or is not made of numbers"),
        ({"qm": column + 1j}, "'qm' is missing, or is not made of numbers"),
        ({"t": -column}, "'time', row 1"),
    ]
    for changes, told in wrong:
        with pytest.raises(InputError, match=told):
            one("emps", write_emps(path, **changes))
    path.write_bytes(b"MATLAB 7.3" * 100)
    with pytest.raises(InputError, match="not a MATLAB file of format 5"):
        one("emps", path)
    zeros = {name: np.zeros((100_000, 1)) for name in ("t", "qg", "qm", "vir")}
    scipy.io.savemat(path, zeros, do_compression=True)
    for limit, value, told in (
        ("MAX_UNPACKED", 1000, "unpacked"),
        ("MAX_CELLS", 100, "has shape"),
        ("MAX_FILE", 100, "larger"),
    ):
        with monkeypatch.context() as patch, pytest.raises(InputError, match=told):
            patch.setattr(f"pup.importers.emps.{limit}", value)
            one("emps", path)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("0.05,1.0,,", "0.05,1.0,x,", "line 3, column 'position/a': 'x'"),
        ("0.05,1.0,,", "0.05,1.0,nan,", "line 3, column 'position/a': 'nan'"),
        ("0.05,1.0,,", "0.05,1_0,,", "line 3, column 'target/a'"),
        ("0.05,1.0,,", "0.05,1.0,", "line 3: 3 cells"),
        ("0.05,1.0,,", '0.05,1.0,"', "comma-separated"),
        ("0.05,1.0,,", "0.0,1.0,,", "'time', row 1"),
        ("0.05,1.0,,", ",1.0,,", "'time', row 1"),
        ("voltage", "volts", "'volts'"),
        ("voltage", "time", "'time' has no name or stands twice"),
        ("voltage", "", "'' has no name"),
        ("target/a", "target/b", "'target/b'"),
        (CSV, "", "line 1"),
        (CSV, CSV.replace(",", ";"), "line 1: no comma in 'time;target/a"),
        (CSV, f"# of the arm\n{CSV}", "line 1: no comma in '# of the arm'"),
        (CSV, "# pup.recording: {\n", "not a JSON"),
        (CSV, "# pup.recording: []\n", "schema"),
        (CSV, '# pup.recording: {"schema": 2}\n', "schema is 2"),
    ],
)
def test_csv_tables_are_refused(tmp_path: Path, old: str, new: str, told: str) -> None:
    (tmp_path / "log.csv").write_text(CSV.replace(old, new))
    with pytest.raises(InputError, match=told) as caught:
        one("csv", tmp_path / "log.csv", ARM)
    assert "log.csv" in str(caught.value)


@pytest.mark.parametrize(
    ("file", "old", "new", "told"),
    [
        ("control.csv", "20000,", "0,", "command time', row 1"),
        ("control.csv", '"[0.1, 0.1]"', '"[0.1]"', "control.csv: .*'positions'"),
        ("state_motor.csv", "20000,", "soon,", "state_motor.csv: line 3, column 'timestamp'"),
        ("state_motor.csv", "20000,", "NaN,", "'timestamp', row 1"),
        ("state_motor.csv", "velocities", "speeds", "line 2: column 'velocities' is missing"),
        ("joint_list.txt", "Knee", "Hip", "joint_list"),
    ],
)
def test_sage_folders_are_refused(tmp_path: Path, file: str, old: str, new: str, told: str) -> None:
    folder = write_sage(tmp_path / "walk")
    path = folder / file
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(InputError, match=told):
        one("sage", folder, ImportOptions(robot="biped", support="ground"))
    path.unlink()
    with pytest.raises(InputError, match=f"{file}(: no such file| in this folder)"):
        one("sage", folder)


def test_npz_never_loads_objects(tmp_path: Path) -> None:
    objects = np.array([{"a": 1}], dtype=object)
    np.savez(tmp_path / "t.npz", control_times=objects)
    with pytest.raises(InputError, match="objects, which are never loaded"):
        one("npz", tmp_path / "t.npz", ARM)


def test_npz_sizes_are_judged_before_arrays_are_read(tmp_path: Path, monkeypatch: Any) -> None:
    path = tmp_path / "t.npz"
    header = io.BytesIO()
    huge = {"descr": "<f8", "fortran_order": False, "shape": (10**12,)}
    np.lib.format.write_array_header_1_0(header, huge)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("control_times.npy", header.getvalue())
    with pytest.raises(InputError, match="too large"):
        one("npz", path, ARM)
    write_npz(path)
    monkeypatch.setattr(npz, "MAX_UNPACKED", 100)
    with pytest.raises(InputError, match="bytes are read"):
        one("npz", path, ARM)


def test_npz_mappings_must_fit_the_data(tmp_path: Path) -> None:
    good = npz_arrays()
    for key, value, told in (
        ("control_signal_mapping", '{"hip_ctrl": [5, [9]]}', "does not fit"),
        ("control_signal_mapping", '{"hip_ctrl": 5}', "does not fit"),
        ("control_signal_mapping", "[]", "not an object"),
        ("control_signal_mapping", '{"hip": [5, [0]], "hip_ctrl": [5, [0]]}', "two controls"),
        ("sensordata_signal_mapping", '{"gyro": [0, [0]]}', "no position of joint 'hip'"),
        ("sensordata_times", np.zeros(4), "state time', row 1"),
        ("sensordata_times", np.zeros(3), "'sensordata_data' has shape"),
    ):
        np.savez(tmp_path / "bad.npz", **(good | {key: np.asarray(value)}))
        with pytest.raises(InputError, match=told):
            one("npz", tmp_path / "bad.npz", ARM)
    del good["control_times"]
    np.savez(tmp_path / "bad.npz", **good)
    with pytest.raises(InputError, match="'control_times' is missing"):
        one("npz", tmp_path / "bad.npz", ARM)


@pytest.mark.parametrize("compression", list(CompressionType))
def test_mcap_bombs_are_refused(
    tmp_path: Path, monkeypatch: Any, compression: CompressionType
) -> None:
    path = write_json_mcap(tmp_path / "log.mcap", [{"time": " " * 1_000_000}], compression)
    monkeypatch.setattr(mcap_format, "MAX_UNPACKED", 100_000)
    with pytest.raises(InputError, match="bytes unpacked"):
        one("mcap", path, ARM)
    monkeypatch.setattr(mcap_format, "MAX_FILE", 100)
    with pytest.raises(InputError, match="larger than 100 bytes"):
        one("mcap", path, ARM)


@pytest.mark.parametrize(
    ("rows", "told"),
    [
        ([], "topics none"),
        ([3], "message 0: not a JSON object"),
        ([{"time": "now"}], "'time' is not made of numbers"),
        ([*ROWS, {"time": 0.2, "position/a": float("nan")}], "'position/a', row 3: nan"),
        ([ROWS[0], ROWS[0]], "'time', row 1"),
        ([{**row, "colour": 1} for row in ROWS], "'colour'"),
    ],
)
def test_mcap_rows_are_refused(tmp_path: Path, rows: list[Any], told: str) -> None:
    path = write_json_mcap(tmp_path / "log.mcap", rows, CompressionType.ZSTD)
    with pytest.raises(InputError, match=told):
        one("mcap", path, ARM)


def test_mcap_tells_what_is_missing_for_commands(tmp_path: Path) -> None:
    path = write_ros(tmp_path / "log.mcap", commands=None)
    for chosen in (None, "/joint_states"):
        with pytest.raises(InputError, match=r"there is only /joint_states: .* record both"):
            one("mcap", path, replace(ARM, state_topic=chosen))
    path = write_ros(tmp_path / "log.mcap", commands=3600.0)
    told = r"log\.mcap: the last reading is 3599\.91 s before the first command.* of one clock\?"
    with pytest.raises(InputError, match=told):
        one("mcap", path, ARM)
    path = write_ros(tmp_path / "log.mcap", commands=-3600.0)
    told = r"log\.mcap: the last command is 3599\.93 s before the first reading.* of one clock\?"
    with pytest.raises(InputError, match=told):
        one("mcap", path, ARM)


def test_one_command_before_all_readings_is_held() -> None:
    columns, note = join(
        np.array([1.0]), np.array([3.0, 3.5]), {"c": np.array([7.0])}, {"s": np.array([1.0, 2.0])}
    )
    assert columns["time"].tolist() == [0.0, 2.0, 2.5]
    assert columns["c"].tolist() == [7.0] * 3 and not note


def test_joints_of_an_archive_are_named_once_and_may_stand_apart(tmp_path: Path) -> None:
    """Of two columns of one name one would be lost."""
    arrays = {f"{kind}_times": np.arange(4) * 0.02 for kind in ("control", "sensordata")}
    arrays |= {f"{kind}_data": np.zeros((4, 2)) for kind in ("control", "sensordata")}
    np.savez(tmp_path / "t.npz", **arrays)
    command = ["import", "npz", tmp_path / "t.npz", "--robot-name", "arm", "--motion", "step"]
    command += ["--support", "bench", "--out", tmp_path / "out", "--joints"]
    done = pup(*command, "hip,hip")
    assert (done.code, "--joints hip,hip: names a joint twice" in done.err) == (2, True)
    assert pup(*command, "hip, knee").code == 0
    assert Recording.read(tmp_path / "out" / "t.parquet").joints == ("hip", "knee")


def test_a_recording_does_not_repeat_itself(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(CSV)
    with pytest.raises(InputError, match="--repeat-of log: is the recording itself"):
        one("csv", tmp_path / "log.csv", replace(ARM, repeat_of="log"))


@pytest.mark.parametrize("format", ["mcap", "npz"])
def test_a_log_that_cannot_be_opened_is_not_told_as_damaged(tmp_path: Path, format: str) -> None:
    with pytest.raises(InputError, match=r"cannot be read \(Is a directory\)"):
        FORMATS[format](tmp_path, ARM)


def test_a_message_is_short_whatever_the_file_holds(tmp_path: Path) -> None:
    """What a power loss leaves of a file may be as many zeros as it had bytes."""
    for content in ("\0" * 100_000, f"{'x' * 10_000}," * 2, "x,y\n1," + "\0" * 9000):
        (tmp_path / "log.csv").write_text(content)
        with pytest.raises(InputError, match=r"log\.csv: line [12]") as refused:
            one("csv", tmp_path / "log.csv", ARM)
        assert len(str(refused.value)) < 400 + len(str(tmp_path))


def test_text_in_another_encoding_is_told(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_bytes(CSV.replace("voltage", "größe").encode("latin-1"))
    with pytest.raises(InputError, match="save it as UTF-8"):
        one("csv", tmp_path / "log.csv", ARM)


@pytest.fixture(scope="module")
def logs(tmp_path_factory: Any) -> dict[str, tuple[str, bytes]]:
    """A whole log per format (SAGE's command file): file name and content."""
    folder = tmp_path_factory.mktemp("logs")
    (folder / "d.json").write_text(json.dumps(darwin_log()))
    (folder / "b.json").write_text(json.dumps(bam_log()))
    (folder / "c.csv").write_text(CSV)
    write_emps(folder / "e.mat")
    write_emps(folder / "z.mat", compressed=True)
    write_npz(folder / "n.npz")
    write_ros(folder / "m.mcap")
    write_json_mcap(folder / "j.mcap", ROWS, CompressionType.LZ4)
    write_sage(folder / "s")
    files = {
        "darwin-hardware": "d.json",
        "bam": "b.json",
        "csv": "c.csv",
        "emps": "e.mat",
        "emps compressed": "z.mat",
        "npz": "n.npz",
        "mcap": "m.mcap",
        "mcap json": "j.mcap",
        "sage": "s/control.csv",
    }
    return {name: (file, (folder / file).read_bytes()) for name, file in files.items()}


@pytest.mark.parametrize("name", [*FORMATS, "mcap json", "emps compressed"])
@settings(max_examples=60)
@given(data=st.data())
def test_damaged_logs_are_refused_or_read_and_nothing_else(
    tmp_path_factory: Any, logs: dict[str, tuple[str, bytes]], name: str, data: st.DataObject
) -> None:
    file, content = logs[name]
    damaged = bytearray(content)
    if data.draw(st.booleans(), label="cut"):
        del damaged[data.draw(st.integers(0, len(content) - 1)) :]
    else:
        for _ in range(data.draw(st.integers(1, 3))):
            damaged[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    folder = tmp_path_factory.mktemp("damaged")
    if name == "sage":
        write_sage(folder / "s")
    (folder / file).write_bytes(damaged)
    try:
        recordings = import_recordings(name.split()[0], [folder / file], options=ARM)
    except InputError as error:
        assert str(folder) in str(error)
        assert "\n" not in str(error)
    else:
        assert all(np.isfinite(recording.time).all() for recording in recordings)


@pytest.mark.parametrize("format", FORMATS)
def test_a_device_that_never_ends_is_not_read(format: str) -> None:
    with pytest.raises(InputError, match="/dev/zero: not a file"):
        import_recordings(format, [Path("/dev/zero")])
