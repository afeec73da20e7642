"""`pup blind run`: all cases of a set, whatever happens meanwhile."""

import json
import os
import shutil
import signal
import subprocess
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from blind_sets import FRICTION, motions, poor, seal, sealed
from commandline import Outcome, files, pup, pup_process
from diagnosis_cases import recordings
from jobs import Job

from pup.errors import InputError
from pup.files import read_json, write_json
from pup.recording import load_recordings
from pup.robot import RobotDescription
from services import blind_run
from services.blind_journal import Journal
from services.blind_oracle import replayed
from services.blind_run import Order, diagnose_case, orders, run_cases
from services.failures import FailedError
from services.places import OneByOne
from workers.cases import RayPool
from workers.cluster import connected

TIMES = ("seconds", "processor_seconds", "corrected_robot")


def run(folder: Path, *more: object, out: str = "out") -> Outcome:
    return pup(*command(folder), "--out", folder / out, "--local", *more)


def command(folder: Path) -> tuple[object, ...]:
    return ("blind", "run", "--set", folder / "set")


def told(out: Path) -> dict[str, Any]:
    """All verdicts of a folder, but for the times they took and the places they are at."""
    found = {}
    for file in sorted(out.glob("case_*/diagnosis.json")):
        found[file.parent.name] = document = json.loads(file.read_text())
        for name in TIMES:
            del document[name]
    return found


def journal(folder: Path) -> Any:
    return read_json(folder / "out" / "run.json")


