"""The command line: what each verb writes, prints and answers."""

import hashlib
import json
import os
import pty
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import foreign_logs
import pytest
from commandline import BOTH, TINY, Outcome, files, pup, pup_process
from mcap.writer import CompressionType

from pup.recording import Recording, load_recordings
from pup.robot import RobotDescription

Check = Callable[[Path], None]
VERBS = ("run", "import", "record", "presysid", "replay")


@pytest.fixture
def check(request: pytest.FixtureRequest) -> Check:
    """The contract's checker; where it is absent, what else a test says still counts."""
    if not (Path(__file__).parents[2] / "shared").is_dir():
        return lambda path: None
    return request.getfixturevalue("check_contract")


@pytest.fixture(scope="module")
def identified(bench_recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `pup presysid` leaves of the bench's recordings."""
    out = tmp_path_factory.mktemp("identified")
    done = pup("presysid", bench_recordings, "--robot", "servo_bench", "--out", out, *BOTH)
    assert done.code == 0, done.err
    return out


def assert_plain_progress(done: Outcome) -> None:
    assert done.err
    for line in done.err.splitlines():
        assert " fits: " in line and "% " in line.replace("%,", "% "), line
    assert "\x1b" not in done.err and "\r" not in done.err


def test_record_writes_recordings_of_a_virtual_robot(tmp_path: Path, check: Check) -> None:
    done = pup_process(
        *("record", "step:0.1", "triangle", "--virtual", "--robot", "servo_bench"),
        *("--out", tmp_path / "rec", "--truth", tmp_path / "truth.json", "--json"),
    )
    assert (done.code, done.err) == (0, "")
    made = [Path(path) for path in done.json()["recordings"]]
    assert sorted(made) == sorted((tmp_path / "rec").iterdir())
    assert [p.name for p in made] == ["step_0.1.parquet", "triangle.parquet"]
    check(tmp_path / "rec")
    assert json.loads((tmp_path / "truth.json").read_text())["robot"] == "servo_bench"


def test_record_writes_its_truth_again_and_over_nothing_else(tmp_path: Path) -> None:
    truth = tmp_path / "truth.json"
    command = ("record", "step:0.1", "--virtual", "--robot", "servo_bench", "--truth", truth)
    for _ in range(2):
        assert pup(*command, "--out", tmp_path / "rec").code == 0
    for other in ('{"schema": 1}', "[robot]"):
        truth.write_text(other)
        done = pup(*command, "--out", tmp_path / "other")
        assert done.code == 2 and "holds something else; name another file" in done.err
        assert truth.read_text() == other and not (tmp_path / "other").exists()


def test_record_writes_scripts_for_a_robot_to_play(tmp_path: Path) -> None:
    command = (
        "record",
        "step:0.1",
        "chirp",
        "--scripts",
        "--robot",
        "darwin_leg",
        "--out",
        tmp_path,
    )
    for _ in range(2):
        done = pup(*command)
        assert done.code == 0, done.err
    assert done.out.splitlines() == [
        str(tmp_path / f"{name}.json") for name in ("step_0.1", "chirp")
    ]
    made = files(tmp_path)
    other = pup(*command, "--seed", 5)
    assert other.code == 2 and "is another script, or of another seed" in other.err
    assert files(tmp_path) == made


def test_record_again_writes_the_same(tmp_path: Path) -> None:
    command = ("record", "step:0.1", "--virtual", "--robot", "servo_bench", "--repeats", 2)
    for folder in ("a", "b", "a"):
        assert pup(*command, "--out", tmp_path / folder).code == 0
    assert list(files(tmp_path / "a")) == ["step_0.1.parquet", "step_0.1_again_1.parquet"]
    assert files(tmp_path / "a") == files(tmp_path / "b")


def foreign(folder: Path) -> dict[str, list[object]]:
    """A log of every format and how to import it."""
    folder.mkdir()
    arm = ["--robot-name", "arm", "--motion", "step", "--support", "bench"]
    (folder / "log.csv").write_text(foreign_logs.CSV)
    foreign_logs.write_npz(folder / "log.npz")
    foreign_logs.write_ros(folder / "ros.mcap")
    foreign_logs.write_json_mcap(folder / "rows.mcap", foreign_logs.ROWS, CompressionType.NONE)
    foreign_logs.write_emps(folder / "emps.mat")
    foreign_logs.write_sage(folder / "sage" / "chirp")
    (folder / "0.05_0.1_0.json").write_text(json.dumps(foreign_logs.darwin_log()))
    (folder / "bam.json").write_text(json.dumps(foreign_logs.bam_log()))
    return {
        "csv": [folder / "log.csv", *arm],
        "npz": [folder / "log.npz", *arm],
        "mcap": [folder / "ros.mcap", folder / "rows.mcap", *arm],
        "emps": [folder / "emps.mat", "--robot", "emps"],
        "sage": [folder / "sage", *arm],
        "darwin-hardware": [folder / "0.05_0.1_0.json", "--robot", "darwin_op2"],
        "bam": [folder / "bam.json", "--robot", "servo_bench", "--setup", "length=0.07"],
    }


@pytest.mark.parametrize("format", ["bam", "csv", "darwin-hardware", "emps", "mcap", "npz", "sage"])
def test_import_turns_logs_into_recordings(tmp_path: Path, check: Check, format: str) -> None:
    out = tmp_path / "new" / "out"
    done = pup("import", format, *foreign(tmp_path / "logs")[format], "--out", out, "--json")
    assert (done.code, done.err) == (0, "")
    made = done.json()["recordings"]
    assert sorted(made) == sorted(map(str, out.iterdir()))
    assert len(made) == (2 if format == "mcap" else 1)
    check(out)


def test_import_takes_what_the_log_does_not_tell_from_the_options(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(foreign_logs.CSV)
    done = pup_process(
        *("import", "csv", "log.csv", "--out", ".", "--robot-name", "arm", "--motion", "wave"),
        *("--support", "bench", "--source", "hardware", "--notes", "by hand"),
        *("--setup", "mass=0.5", "kp=16", "--setup", "vin=6"),
        folder=tmp_path,
    )
    assert (done.code, done.out, done.err) == (0, "log.parquet\n", "")
    recording = Recording.read(tmp_path / "log.parquet")
    assert recording.metadata() | {"id": ""} == {
        **{"schema": 1, "id": "", "robot": "arm", "motion": "wave", "support": "bench"},
        **{"setup": {"mass": 0.5, "kp": 16.0, "vin": 6.0}, "source": "hardware"},
        **{"repeat_of": None, "notes": "by hand"},
    }


def test_import_says_what_a_recording_repeats(tmp_path: Path) -> None:
    arm = ("--robot-name", "arm", "--motion", "step", "--support", "bench")
    for name in ("first", "again"):
        (tmp_path / f"{name}.csv").write_text(foreign_logs.CSV)
    again = ("import", "csv", tmp_path / "again.csv", *arm, "--repeat-of", "first")
    done = pup(*again, "--out", tmp_path)
    assert done.code == 0
    assert done.err == f"warning: 'again' repeats 'first', which is not in {tmp_path}\n"
    assert Recording.read(tmp_path / "again.parquet").repeat_of == "first"
    assert pup("import", "csv", tmp_path / "first.csv", *arm, "--out", tmp_path).code == 0
    assert pup(*again, "--out", tmp_path).err == ""


def test_presysid_writes_bounds_and_a_report(
    bench_recordings: Path, identified: Path, tmp_path: Path, check: Check
) -> None:
    out = tmp_path / "out"
    done = pup_process(
        "presysid", bench_recordings, "--robot", "servo_bench", "--out", out, *BOTH, "--json"
    )
    assert done.code == 0, done.err
    assert_plain_progress(done)
    bounds = json.loads((out / "bounds.json").read_text())
    assert done.json()["presysid"] == bounds
    assert done.json()["report"] == str(out / "report.html")
    assert {p["name"] for p in bounds["parameters"]} >= {"rho/servo", "torque_limit"}
    assert "<html" in (out / "report.html").read_text()
    check(out / "bounds.json")
    # Another process finds the same.
    known = json.loads((identified / "bounds.json").read_text())
    bounds["provenance"].pop("seconds"), known["provenance"].pop("seconds")
    assert bounds == known


@pytest.mark.usefixtures("short_polish")
def test_presysid_takes_more_generations_of_the_same_search(
    bench_recordings: Path, identified: Path, tmp_path: Path
) -> None:
    out = shutil.copytree(identified, tmp_path / "out")
    command = (
        "presysid",
        bench_recordings,
        "--robot",
        "servo_bench",
        "--out",
        out,
        *BOTH,
        "--json",
    )
    done = pup(*command, "--generations", 3)
    assert done.code == 0, done.err
    before = json.loads((identified / "bounds.json").read_text())["histories"]
    for name, history in done.json()["presysid"]["histories"].items():
        assert history[:2] == before[name][:2]
        assert len(history) >= 3


@pytest.mark.usefixtures("short_polish")
def test_presysid_begins_where_it_is_told_to(
    bench_recordings: Path, identified: Path, tmp_path: Path
) -> None:
    """A fit that starts at what another one found is never worse."""
    known = json.loads((identified / "bounds.json").read_text())
    start = shutil.copy(identified / "bounds.json", tmp_path / "known.json")
    kind, out = known["actuator"]["kind"], tmp_path / "out"
    done = pup(
        *("presysid", bench_recordings, "--robot", "servo_bench", "--out", out, *TINY),
        *("--actuator", kind, "--start", start, "--json"),
    )
    assert done.code == 0, done.err
    told = done.json()["presysid"]["loss"]["train"]
    assert told["loss_before"] == pytest.approx(known["loss"]["train"]["loss"], rel=1e-9)
    assert told["loss"] <= told["loss_before"] * (1 + 1e-12)
    options = done.json()["presysid"]["provenance"]["options"]
    assert options["start"] == hashlib.sha256(start.read_bytes()).hexdigest()


@pytest.mark.usefixtures("short_polish")
def test_presysid_takes_the_torque_law_that_a_robot_has(tmp_path: Path, check: Check) -> None:
    """The EMPS has no network: no option is needed to say so."""
    record = ("record", "step:0.1", "--virtual", "--robot", "emps", "--out", tmp_path / "rec")
    assert pup(*record).code == 0
    out = tmp_path / "out"
    done = pup("presysid", tmp_path / "rec", "--robot", "emps", "--out", out, *TINY)
    assert done.code == 0, done.err
    assert json.loads((out / "bounds.json").read_text())["actuator"]["kind"] == "pd"
    assert "kp/axis" in done.out and " m after" in done.out and "rad" not in done.out
    check(out / "bounds.json")
    done = pup("replay", tmp_path / "rec", "--robot", "emps", "--out", out, "--json")
    assert (done.code, done.json()["actuator"], done.json()["unit"]) == (0, "pd", "m")


def test_replay_writes_errors_and_plots(
    bench_recordings: Path, identified: Path, tmp_path: Path, check: Check
) -> None:
    out = tmp_path / "out"
    done = pup_process(
        *("replay", bench_recordings / "step_0.1.parquet", bench_recordings / "step_0.3.parquet"),
        *("--robot", "servo_bench", "--bounds", identified / "bounds.json", "--out", out, "--json"),
    )
    assert (done.code, done.err) == (0, "")
    document = json.loads((out / "replay.json").read_text())
    assert done.json() == document
    assert list(document["per_recording"]) == ["step_0.1", "step_0.3"]
    assert list(document["per_joint"]) == ["servo"]
    assert 0 < document["rmse"] < 0.1
    assert document["model"] == str(identified / "bounds.json")
    assert sorted(files(out)) == ["replay.json", "step_0.1.png", "step_0.3.png"]
    check(out / "replay.json")


def test_replay_without_bounds_takes_those_of_the_robot(
    bench_recordings: Path, identified: Path, tmp_path: Path
) -> None:
    robot = shutil.copytree(RobotDescription.load("servo_bench").folder, tmp_path / "robot")
    (robot / "identified.json").unlink(missing_ok=True)
    command = ("replay", bench_recordings, "--robot", robot, "--out", tmp_path / "out", "--json")
    assert pup(*command).json()["model"] == str(robot / "robot.toml")
    shutil.copy(identified / "bounds.json", robot / "identified.json")
    assert pup(*command).json()["model"] == str(robot / "identified.json")


@pytest.mark.usefixtures("short_polish")
def test_run_keeps_finished_stages_and_does_again_what_changed(
    bench_recordings: Path, tmp_path: Path, check: Check
) -> None:
    out = tmp_path / "out"
    command = ("run", "--recordings", bench_recordings, "--robot", "servo_bench", "--out", out)
    command += ("--effects", 0)
    first = pup(*command, *TINY, "--json")
    assert first.code == 0, first.err
    assert_plain_progress(first)
    told = first.json()
    assert told.keys() == {"presysid", "replay", "report", "unit", "took", "left_out"}
    assert told["left_out"].keys() == {"train", "transfer", "diagnosis"}
    check(out)
    made = files(out)
    times = {name: (out / name).stat().st_mtime_ns for name in made}
    assert {"run.json", "presysid/report.html", "replay/step_0.1.png"} <= made.keys()

    again = pup(*command, *TINY, "--json")
    assert (again.code, again.err) == (0, "")
    assert again.json() == first.json()
    assert {name: (out / name).stat().st_mtime_ns for name in files(out)} == times

    changed = pup(*command, *TINY, "--generations", 3, "--json")
    assert changed.code == 0, changed.err
    options = changed.json()["presysid"]["provenance"]["options"]
    assert options["generations"] == 3
    assert (out / "replay/replay.json").stat().st_mtime_ns > times["replay/replay.json"]

    (out / "replay" / "replay.json").unlink()
    (out / "presysid" / "bounds.json").write_text("{}")
    repaired = pup(*command, *TINY, "--generations", 3, "--json")
    assert repaired.code == 0, repaired.err
    assert repaired.json()["replay"] == changed.json()["replay"]
    assert repaired.json()["presysid"]["parameters"] == changed.json()["presysid"]["parameters"]


@pytest.mark.usefixtures("short_polish")
def test_run_does_again_what_another_recording_changes(
    bench_recordings: Path, tmp_path: Path
) -> None:
    recordings = shutil.copytree(bench_recordings, tmp_path / "rec")
    command = ("run", "--recordings", recordings, "--robot", "servo_bench", "--effects", 0)
    assert pup(*command, "--out", tmp_path / "out", *TINY).code == 0
    (recordings / "step_0.3.parquet").unlink()
    done = pup(*command, "--out", tmp_path / "out", *TINY)
    assert done.code == 2  # nothing of the old fit goes into the new one unseen
    assert "checkpoint of a fit with other recordings" in done.err
    done = pup(*command, "--out", tmp_path / "other", *TINY, "--json")
    assert done.code == 0
    assert list(done.json()["replay"]["per_recording"]) == ["step_0.1"]


def test_shows_tables_where_no_json_is_asked_for(
    bench_recordings: Path, identified: Path, tmp_path: Path
) -> None:
    out = shutil.copytree(identified, tmp_path / "out")
    done = pup("presysid", bench_recordings, "--robot", "servo_bench", "--out", out, *BOTH)
    assert done.code == 0
    for words in ("torque_limit", "identified", " rad after", f"report: {out}/report.html"):
        assert words in done.out
    command = ("replay", bench_recordings, "--robot", "servo_bench", "--out", tmp_path)
    done = pup(*command, "--bounds", out / "bounds.json")
    for words in ("step_0.1", "RMSE, rad", "all", "nn_pd"):
        assert words in done.out


def test_progress_is_live_on_a_terminal_and_stays_off_standard_output(
    bench_recordings: Path, tmp_path: Path
) -> None:
    reader, terminal = pty.openpty()
    command = [sys.executable, "-m", "services.cli", "presysid", bench_recordings, *TINY, "--json"]
    command += ["--robot", "servo_bench", "--out", tmp_path]
    with subprocess.Popen(
        list(map(str, command)),
        stdout=subprocess.PIPE,
        stderr=terminal,
        env=os.environ | {"TERM": "xterm"},
    ) as process:
        os.close(terminal)
        shown = b""
        try:
            while part := os.read(reader, 65536):
                shown += part
        except OSError:  # the terminal is gone
            pass
        assert process.stdout is not None
        out = process.stdout.read()
    os.close(reader)
    assert process.returncode == 0
    assert b"\x1b[" in shown and b"nominal_pd" in shown
    assert json.loads(out)["presysid"]["robot"] == "servo_bench"


def test_every_verb_explains_itself() -> None:
    whole = pup("--help")
    assert whole.code == 0
    for verb in VERBS:
        assert f"    {verb} " in whole.out
        told = pup(verb, "--help")
        assert told.code == 0
        assert "--out DIR" in told.out and "--json" in told.out
        assert "None" not in told.out


def test_tells_its_version_without_loading_the_simulator() -> None:
    from importlib.metadata import version

    code = (
        "import sys; from services.cli import main\n"
        "try: main(['--version'])\n"
        "finally: assert not {'mujoco', 'ray', 'nevergrad'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (0, f"pup {version('pup')}\n"), done.stderr


def test_a_recording_written_is_one_that_can_be_read(bench_recordings: Path) -> None:
    assert [r.id for r in load_recordings([bench_recordings])] == ["step_0.1", "step_0.3"]
