"""`pup diagnose` and `pup blind`: bad input ends with exit code 2, one clear line and no file."""

import json
import shutil
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from blind_sets import sealed
from commandline import files, pup, pup_process
from refusals import Cases, Made, Place, assert_refused, check

from pup.files import write_json
from pup.recording import Recording
from pup.recording_cuts import beginning

case = Cases()

# --- pup diagnose ---------------------------------------------------------------------------------


def diagnose(place: Place, *recordings: object, robot: object = "servo_bench") -> list[object]:
    return ["diagnose", *recordings, "--robot", robot, "--local", "--out", place.out]


@case("diagnose: no recording")
def _(place: Place) -> Made:
    return diagnose(place), ("RECORDING",)


def test_recordings_that_are_next_to_nothing_are_undetermined(
    bench_recordings: Path, tmp_path: Path
) -> None:
    """With a report as well as a document, though no reading is left to be compared."""
    whole = Recording.read(sorted(bench_recordings.glob("*.parquet"))[0])
    beginning(whole, 0.0).write(tmp_path / "short.parquet")
    made = pup(
        *("diagnose", tmp_path / "short.parquet", "--robot", "servo_bench", "--local"),
        *("--out", tmp_path / "out"),
    )
    assert made.code == 0, made.err
    told = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert told["verdict"] == "undetermined"
    assert "too few to tell anything" in (tmp_path / "out" / "report.html").read_text()


@case("diagnose: a folder without recordings")
def _(place: Place) -> Made:
    (place.here / "empty").mkdir()
    return diagnose(place, place.here / "empty"), (place.here / "empty", "pup import")


@case("diagnose: a folder that is not there")
def _(place: Place) -> Made:
    return diagnose(place, place.here / "nowhere"), (place.here / "nowhere", "No such file")


@case("diagnose: an unknown robot")
def _(place: Place) -> Made:
    words = ("asimo", "neither a built-in robot", "darwin_op2", "robot.toml")
    return diagnose(place, place.bench, robot="asimo"), words


@case("diagnose: recordings of another robot")
def _(place: Place) -> Made:
    words = (place.leg / "step_0.1.parquet", "'darwin_leg'", "l_knee", "'servo_bench'")
    return diagnose(place, place.leg), words


@case("diagnose: recordings of two robots")
def _(place: Place) -> Made:
    shutil.copy(place.leg / "step_0.1.parquet", place.here / "other.parquet")
    words = (place.here / "other.parquet", "l_knee", "'servo_bench'")
    return diagnose(place, place.bench, place.here / "other.parquet"), words


def renamed(place: Place, names: dict[str, str]) -> Path:
    """A recording of the leg with columns of other names."""
    table = pq.read_table(place.leg / "step_0.1.parquet")
    changed = table.rename_columns([names.get(n, n) for n in table.column_names])
    bad = place.here / "bad.parquet"
    pq.write_table(changed.replace_schema_metadata(table.schema.metadata), bad)
    return bad


@case("diagnose: an unknown joint")
def _(place: Place) -> Made:
    bad = renamed(place, {f"{kind}/l_knee": f"{kind}/tail" for kind in ("target", "position")})
    words = (bad, "unknown joints tail", "l_knee not recorded")
    return diagnose(place, bad, robot="darwin_leg"), words


@case("diagnose: targets and positions of different joints")
def _(place: Place) -> Made:
    bad = renamed(place, {"position/l_knee": "position/r_knee"})
    return diagnose(place, bad, robot="darwin_leg"), (bad, "target/l_knee", "position/l_knee")


@case("diagnose: a column twice")
def _(place: Place) -> Made:
    bad = renamed(place, {"position/l_hip_roll": "position/l_knee"})
    return diagnose(place, bad, robot="darwin_leg"), (bad, "position/l_knee", "twice")


