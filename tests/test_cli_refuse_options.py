"""The command line: bad options and places end with exit code 2, one clear line and no file."""

import json
import os
import shutil
from pathlib import Path

import foreign_logs
import numpy as np
import pytest
from commandline import TINY, briefly_polished, files, pup, pup_process
from refusals import LOG, TOLD, Cases, Made, Place, assert_refused, check

from pup.robot import RobotDescription

case = Cases()

# --- Importing ------------------------------------------------------------------------------------


@case("an unknown format")
def _(place: Place) -> Made:
    return place.importing("excel", place.write("x.csv", LOG)), ("'excel'", "csv, ", "mcap")


@case("a log that is not there")
def _(place: Place) -> Made:
    return place.importing("csv", place.here / "x.csv"), (place.here / "x.csv", "no such file")


@case("a folder without logs")
def _(place: Place) -> Made:
    (place.here / "logs").mkdir()
    return place.importing("mcap", place.here / "logs"), (place.here / "logs", "no *.mcap")


@case("a bad log behind a good one")
def _(place: Place) -> Made:
    good, bad = place.write("a.csv", LOG), place.write("b.csv", LOG.replace("0.5", "nan"))
    command = place.importing("csv", good, bad, "--robot", "servo_bench", *TOLD)
    return command, (bad, "line 3, column 'position/servo'", "leave a missing cell empty")


@case("two logs of one name")
def _(place: Place) -> Made:
    (place.here / "more").mkdir()
    logs = [place.write("a.csv", LOG), place.write("more/a.csv", LOG)]
    command = place.importing("csv", *logs, "--robot", "servo_bench", *TOLD)
    return command, (logs[1], "id 'a'", "rename")


@case("a log of the name of another one's recording")
def _(place: Place) -> Made:
    told = ("--robot", "servo_bench", *TOLD, "--out", place.here)
    assert pup("import", "csv", place.write("1.csv", LOG), *told).code == 0
    log = place.write("1.csv", LOG.replace("0.5", "0.6"))
    words = (place.here / "1.parquet", "another recording", "rename the log")
    return ["import", "csv", log, *told], words


@case("two logs that repeat one recording")
def _(place: Place) -> Made:
    logs = [place.write(f"{name}.csv", LOG) for name in "ab"]
    command = place.importing("csv", *logs, "--robot", "servo_bench", *TOLD, "--repeat-of", "c")
    return command, ("--repeat-of", "one recording", "2")


@case("a log that does not tell the motion")
def _(place: Place) -> Made:
    log = place.write("x.csv", LOG)
    command = place.importing("csv", log, "--robot", "servo_bench", "--support", "bench")
    return command, (log, "the motion", "--motion")


@case("an archive that claims a huge array")
def _(place: Place) -> Made:
    arrays = foreign_logs.npz_arrays()
    arrays["control_data"] = np.zeros((30_000_000, 1))
    np.savez_compressed(place.here / "bomb.npz", **arrays)
    assert (place.here / "bomb.npz").stat().st_size < 2**20
    command = place.importing("npz", place.here / "bomb.npz", "--robot-name", "arm", *TOLD)
    return command, (place.here / "bomb.npz", "control_data", "too large")


def with_setup(place: Place, *setup: str) -> list[object]:
    log = place.write("x.csv", LOG)
    return place.importing("csv", log, "--robot", "servo_bench", *TOLD, *setup)


SETUPS = {
    "an unknown knob": (("--setup", "flavour=1"), ("x.csv", "'flavour' is no knob", "length")),
    "a knob outside its limits": (
        ("--setup", "mass=50"),
        ("x.csv", "mass = 50 kg", "outside [0.001, 2]"),
    ),
    "one knob twice": (
        ("--setup", "mass=0.5", "--setup", "kp=16", "mass=0.6"),
        ("mass is given twice", "0.5", "0.6"),
    ),
    "a knob that is no number": (("--setup", "mass=heavy"), ("'mass=heavy'", "KNOB=NUMBER")),
    "a knob that is not finite": (("--setup", "mass=nan"), ("'mass'", "finite number")),
    "a nameless knob": (("--setup", "=1"), ("'=1'", "KNOB=NUMBER")),
}
for _name in SETUPS:

    @case(f"a setup with {_name}")
    def _(place: Place, name: str = _name) -> Made:
        setup, words = SETUPS[name]
        return with_setup(place, *setup), words


@case("a robot and the name of another")
def _(place: Place) -> Made:
    return with_setup(place, "--robot-name", "arm"), ("--robot-name", "not allowed with", "--robot")


# --- Recording ------------------------------------------------------------------------------------


@case("an unknown motion")
def _(place: Place) -> Made:
    return place.record("step:0.1", "dance"), ("'dance'", "darwin_leg", "step, hold")


@case("a motion of an impossible size")
def _(place: Place) -> Made:
    return place.record("step:7"), ("'step:7'", "0.01 to 1")


@case("a stand-up of a robot without a free base")
def _(place: Place) -> Made:
    return place.record("standup"), ("'standup'", "darwin_leg", "can play step")