@pytest.fixture(scope="module")
def scored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set of a case with friction and one with nothing missing; leave it as it is."""
    folder = tmp_path_factory.mktemp("blind")
    missing = {"0f": FRICTION, "1n": {}}
    parts = {name: motions(m) for name, m in missing.items()}
    seal(
        folder,
        {name: given for name, (given, _) in parts.items()},
        missing,
        {name: kept for name, (_, kept) in parts.items()},
    )
    return folder


@pytest.fixture(scope="module")
def diagnosed(scored: Path) -> Path:
    """The same with its diagnoses under `out`."""
    done = pup_process(*command(scored), "--out", scored / "out", "--local", "--json")
    assert done.code == 0, done.err
    assert done.json()["cases"] == 2
    lines = done.err.splitlines()
    assert lines[0] == "blind run: 0/2 cases"
    assert "left; case_" in lines[1] and lines[1].startswith("blind run: 1/2 cases, ")
    assert lines[2].startswith("blind run: 2/2 cases; case_")
    return scored


def test_a_set_is_diagnosed_from_beginning_to_end(diagnosed: Path, check_contract) -> None:
    out = diagnosed / "out"
    verdicts = {name: document["verdict"] for name, document in told(out).items()}
    assert verdicts == {"case_0f": "mismatch", "case_1n": "none"}
    for case in sorted(out.glob("case_*")):
        check_contract(case / "diagnosis.json")
        assert sorted(p.name for p in case.iterdir()) == ["corrected", "diagnosis.json"]
        document = read_json(case / "diagnosis.json")
        assert document["robot"] == "servo_bench"
        assert document["processor_seconds"] > 0 and document["seconds"] > 0


def test_the_journal_names_the_engine_and_the_set(diagnosed: Path) -> None:
    git = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
    sha = subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip() or None
    noted = journal(diagnosed)
    assert noted["engine"]["git_sha"] == sha
    assert isinstance(noted["engine"]["dirty"], bool) or sha is None
    assert noted["engine"]["versions"].keys() >= {"pup", "mujoco", "numpy", "python"}
    commitment = read_json(diagnosed / "set" / "commitment.json")
    assert noted["set"] == {n: commitment[n] for n in ("key_sha256", "recordings_sha256")}
    (session,) = noted["sessions"]
    assert session["started"] <= session["ended"]
    assert session["failed"] == {}
    assert session["source_changed"] in (True, False)  # who edits the engine meanwhile changes it


def test_the_verdicts_are_those_of_pup_diagnose(diagnosed: Path, tmp_path: Path) -> None:
    case = diagnosed / "set" / "case_1n" / "recordings"
    done = pup("diagnose", case, "--robot", "servo_bench", "--local", "--out", tmp_path, "--json")
    assert done.code == 0, done.err
    alone = {name: value for name, value in done.json().items() if name not in TIMES}
    assert alone == told(diagnosed / "out")["case_1n"]
    assert (tmp_path / "report.html").exists()


def test_scores_have_the_oracle_ratio_and_both_commits(diagnosed: Path, tmp_path: Path) -> None:
    options = ("--set", diagnosed / "set", "--key", diagnosed / "key.json")
    where = ("--diagnoses", diagnosed / "out", "--out", tmp_path / "scores.json")
    done = pup("blind", "score", *options, *where, "--json")
    assert done.code == 0, done.err
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert scores["all"]["class_top1"]["hits"] == 1
    assert scores["nulls"]["told_none"]["hits"] == 1
    assert scores["all"]["oracle_ratio"]["of"] == 1
    assert 0.8 < scores["all"]["oracle_ratio"]["mean"] < 1.1
    assert scores["all"]["seconds"]["mean"] > 0
    assert scores["engine"] == journal(diagnosed)["engine"]
    assert scores["commitment"]["engine_git_sha"] is None
    table = (tmp_path / "scores.md").read_text()
    assert "to engine not named; diagnosed by " in table
    assert str(scores["engine"]["git_sha"] or "without a commit") in table


def test_a_model_that_cannot_be_replayed_is_none_or_refused(
    diagnosed: Path, tmp_path: Path
) -> None:
    tests = load_recordings([diagnosed / "set" / "case_0f" / "test"])
    case = shutil.copytree(diagnosed / "out" / "case_0f", tmp_path / "case")
    document = read_json(case / "diagnosis.json")
    whole = replayed(case, tests)
    del document["robot"]
    write_json(case / "diagnosis.json", document)
    assert replayed(case, tests) == whole
    write_json(case / "diagnosis.json", document | {"nominal": {"kp/servo": "stiff"}})
    assert replayed(case, tests) is None
    write_json(case / "diagnosis.json", document)
    shutil.rmtree(case / "corrected")
    shutil.copytree(RobotDescription.load("darwin_leg").model_path.parent, case / "corrected")
    with pytest.raises(InputError, match="corrected: has other joints than robot 'servo_bench'"):
        replayed(case, tests)


def test_what_is_no_proof_is_warned_of(diagnosed: Path, tmp_path: Path) -> None:
    """An edited verdict, another commit than that committed to, and files changed meanwhile."""
    copy = shutil.copytree(diagnosed, tmp_path / "copy")

    def warned() -> list[str]:
        options = ("--set", copy / "set", "--key", copy / "key.json")
        where = ("--diagnoses", copy / "out", "--out", tmp_path / "scores.json")
        done = pup("blind", "score", *options, *where, "--json")
        assert done.code == 0, done.err
        page = (tmp_path / "scores.md").read_text()
        assert all(f"Warning: {doubt}" in page for doubt in done.json()["doubts"])
        return done.json()["doubts"]

    told = journal(copy)
    assert sorted(told["diagnoses"]) == ["case_0f", "case_1n"]
    told["sessions"][0]["source_changed"] = False
    write_json(copy / "out" / "run.json", told)
    assert warned() == []
    verdict = read_json(copy / "out" / "case_1n" / "diagnosis.json")
    write_json(copy / "out" / "case_1n" / "diagnosis.json", verdict | {"verdict": "undetermined"})
    assert len(warned()) == 1 and "case_1n" in warned()[0]
    commitment = read_json(copy / "set" / "commitment.json")
    write_json(copy / "set" / "commitment.json", commitment | {"engine_git_sha": "f" * 40})
    told["engine"]["git_sha"] = "e" * 40
    told["sessions"][0]["source_changed"] = True
    write_json(copy / "out" / "run.json", told)
    assert len(warned()) == 3
    assert f"engine {'f' * 40}; diagnosed by" in warned()[0]
    del told["diagnoses"], told["sessions"][0]["source_changed"]  # as of an earlier run
    write_json(copy / "out" / "run.json", told)
    assert len(warned()) == 1


def test_the_first_cases_can_be_scored_alone(diagnosed: Path, tmp_path: Path) -> None:
    """As where a run was stopped after `--limit`: the others are not missing."""
    options = ("--set", diagnosed / "set", "--key", diagnosed / "key.json", "--limit", 1)
    where = ("--diagnoses", diagnosed / "out", "--out", tmp_path / "scores.json")
    done = pup("blind", "score", *options, *where, "--json")
    assert done.code == 0, done.err
    assert "# Blind score: 1 cases" in (tmp_path / "scores.md").read_text()
    assert done.json()["all"]["class_top1"]["hits"] == 1


def test_a_finished_run_is_left_as_it_is(diagnosed: Path) -> None:
    before = files(diagnosed / "out")
    done = run(diagnosed)
    assert (done.code, done.err) == (0, "")
    assert files(diagnosed / "out") == before


# --- Cases that are quickly done ------------------------------------------------------------------


@pytest.fixture(scope="module")
def three(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set of three cases too poor to tell anything; leave it as it is."""
    folder = tmp_path_factory.mktemp("three")
    seal(folder, {name: poor(seed) for seed, name in enumerate(("a", "b", "c"))})
    return folder


