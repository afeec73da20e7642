"""`pup run` to its end: real gateway, agent and virtual robot; killed, stopped and gone on with."""

import json
import os
import signal
from pathlib import Path
from typing import Any

import agents
import psutil
import pytest
from commandline import files, pup
from jobs import Job, command_of, until

from pup.files import sha256
from pup.robot import RobotDescription
from pup.sysid.result import read_bounds
from pup.sysid.virtual import record
from services.pipeline import POLICIES
from tests.reports import Page

pytest.importorskip("fastapi")
pytest.importorskip("botorch")

DARWIN = RobotDescription.load("darwin_op2")
TINY = (
    *("--local", "--cores", 1, "--population", 4, "--generations", 1, "--subsets", 2),
    *("--subset-generations", 1, "--fixed-network", "--no-comparison"),
)
FEW = (*TINY, "--trials", 2, "--repeats", 1, "--effects", 0)
PATIENCE = 300.0


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Darwin OP2 with a policy that moves by what it sees and by eta, and stands for a while."""
    gait = agents.standing()
    folder = agents.described(tmp_path_factory.mktemp("robot") / "darwin_op2", gait)
    names = read_bounds(DARWIN.identified_path, DARWIN).names
    agents.bundle(folder / POLICIES / "forward", gait, names, lively=True)
    return folder


@pytest.fixture(scope="module")
def command(robot: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[object, ...]:
    """`pup run` on two short recordings of it."""
    folder = tmp_path_factory.mktemp("recordings")
    record(DARWIN, ("step:0.1", "step:0.3"), folder, seed=3)
    return ("run", "--robot", robot, "--recordings", folder, "--seed", 1)


class Run(Job):
    """A running `pup run`, and the laboratories that it had."""

    def __init__(self, *command: object, out: Path) -> None:
        super().__init__(*command, out=out)
        self.labs: set[str] = set()

    def come_to_walk(self, number: int) -> None:
        """Wait until so many walks have begun and the last of them has not ended."""
        walking = [number, number - 1]
        until(lambda: self.process.poll() is not None or self._walks() == walking, PATIENCE)
        assert self.process.poll() is None, self.process.communicate()
        for child in psutil.Process(self.pid).children():
            if "workers.reaper" in command_of(child):
                self.labs.add(command_of(child)[-2])
        assert self.labs

    def _walks(self) -> list[int]:
        events = [entry["event"] for entry in journal(self.out)]
        return [events.count("running"), events.count("finished")]

    def left(self) -> list[str]:
        found = [lab for lab in self.labs if Path(lab).exists()]
        for process in psutil.process_iter():
            try:
                session = process.environ().get("PUP_SESSION")
            except psutil.Error:
                continue
            if session in self.labs:
                found.append(" ".join(command_of(process))[:100])
        return found


def journal(out: Path) -> list[dict[str, Any]]:
    """Entries of the agent's journal; the last line may be only half there."""
    file = out / "transfer" / "agent" / "journal"
    whole = file.read_text().rpartition("\n")[0] if file.exists() else ""
    return [json.loads(line.split(" ", 1)[1]) for line in whole.splitlines()]


def transferred(out: Path) -> dict[str, Any]:
    """What a study found, but for which attempts it took."""
    told = json.loads((out / "transfer" / "transfer.json").read_text())
    for walk in told["walks"]:
        for name in ("attempt", "recording", "digest"):
            del walk[name]
    return told


def test_killed_in_a_walk_it_leaves_nothing_and_repeats_no_other(
    command: tuple[object, ...], tmp_path: Path
) -> None:
    """The walk that was cut off is attempted again under its number; all are told of rightly."""
    options = (*command, *FEW, "--train-steps", 0)
    first = Run(*options, out=tmp_path)
    first.come_to_walk(2)
    keys = tmp_path / "transfer" / "keys"
    secret = [f for f in keys.rglob("*") if f.name == "tokens.json" or "secret" in f.name]
    assert len(secret) == 3
    assert not any(f.stat().st_mode & 0o077 for f in (keys, *secret))
    first.process.kill()
    assert first.end()[0] == -signal.SIGKILL
    first.assert_nothing_left()
    code, printed, err = Job(*options, out=tmp_path).end()
    assert code == 0, err
    told = json.loads((tmp_path / "transfer" / "transfer.json").read_text())
    assert [w["attempt"] for w in told["walks"]] == [1, 2, 1, 1]
    assert [w["purpose"] for w in told["walks"]] == ["initial", "initial", "repeat", "compare"]
    assert len({w["distance"] for w in told["walks"]}) == 4  # each has noise of its own
    runs = [(e["trial"], e["attempt"]) for e in journal(tmp_path) if e["event"] == "running"]
    assert len(runs) == len(set(runs)) == 5
    recordings = tmp_path / "transfer" / "agent" / "recordings"
    for walk in told["walks"]:
        assert sha256(recordings / f"{walk['recording']}.parquet") == walk["digest"]
    assert not keys.exists()
    check_result(json.loads(printed), tmp_path)