@case("a knob that the robot has not")
def _(place: Place) -> Made:
    return place.record("step:0.1", "--setup", "mass=1"), ("'mass' is no knob", "darwin_leg")


@case("a knob that is told twice")
def _(place: Place) -> Made:
    return place.record("step:0.1", "--setup", "kp=20", "kp=30"), ("--setup: kp", "twice")


@case("a knob of a virtual robot for scripts")
def _(place: Place) -> Made:
    command = ["record", "step", "--scripts", "--robot", "darwin_leg", "--out", place.out]
    return [*command, "--setup", "kp=20"], ("--setup is for --virtual", "pup-agent play")


@case("a recording without a word of who plays")
def _(place: Place) -> Made:
    command = ["record", "step", "--robot", "darwin_leg", "--out", place.out]
    return command, ("--virtual", "--scripts")


@case("scripts that are repeated")
def _(place: Place) -> Made:
    command = ["record", "step", "--scripts", "--robot", "darwin_leg", "--out", place.out]
    return [*command, "--repeats", 2], ("--repeats", "`pup-agent play` has one of its own")


@case("scripts in a folder of other files")
def _(place: Place) -> Made:
    command = ["record", "step:0.1", "--scripts", "--robot", "darwin_leg", "--out", place.here]
    place.write("other.json", "{}")
    return command, ("holds other files (other.json)",)


@case("a truth that is a folder")
def _(place: Place) -> Made:
    return place.record("step:0.1", "--truth", place.here), (place.here, "--truth needs a file")


# --- Options --------------------------------------------------------------------------------------

OPTIONS: dict[str, tuple[tuple[object, ...], tuple[str, ...]]] = {
    "more folds than recordings": (("--folds", 3), ("3 folds for 2 recordings", "or 0")),
    "folds of values that are kept": (("--as-described", "--folds", 2), ("no folds",)),
    "values fitted to what was not recorded": (
        ("--as-described", "--actuator", "pd", "--fitted-to", "fall"),
        ("no recording of type fall", "there are"),
    ),
    "a network that is kept": (
        ("--as-described", "--actuator", "nn_pd"),
        ("whose servos are PD; use --actuator pd",),
    ),
    "values that are fitted anyway": (
        ("--fitted-to", "step"),
        ("matters where they are kept as described",),
    ),
    "a single fold": (("--folds", 1), ("1 folds for 2 recordings", "or 0")),
    "negative generations": (("--generations", -3), ("--generations", "-3", "1 and 100000")),
    "a population of three": (("--population", 3), ("--population", "4 and 4096")),
    "half a subset": (("--subsets", "0.5"), ("--subsets", "whole number")),
    "a fraction above one": (("--fraction", "1.5"), ("--fraction", "0 and 1")),
    "a fraction that is no number": (("--fraction", "nan"), ("--fraction", "0 and 1")),
    "an unknown torque law": (("--actuator", "magic"), ("--actuator", "nn_pd")),
    "a cluster and none": (("--address", "auto"), ("--address", "not allowed with", "--local")),
    "an unknown option": (("--speed", "fast"), ("--speed",)),
}
for _name in OPTIONS:

    @case(_name)
    def _(place: Place, name: str = _name) -> Made:
        options, words = OPTIONS[name]
        return place.presysid(*options), words


@case("a start of a torque law that is not fitted")
def _(place: Place) -> Made:
    actuator = {"kind": "nn_pd", "weights": [0.0] * 27}
    told = {"schema": 1, "robot": "darwin_leg", "actuator": actuator, "parameters": []}
    start = place.write("bounds.json", json.dumps(told))
    law = ("--actuator", "pd", "--no-comparison", "--start", start)
    given = ["presysid", place.leg, "--robot", "darwin_leg", "--out", place.out, "--local", *law]
    return given, (start, "nn_pd", "--actuator nn_pd")


@case("an address where no cluster is")
def _(place: Place) -> Made:
    command = [a for a in place.presysid("--address", "127.0.0.1:1") if a != "--local"]
    return command, ("127.0.0.1:1", "no Ray cluster answers")


@case("an address that is none")
def _(place: Place) -> Made:
    command = [a for a in place.presysid("--address", "here") if a != "--local"]
    return command, ("--address here", "host:port")


@case("no verb")
def _(place: Place) -> Made:
    return [], ("VERB",)


@case("an unknown verb")
def _(place: Place) -> Made:
    return ["walk", "--out", place.out], ("'walk'", "'replay'")


@case("no --out")
def _(place: Place) -> Made:
    return place.replay(place.bench)[:-2], ("--out",)


def test_what_may_be_left_out_is_not_asked_for(place: Place) -> None:
    assert_refused(pup("jobs", "fetch", "--out", place.out), "required: JOB;")


# --- Places to write to ---------------------------------------------------------------------------


@case("a file in place of --out")
def _(place: Place) -> Made:
    return [*place.replay(place.bench), "--out", place.write("file", "")], ("file in its place",)


@case("a file on the way to --out")
def _(place: Place) -> Made:
    below = place.write("file", "") / "out"
    return [*place.replay(place.bench), "--out", below], (below, "file in its place")