@pytest.fixture
def quick(tmp_path: Path, three: Path) -> Path:
    """A copy of it."""
    return shutil.copytree(three, tmp_path / "quick")


def test_the_first_cases_can_be_taken_alone(quick: Path) -> None:
    assert run(quick, "--limit", 2).code == 0
    assert list(told(quick / "out")) == ["case_a", "case_b"]
    first = files(quick / "out" / "case_a")
    assert run(quick).code == 0
    assert list(told(quick / "out")) == ["case_a", "case_b", "case_c"]
    assert files(quick / "out" / "case_a") == first
    assert len(journal(quick)["sessions"]) == 2


def test_a_case_that_fails_stops_no_other(quick: Path) -> None:
    (whole,) = (quick / "set" / "case_a" / "recordings").glob("step*.parquet")
    good = whole.read_bytes()
    whole.write_bytes(good[:-1])
    sealed(quick, {"a": {}, "b": {}, "c": {}})
    done = run(quick)
    assert done.code == 2
    *_, line = done.err.splitlines()
    assert "1 of 3 cases failed" in line and "case_a (InputError: " in line
    assert list(told(quick / "out")) == ["case_b", "case_c"]
    error = read_json(quick / "out" / "case_a" / "error.json")
    assert "not a readable Parquet file" in error["error"]
    assert error["details"][0].startswith("Traceback")
    assert list(journal(quick)["sessions"][0]["failed"]) == ["case_a"]
    # Tried again, and only this one.
    assert "failed" in run(quick).err.splitlines()[1]
    assert list(told(quick / "out")) == ["case_b", "case_c"]


def test_an_error_is_forgotten_when_its_case_is_done(quick: Path) -> None:
    write_json(quick / "out" / "case_a" / "error.json", {"schema": 1})
    found, _ = orders(quick / "set", quick / "out", 1)
    assert not diagnose_case(found[0]).error
    assert not (quick / "out" / "case_a" / "error.json").exists()
    assert found[0].done


def test_a_case_whose_process_is_lost_is_recorded(quick: Path) -> None:
    out = quick / "out"
    out.mkdir()
    found, commitment = orders(quick / "set", out, None)

    class Lost(OneByOne):
        def settled(self) -> tuple[Any, Any]:
            return self.waiting.popleft(), RuntimeError("The worker died.\nIt left nothing.")

    with pytest.raises(FailedError, match=r"3 of 3 cases failed.*case_a \(RuntimeError: The"):
        run_cases(found, Journal(out, commitment), Lost, 1, lambda *_: None)
    error = read_json(out / "case_b" / "error.json")
    assert error["details"] == ["The worker died.", "It left nothing."]