def check_result(told: dict[str, Any], out: Path) -> None:
    """What is printed, the journal and the report tell the same."""
    assert told["transfer"] == json.loads((out / "transfer" / "transfer.json").read_text())
    assert told["left_out"] == {"train": "as told", "diagnosis": "as told"}
    assert told["took"].keys() == {"presysid", "replay", "transfer", "rehearsal"}
    rehearsed = json.loads((out / "rehearsal" / "rehearsal.json").read_text())
    assert rehearsed["control_rate"] == pytest.approx(1 / 0.031)  # as the laboratory walks
    page = Page(out / "report.html")
    assert not {"script", "link", "iframe"} & {name for name, _ in page.elements}
    sources = [attributes["src"] for name, attributes in page.elements if name == "img"]
    assert sources and all(source.startswith("data:image/") for source in sources)
    stages = json.loads((out / "run.json").read_text())["stages"]
    for stage in ("presysid", "replay", "transfer", "rehearsal"):
        for name, digest in stages[stage]["files"].items():
            assert sha256(out / name) == digest
            assert digest in page.text and name in page.text
        assert all(value in page.text for value in stages[stage]["inputs"].values())


@pytest.mark.slow
def test_stopped_it_leaves_nothing_and_what_dies_meanwhile_is_started_again(
    command: tuple[object, ...], tmp_path: Path
) -> None:
    """SIGTERM; before, agent, robot and gateway are killed, once each."""
    options = (*command, *FEW, "--train-steps", 0)
    run = Run(*options, out=tmp_path)
    run.come_to_walk(1)
    for name in ("hardware_agent.cli", "virtual-robot", "serve"):
        until(lambda name=name: _of(run, name), PATIENCE)
        os.kill(_of(run, name)[0], signal.SIGKILL)
    until(lambda: run._walks()[1] > 1 or run.process.poll() is not None, PATIENCE)
    run.process.terminate()
    code, _, err = run.end()
    assert (code, err.splitlines()[-1]) == (130, "pup run: stopped; the same command resumes")
    run.assert_nothing_left()
    assert Job(*options, out=tmp_path).end()[0] == 0
    assert len(transferred(tmp_path)["walks"]) == 4


def _of(run: Run, name: str) -> list[int]:
    children = psutil.Process(run.pid).children()
    return [child.pid for child in children if name in command_of(child)]


@pytest.mark.slow
@pytest.mark.ray
@pytest.mark.timeout(3600)
def test_killed_at_every_stage_it_ends_as_if_nothing_had_happened(
    command: tuple[object, ...], tmp_path: Path
) -> None:
    """Bounds, weights, the walk in simulation and the trials are those of an undisturbed run."""
    pytest.importorskip("torch")
    pytest.importorskip("gymnasium")
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    options = (*command, *FEW, "--train-steps", 20_000)
    assert Job(*options, out=whole).end()[0] == 0

    def killed_at(moment: str) -> None:
        job = Job(*options, out=parts)
        job.come_to(moment)
        job.process.kill()
        assert job.end()[0] == -signal.SIGKILL
        job.assert_nothing_left()

    for moment in ("presysid/checkpoints/*.npz", "ray", "train/checkpoint.npz"):
        killed_at(moment)
    walking = Run(*options, out=parts)
    walking.come_to_walk(2)
    walking.process.kill()
    walking.end()
    walking.assert_nothing_left()
    killed_at("walk/gait.png")  # drawn beside the trials, whichever is sooner
    code, printed, err = Job(*options, out=parts).end()
    assert code == 0, err
    bounds = [json.loads((out / "presysid/bounds.json").read_text()) for out in (whole, parts)]
    assert bounds[0]["parameters"] == bounds[1]["parameters"]
    weights = [sha256(out / "train/policy/weights.npz") for out in (whole, parts)]
    assert weights[0] == weights[1]
    walks = [json.loads((out / "walk/replay.json").read_text()) for out in (whole, parts)]
    assert walks[0]["distance"] == walks[1]["distance"]
    found = [transferred(out) for out in (whole, parts)]
    for told in found:
        del told["policy_sha256"]  # it tells when it was written
    assert found[0] == found[1]
    before = files(parts)
    again = pup(*options, "--out", parts, "--json")
    assert (again.code, again.err) == (0, "")
    assert again.json() == json.loads(printed) and files(parts) == before