@case("an --out that cannot be made")
def _(place: Place) -> Made:
    if not Path("/proc/self").is_dir():
        pytest.skip("no /proc here")
    return [*place.replay(place.bench), "--out", "/proc/pup/out"], ("/proc/pup/out", "cannot")


@case("an --out that cannot be written to")
def _(place: Place) -> Made:
    if os.geteuid() == 0:
        pytest.skip("root may write anywhere")
    closed = place.here / "closed"
    closed.mkdir(mode=0o500)
    return [*place.replay(place.bench), "--out", closed], (closed, "cannot be written to")


# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", case)
def test_refuses(place: Place, name: str) -> None:
    check(place, case[name](place))


@pytest.mark.parametrize("name", ["an archive that claims a huge array", "negative generations"])
def test_refuses_in_a_process_of_its_own(place: Place, name: str) -> None:
    command, words = case[name](place)
    assert_refused(pup_process(*command), *words)
    assert not place.out.exists()


def test_refuses_to_mix_recordings_of_virtual_robots(place: Place) -> None:
    place.out.mkdir()
    shutil.copy(place.leg / "step_0.1.parquet", place.out)
    before = files(place.here)
    assert_refused(pup(*place.record("step:0.3")), place.out, "step_0.1", "empty folder")
    assert files(place.here) == before


@pytest.fixture(scope="module")
def identified(bench_recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `pup presysid` leaves of the bench's recordings."""
    out = tmp_path_factory.mktemp("identified")
    with briefly_polished():
        done = pup("presysid", bench_recordings, "--robot", "servo_bench", "--out", out, *TINY)
    assert done.code == 0, done.err
    return out


def test_refuses_the_checkpoints_of_other_recordings(place: Place, identified: Path) -> None:
    shutil.copytree(identified, place.out)
    before = files(place.here)
    command = place.presysid()
    command[1] = place.bench / "step_0.1.parquet"
    done = pup(*command)
    assert_refused(done, place.out / "checkpoints", "other recordings", "use another --out")
    assert files(place.here) == before


def test_refuses_the_checkpoints_of_another_seed(place: Place, identified: Path) -> None:
    shutil.copytree(identified, place.out)
    before = files(place.here)
    assert_refused(pup(*place.presysid("--seed", 1)), "settings", "use another --out")
    assert files(place.here) == before


def test_refuses_a_start_that_is_none(place: Place, identified: Path) -> None:
    known = shutil.copy(identified / "bounds.json", place.here / "known.json")
    other = RobotDescription.load("darwin_op2").identified_path
    law = "nn_pd" if json.loads(known.read_text())["actuator"]["kind"] == "pd" else "pd"
    far = json.loads(known.read_text())
    parameter = far["parameters"][0]
    parameter["nominal"] = 2 * parameter["search"][1]
    beyond = place.write("far.json", json.dumps(far))
    for options, words in (
        (("--start", place.here / "none.json"), ("none.json",)),
        (("--start", beyond), (beyond, parameter["name"], "outside its search range")),
        (("--start", other), (other, "darwin_op2", "servo_bench")),
        (("--start", known, "--actuator", law), (known, "torque law", "not fitted")),
    ):
        assert_refused(pup(*place.presysid(*options)), *words)
        assert not place.out.exists()


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"hello"])
def test_refuses_a_damaged_checkpoint(place: Place, identified: Path, content: bytes) -> None:
    shutil.copytree(identified, place.out)
    damaged = place.out / "checkpoints" / "nominal_pd.npz"
    damaged.write_bytes(content)
    before = files(place.here)
    assert_refused(pup(*place.presysid()), damaged, "not a checkpoint", "delete it")
    assert files(place.here) == before


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"stages": 1}', "\x00"])
def test_refuses_a_damaged_journal(place: Place, content: str) -> None:
    place.out.mkdir()
    (place.out / "run.json").write_text(content)
    command = ["run", "--recordings", place.bench, "--robot", "servo_bench", "--out", place.out]
    assert_refused(pup(*command, *TINY), place.out / "run.json")
    assert files(place.out) == {"run.json": content.encode()}


def test_a_full_disk_leaves_no_half_import(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second recording cannot be written: the first is not there either."""
    from pup import recording

    logs = [place.write(f"{name}.csv", LOG) for name in "ab"]
    write = recording.Recording.write

    def full(self: recording.Recording, path: Path) -> None:
        if self.id == "b":
            raise OSError(28, "No space left on device", str(path))
        write(self, path)

    monkeypatch.setattr(recording.Recording, "write", full)
    done = pup(*place.importing("csv", *logs, "--robot", "servo_bench", *TOLD))
    assert done.code == 1  # another time it may be written
    (line,) = done.err.splitlines()
    assert "No space left on device" in line
    assert not place.out.exists()


def test_a_missing_recording_leaves_an_earlier_result_as_it_was(place: Place) -> None:
    command = place.replay(place.bench)
    assert pup(*command).code == 0
    before = files(place.out)
    assert_refused(pup(*command, "--bounds", place.here / "none.json"), "none.json")
    assert files(place.out) == before