@case("diagnose: a Parquet file cut off")
def _(place: Place) -> Made:
    good = (place.bench / "step_0.1.parquet").read_bytes()
    bad = place.write("bad.parquet", good[: len(good) // 2])
    return diagnose(place, place.bench, bad), (bad, "not a readable Parquet file")


@case("diagnose: a file in place of --out")
def _(place: Place) -> Made:
    command = diagnose(place, place.bench)
    return [*command, "--out", place.write("file", "")], ("file in its place",)


@case("diagnose: an address where no cluster is")
def _(place: Place) -> Made:
    command = [a for a in diagnose(place, place.bench) if a != "--local"]
    return [*command, "--address", "127.0.0.1:1"], ("127.0.0.1:1", "no Ray cluster answers")


@case("diagnose: no cores")
def _(place: Place) -> Made:
    return [*diagnose(place, place.bench), "--cores", 0], ("--cores", "1 and 4096")


# --- pup blind make -------------------------------------------------------------------------------


def make(place: Place, *options: object, key: Path | None = None) -> list[object]:
    key = key or place.here / "key.json"
    return ["blind", "make", "--seed", 16 * "s", "--key", key, "--out", place.out, *options]


ONE = ("--nulls", "servo_bench=1")
MAKE: dict[str, tuple[tuple[object, ...], tuple[object, ...]]] = {
    "no case": ((), ("--robot NAME=COUNT",)),
    "none of a robot": (("--robot", "servo_bench=0"), ("no case asked for",)),
    "an unknown robot": (("--robot", "asimo=1"), ("'asimo'", "servo_bench")),
    "a robot without a count": (("--robot", "servo_bench"), ("NAME=COUNT",)),
    "half a case": (("--robot", "servo_bench=0.5"), ("NAME=COUNT",)),
    "fewer than no case": (("--nulls", "servo_bench=-1"), ("NAME=COUNT",)),
}
for _name in MAKE:

    @case(f"blind make: {_name}")
    def _(place: Place, name: str = _name) -> Made:
        options, words = MAKE[name]
        return make(place, *options), words


@case("blind make: no seed")
def _(place: Place) -> Made:
    return ["blind", "make", *ONE, "--key", place.here / "k", "--out", place.out], ("--seed",)


@case("blind make: a key within the set")
def _(place: Place) -> Made:
    key = place.out / "key.json"
    return make(place, *ONE, key=key), (key, "outside of the set's folder")


@case("blind make: a key that is there")
def _(place: Place) -> Made:
    key = place.write("key.json", "{}")
    return make(place, *ONE), (key, "a key already")


@case("blind make: a file in place of --out")
def _(place: Place) -> Made:
    return [*make(place, *ONE), "--out", place.write("file", "")], ("file in its place",)


# --- pup blind run --------------------------------------------------------------------------------


def bench_set(place: Place) -> Path:
    """A set of one case."""
    shutil.copytree(place.bench, place.here / "set" / "case_a" / "recordings")
    return sealed(place.here, {"a": {}})


def run(place: Place, folder: object, *options: object) -> list[object]:
    return ["blind", "run", "--set", folder, "--out", place.out, "--local", *options]


@case("blind run: a set that is not there")
def _(place: Place) -> Made:
    nowhere = place.here / "nowhere"
    return run(place, nowhere), (nowhere, "no commitment.json in it")


@case("blind run: a folder that is no set")
def _(place: Place) -> Made:
    return run(place, place.bench), (place.bench, "no commitment.json in it")


COMMITMENTS = {
    "torn": ('{"schema"', "not a JSON document"),
    "of another schema": ('{"schema": 2}', "not a commitment"),
    "that is a list": ("[]", "not a commitment"),
    "to nothing": ('{"schema": 1}', "not those that its commitment names"),
}
for _name in COMMITMENTS:

    @case(f"blind run: a commitment {_name}")
    def _(place: Place, name: str = _name) -> Made:
        text, words = COMMITMENTS[name]
        folder = bench_set(place)
        (folder / "commitment.json").write_text(text)
        return run(place, folder), (folder, words)


@case("blind run: a recording that was changed")
def _(place: Place) -> Made:
    folder = bench_set(place)
    first, second = sorted(folder.glob("case_a/recordings/*"))[:2]
    shutil.copy(first, second)
    return run(place, folder), (folder, "not those that its commitment names")


@case("blind run: a set without cases")
def _(place: Place) -> Made:
    (place.here / "set").mkdir()
    return run(place, sealed(place.here, {})), (place.here / "set", "without a case")


@case("blind run: diagnoses within the set")
def _(place: Place) -> Made:
    folder = bench_set(place)
    return [*run(place, folder), "--out", folder / "out"], (folder / "out", "set's own folder")


@case("blind run: a file in place of --out")
def _(place: Place) -> Made:
    command = run(place, bench_set(place))
    return [*command, "--out", place.write("file", "")], ("file in its place",)


@case("blind run: an address where no cluster is")
def _(place: Place) -> Made:
    command = [a for a in run(place, bench_set(place)) if a != "--local"]
    return [*command, "--address", "127.0.0.1:1"], ("127.0.0.1:1", "no Ray cluster answers")


RUN: dict[str, tuple[tuple[object, ...], tuple[object, ...]]] = {
    "no cores": (("--cores", 0), ("--cores", "1 and 4096")),
    "cores that are no number": (("--cores", "all"), ("--cores", "whole number")),
    "no case of many": (("--limit", 0), ("--limit", "not between")),
    "a cluster and none": (("--address", "auto"), ("--address", "not allowed with", "--local")),
}
for _name in RUN:

    @case(f"blind run: {_name}")
    def _(place: Place, name: str = _name) -> Made:
        options, words = RUN[name]
        return run(place, bench_set(place), *options), words


# --- pup blind score ------------------------------------------------------------------------------


def score(place: Place, folder: Path, **changes: object) -> list[object]:
    """A score of one verdict."""
    verdict: dict[str, Any] = {"schema": 1, "verdict": "none", "findings": []}
    write_json(place.here / "verdicts" / "case_a" / "diagnosis.json", verdict)
    options = {
        "set": folder,
        "key": place.here / "key.json",
        "diagnoses": place.here / "verdicts",
        "out": place.out / "scores.json",
    } | changes
    return ["blind", "score", *(o for n, v in options.items() for o in (f"--{n}", v))]


@case("blind score: a set that is not there")
def _(place: Place) -> Made:
    nowhere = place.here / "nowhere"
    return score(place, nowhere), (nowhere, "no commitment.json in it")


@case("blind score: no key")
def _(place: Place) -> Made:
    nowhere = place.here / "nowhere.json"
    return score(place, bench_set(place), key=nowhere), (nowhere, "cannot be read")


@case("blind score: another key")
def _(place: Place) -> Made:
    folder = bench_set(place)
    other = place.write("other.json", json.dumps({"schema": 1, "salt": "cd", "cases": []}))
    return score(place, folder, key=other), (other, "not the key that")


@case("blind score: a key that is none")
def _(place: Place) -> Made:
    folder = bench_set(place)
    other = place.write("other.json", "[]")
    return score(place, folder, key=other), (other, "not a key of a blind set")


@case("blind score: no verdict")
def _(place: Place) -> Made:
    command = score(place, bench_set(place), diagnoses=place.here / "nowhere")
    return command, (place.here / "nowhere", "no case_<id>/diagnosis.json")


@case("blind score: a torn verdict")
def _(place: Place) -> Made:
    command = score(place, bench_set(place))
    torn = place.write("verdicts/case_a/diagnosis.json", "{")
    return command, (torn, "not a JSON document")


@case("blind score: verdicts on another set")
def _(place: Place) -> Made:
    command = score(place, bench_set(place))
    told = {"schema": 1, "set": {"key_sha256": "0"}, "engine": {}, "sessions": []}
    write_json(place.here / "verdicts" / "run.json", told)
    return command, (place.here / "verdicts" / "run.json", "another set")


@case("blind score: a torn journal")
def _(place: Place) -> Made:
    command = score(place, bench_set(place))
    torn = place.write("verdicts/run.json", '{"schema": 1}')
    return command, (torn, "not the journal")


@case("blind score: a folder in place of --out")
def _(place: Place) -> Made:
    return score(place, bench_set(place), out=place.here), (place.here, "needs a file")


@case("blind score: scores where the table goes")
def _(place: Place) -> Made:
    return score(place, bench_set(place), out=place.out / "scores.md"), ("scores.md", "JSON")


@case("blind score: a file on the way to --out")
def _(place: Place) -> Made:
    below = place.write("file", "") / "scores.json"
    return score(place, bench_set(place), out=below), ("file in its place",)


@case("blind: no action")
def _(place: Place) -> Made:
    return ["blind"], ("ACTION",)


# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", case)
def test_refuses(place: Place, name: str) -> None:
    check(place, case[name](place))


@pytest.mark.parametrize(
    "name", ["diagnose: a Parquet file cut off", "blind run: a folder that is no set"]
)
def test_refuses_in_a_process_of_its_own(place: Place, name: str) -> None:
    command, words = case[name](place)
    before = files(place.here)
    assert_refused(pup_process(*command), *words)
    assert files(place.here) == before


def changed(place: Place, **changes: Any) -> dict[str, bytes]:
    """Diagnoses of a set with something else in their journal."""
    journal = {
        "schema": 1,
        "set": {"key_sha256": "0", "recordings_sha256": "0"},
        "engine": {"git_sha": "abc", "source_sha256": "0", "versions": {}},
        "sessions": [],
    }
    write_json(place.out / "run.json", journal | changes)
    return files(place.out)


def test_refuses_to_go_on_with_another_set(place: Place) -> None:
    before = changed(place)
    assert_refused(pup(*run(place, bench_set(place))), place.out, "another set")
    assert files(place.out) == before


def test_refuses_to_go_on_with_another_engine(place: Place) -> None:
    folder = bench_set(place)
    commitment = json.loads((folder / "commitment.json").read_text())
    same = {name: commitment[name] for name in ("key_sha256", "recordings_sha256")}
    before = changed(place, set=same)
    assert_refused(pup(*run(place, folder)), place.out, "another engine (abc")
    assert files(place.out) == before


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"schema": 1, "set": 1}', "\x00"])
def test_refuses_a_damaged_journal(place: Place, content: str) -> None:
    place.out.mkdir()
    (place.out / "run.json").write_text(content)
    assert_refused(pup(*run(place, bench_set(place))), place.out / "run.json")
    assert files(place.out) == {"run.json": content.encode()}


def test_refuses_a_folder_with_something_else(place: Place) -> None:
    place.out.mkdir()
    (place.out / "notes.txt").write_text("mine")
    assert_refused(pup(*run(place, bench_set(place))), place.out, "no run.json in it")
    assert list(files(place.out)) == ["notes.txt"]