def test_the_longest_case_is_the_first(tmp_path: Path) -> None:
    seal(tmp_path, {"a": poor(1), "b": recordings({}, 2), "c": poor(3)})
    (tmp_path / "out").mkdir()
    found, commitment = orders(tmp_path / "set", tmp_path / "out", None)
    begun: list[Order] = []

    class Watched(OneByOne):
        def settled(self) -> tuple[Any, Any]:
            begun.append(self.waiting.popleft())
            write_json(begun[-1].out / "diagnosis.json", {})
            return begun[-1], blind_run.Outcome("consistent", 1.0)

    run_cases(found, Journal(tmp_path / "out", commitment), Watched, 1, lambda *_: None)
    assert begun[0].name == "case_b"


@pytest.mark.ray
def test_a_job_that_kills_its_worker_is_given_up() -> None:
    def job(item: int) -> int:
        if item == 1:
            os._exit(1)
        if item == 2:
            raise ValueError("no")
        return 10 * item

    with connected(cores=2), closing(RayPool(job)) as pool:
        for item in range(4):
            pool.begin(item)
        outcomes = dict(pool.settled() for _ in range(4))
        with pytest.raises(LookupError):
            pool.settled()
    assert (outcomes[0], outcomes[3]) == (0, 30)
    assert isinstance(outcomes[1], Exception) and isinstance(outcomes[2], Exception)


@pytest.mark.ray
def test_killed_and_started_again_it_goes_on(quick: Path) -> None:
    assert run(quick, out="whole").code == 0
    job = Job(*command(quick), "--cores", 2, out=quick / "out")
    job.come_to("case_*/checkpoints/*.f32")
    job.process.kill()
    assert job.end()[0] in (-signal.SIGKILL, 0)
    job.assert_nothing_left()
    job = Job(*command(quick), "--cores", 2, out=quick / "out")
    job.come_to("ray")
    job.process.terminate()
    code, out, err = job.end()
    assert (code, out) == (130, "") and err.endswith("stopped; the same command resumes\n")
    job.assert_nothing_left()
    last = Job(*command(quick), "--cores", 2, out=quick / "out")
    code, out, err = last.end()
    assert code == 0, err
    assert json.loads(out)["cases"] == 3
    assert told(quick / "out") == told(quick / "whole")
    sessions = journal(quick)["sessions"]
    assert sessions[0]["ended"] is None and sessions[-1]["ended"] is not None
    assert not list((quick / "out").glob("case_*/error.json"))


@pytest.mark.slow
@pytest.mark.ray
@pytest.mark.timeout(3600)
def test_made_diagnosed_and_scored(tmp_path: Path) -> None:
    """A set of the generator's, from the first command to the last."""
    counts = ("--robot", "servo_bench=2", "--nulls", "servo_bench=1", "--seed", "once and for all")
    made = pup_process(
        *("blind", "make", *counts, "--out", tmp_path / "set", "--key", tmp_path / "key.json"),
        *("--cores", 2),
    )
    assert made.code == 0, made.err
    job = Job(*command(tmp_path), "--cores", 2, out=tmp_path / "out")
    code, _, err = job.end(patience=3600)
    assert code == 0, err
    options = ("--set", tmp_path / "set", "--key", tmp_path / "key.json")
    where = ("--diagnoses", tmp_path / "out", "--out", tmp_path / "scores.json")
    done = pup_process("blind", "score", *options, *where, "--json")
    assert done.code == 0, done.err
    scores = done.json()
    assert (scores["cases"], scores["missing"]) == (3, 0)
    assert scores["all"]["seconds"]["of"] + scores["nulls"]["seconds"]["of"] >= 2
