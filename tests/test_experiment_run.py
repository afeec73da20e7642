"""Cells are done once, go on where they were, and two runs agree; and what is made of them."""

import json
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import agents
import experiments
import numpy as np
import pytest
from commandline import pup
from reports import Page
from workshops import Workshop, do, opened, told

from pup.errors import InputError
from pup.files import write_json
from pup.policy.bundle import NumpyPolicy
from pup.policy.shape import Method
from pup.robot import RobotDescription
from services import places, provenance
from services.experiment import work
from services.experiment.cells import Cell, graph
from services.experiment.gather import gather
from services.experiment.plan import Plan, small
from services.experiment.report import estimated, write_report
from services.experiment.run import CELLS, FILES, failure, run_again, run_cells
from services.experiment.walking import conditioned

ROBOT = RobotDescription.load("darwin_op2")


@pytest.fixture
def workshop(monkeypatch: pytest.MonkeyPatch) -> Workshop:
    return opened(monkeypatch)


def test_cells_are_done_once_and_again_when_something_changed(
    workshop: Workshop, tmp_path: Path
) -> None:
    cells = graph(small())
    assert do(cells, tmp_path) == {}
    assert sorted(workshop.done) == sorted(cells)
    place = {name: workshop.done.index(name) for name in cells}
    assert all(place[n] < place[c.name] for c in cells.values() for n in c.needs.values())
    assert do(cells, tmp_path) == {} and len(workshop.done) == len(cells)
    plan = replace(small(), trials=replace(small().trials, landscape=8))
    workshop.done.clear()
    assert do(graph(plan), tmp_path, redo=True) == {}
    assert set(workshop.done) == {"landscape-forward-pup", "landscape-forward-up"}
    # What came of it is what it was, so that nothing that needs it is done again.
    (tmp_path / CELLS / "presysid-r1000" / FILES / "bounds.json").write_text("[]")
    workshop.done.clear()
    assert do(graph(plan), tmp_path) == {}
    assert workshop.done == ["presysid-r1000"]
    (tmp_path / CELLS / "presysid-fleet-diagnosed" / FILES / "corrected" / "robot.toml").unlink()
    workshop.done.clear()
    assert do(graph(plan), tmp_path) == {}
    assert workshop.done == ["presysid-fleet-diagnosed"]


def test_no_cell_waits_for_one_that_it_does_not_need(workshop: Workshop, tmp_path: Path) -> None:
    cells, slow = graph(small()), "presysid-r1001"

    class SlowPool(places.OneByOne):
        def settled(self) -> tuple[Any, Any]:
            while self.waiting[0].cell.name == slow and len(self.waiting) > 1:
                self.waiting.rotate(-1)
            return super().settled()

    assert run_cells(cells, tmp_path, SlowPool, told) == {}
    behind = {slow}
    for cell in cells.values():
        if behind.intersection(cell.needs.values()):
            behind.add(cell.name)
    assert {"trials-r1000-forward-pup", "trials-r1000-forward-corrected"}.isdisjoint(behind)
    after = workshop.done[workshop.done.index(slow) :]
    assert set(after) == behind


def test_the_longest_way_is_begun_first(workshop: Workshop, tmp_path: Path) -> None:
    cells = graph(small())
    begun: list[str] = []

    class Watched(places.OneByOne):
        def begin(self, item: Any) -> None:
            begun.append(item.cell.name)
            super().begin(item)

    run_cells(cells, tmp_path, Watched, told)

    def way(name: str) -> float:
        behind = [c.name for c in cells.values() if name in c.needs.values()]
        return cells[name].weight + max(map(way, behind), default=0.0)

    due = [n for n in begun if set(cells[n].needs.values()) == {"record-r1000"}]
    assert len(due) > 1
    assert [way(n) for n in due] == sorted(map(way, due), reverse=True)
    assert due != [n for n in cells if n in due], "not in the order in which they stand"


def test_what_needs_another_result_is_done_again(workshop: Workshop, tmp_path: Path) -> None:
    cells = graph(small())
    do(cells, tmp_path)
    workshop.done.clear()
    workshop.chance = 1.0
    (tmp_path / CELLS / "presysid-r1000" / FILES / "result.json").unlink()
    do(cells, tmp_path, redo=True)
    behind = {n for n, c in cells.items() if "presysid-r1000" in c.needs.values()}
    assert {"presysid-r1000", *behind} <= set(workshop.done)
    assert not any("r1001" in name for name in workshop.done)


def test_stopped_at_any_cell_it_goes_on_there(workshop: Workshop, tmp_path: Path) -> None:
    cells = graph(small())
    for name in ("record-r1001", "policy-forward-up", "trials-r1000-forward-corrected"):
        workshop.stops = {name}
        with pytest.raises(KeyboardInterrupt):
            do(cells, tmp_path)
        assert name not in workshop.done
        assert (tmp_path / CELLS / name / FILES / "half").exists()
    workshop.stops = set()
    assert do(cells, tmp_path) == {}
    assert sorted(workshop.done) == sorted(cells)  # each once


def test_what_fails_is_told_and_tried_again_and_all_else_is_done(
    workshop: Workshop, tmp_path: Path
) -> None:
    cells = graph(small())
    workshop.fails = {"diagnosis-r1001"}
    failed = do(cells, tmp_path)
    behind = {n for n in cells if "r1001" in n and "corrected" in n}
    behind |= {n for n in cells if n.endswith("-diagnosed")}  # of all robots
    assert set(failed) == {"diagnosis-r1001"} | behind
    assert failed["diagnosis-r1001"].error == "InputError: it cannot be done"
    assert failed["presysid-r1001-corrected"].error == "needs diagnosis-r1001"
    error = json.loads((tmp_path / CELLS / "diagnosis-r1001" / "error.json").read_text())
    assert "Traceback" in error["details"][0]
    workshop.fails = set()
    assert do(cells, tmp_path) == {}
    assert not (tmp_path / CELLS / "diagnosis-r1001" / "error.json").exists()
    assert sorted(workshop.done) == sorted(cells)


def test_only_where_all_that_failed_was_bad_input_it_is_told_as_such(
    workshop: Workshop, tmp_path: Path
) -> None:
    """A job whose exit code says so is not tried again; one whose node was lost has to be."""
    options = ("experiment", "--small", "--stages", "record", "--local", "--out", tmp_path)
    workshop.fails = {"record-r1000", "record-r1001"}
    refused = pup(*options)
    assert refused.code == 2 and "2 cells failed" in refused.err
    workshop.fails, workshop.breaks = {"record-r1001"}, {"record-r1000"}
    broken = pup(*options)
    assert broken.code == 1 and "2 cells failed" in broken.err
    assert broken.err.splitlines()[-1].startswith("pup experiment: ")
    again = pup(*options, "--cell", "record-r1000")
    assert again.code == 1 and "Traceback" not in again.err


def test_a_cell_whose_process_was_lost_is_no_bad_input(workshop: Workshop, tmp_path: Path) -> None:
    class Lost(places.OneByOne):
        def settled(self) -> tuple[Any, Any]:
            return self.waiting.popleft(), RuntimeError("the node died")

    cells = graph(small())
    failed = run_cells(cells, tmp_path, Lost, told)
    assert failed["record-r1000"].error == "RuntimeError: the node died"
    assert isinstance(failure(failed, tmp_path), ChildProcessError)


def test_a_cell_is_done_again_beside_what_it_left(workshop: Workshop, tmp_path: Path) -> None:
    cells, name = graph(small()), "trials-r1000-forward-robust"

    def again() -> dict[str, Any]:
        return run_again(cells, name, tmp_path, places.OneByOne, told)

    first = again()  # as on a fresh clone: what it needs is done too, and nothing else
    assert first["agree"] and set(workshop.done) == set(needed(cells, name))
    assert len(workshop.done) == len(set(workshop.done)) + 1
    workshop.chance = 0.5
    second = again()
    assert not second["agree"] and workshop.done[-1] == name
    assert len({*second["results"].values()}) == 2
    assert do(cells, tmp_path) == {}
    with pytest.raises(InputError, match="there is none"):
        run_again(cells, "walk", tmp_path, places.OneByOne, told)


def test_all_recordings_of_a_real_robot_are_identified(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    class Found:
        def document(self) -> dict[str, Any]:
            names = ("parameters", "actuator", "loss", "histories", "splits")
            return dict.fromkeys(names, 1)

    given: list[int] = []

    def identify(robot: RobotDescription, recordings: Any, *_: Any) -> Found:
        given.append(len(recordings))
        return Found()

    monkeypatch.setattr("services.presysid.identify", identify)
    real = ROBOT.folder / "recordings"
    cell = graph(small(), real=real)["presysid-real"]
    assert work.KINDS["presysid"](work.Task(cell, tmp_path, {}))["loss"] == 1
    assert given == [len([*real.glob("*.parquet")])]


def needed(cells: dict[str, Cell], name: str) -> Iterator[str]:
    yield name
    for other in cells[name].needs.values():
        yield from needed(cells, other)


@contextmanager
def made_up(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    def find(task: work.Task) -> dict[str, Any]:
        for left in work.LEFT.get(task.cell.kind, ()):
            write_json(task.out / left, {})
        return experiments.result(task.cell)

    with monkeypatch.context() as patched:
        patched.setattr("services.experiment.run.KINDS", dict.fromkeys(work.KINDS, find))
        yield


def test_the_document_and_the_report_tell_what_was_found(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    plan, real = Plan(), tmp_path / "real"
    real.mkdir()
    (real / "a.parquet").write_bytes(b"")
    cells = graph(plan, real=real)
    with made_up(monkeypatch):
        assert do(cells, tmp_path) == {}
    document = gather(plan, cells, {"policy-sideways-up": "needs <b>presysid</b>"}, tmp_path)
    write_json(tmp_path / "experiment.json", document)
    forward = document["directions"]["forward"]
    assert len(forward["walks"]["pup"]) == 10 and len(forward["walks"]["pup+fitted"]) == 10
    assert len(document["directions"]["sideways"]["walks"]["robust"]) == 4
    walks = forward["walks"]
    means = {a: np.mean([np.mean(w["distance"]) for w in walks[a].values()]) for a in walks}
    arms = forward["statistics"]["arms"]
    assert arms["pup"]["distance"]["value"] == pytest.approx(means["pup"])
    assert arms["pup"]["distance"]["walks"] == 50
    ratios = forward["statistics"]["ratios"]
    assert ratios["pup / robust"]["value"] == pytest.approx(means["pup"] / means["robust"])
    assert ratios["pup / robust"]["ci90"][0] < 1.2 / 0.7 < ratios["pup / robust"]["ci90"][1]
    assert forward["statistics"]["above"]["robust and nominal"]["value"] >= 0.8
    assert forward["statistics"]["above"]["robust and nominal+diagnosed"]["robots"] == 10
    assert ratios["diagnosed / fleet"]["value"] == pytest.approx(experiments.FURTHER, rel=0.15)
    lines = {line["line"]: line for line in document["acceptance"]}
    assert lines["forward: PUP by Nominal"]["holds"]
    assert lines["forward, diagnosed fleet: PUP by Nominal"]["holds"]
    assert lines["error held out is lower by (median)"]["value"] == pytest.approx(0.55)
    assert all(line["planned"] == line["robots"] for line in lines.values())
    # What is trained on with a diagnosis has a control that is trained on as long without.
    assert ratios["corrected / fleet"]["controlled"] and ratios["diagnosed / fleet"]["controlled"]
    assert "controlled" not in ratios["pup / up"]
    added = ratios["diagnosed / undiagnosed, no trials"]
    assert added["value"] == pytest.approx(experiments.FURTHER, rel=0.15) and added["robots"] == 10
    assert not [name for name in lines if "sideways: PUP by Nominal" in name]
    named = document["diagnosis"]["robots"]
    share = np.mean(["ground_compliance" in one["classes"] for one in named.values()])
    assert document["diagnosis"]["named"]["contact"]["value"] == share
    write_report(document, tmp_path / "report.html")
    page = Page(tmp_path / "report.html")
    assert not {"b", "script", "link"} & {name for name, _ in page.elements}
    assert "needs <b>presysid</b>" in page.text and "stopped by overload: <b>" in page.text
    images = [attributes["src"] for name, attributes in page.elements if name == "img"]
    assert len(images) == 27 and all(i.startswith("data:image/svg+xml") for i in images)
    assert estimated(ratios["pup / robust"]) in page.text


def test_an_infeasible_trial_keeps_its_number(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Or what comes after it would have needed a trial less. What gave no result has none."""
    cells = graph(small())
    name = "trials-r1000-forward-pup"
    with made_up(monkeypatch):
        assert do(cells, tmp_path) == {}
    file = tmp_path / CELLS / name / FILES / "result.json"
    document = json.loads(file.read_text())
    first, *others = document["result"]["walks"]
    nowhere = first | {"state": "infeasible", "distance": None}
    lost = first | {"state": "lost", "distance": None}
    document["result"]["walks"] = [nowhere, lost, first | {"distance": 9.0}, *others]
    write_json(file, document)
    document = gather(small(), cells, {}, tmp_path)
    write_json(tmp_path / "experiment.json", document)
    part = document["directions"]["forward"]
    far = [w["distance"] for w in others]
    assert part["searches"]["pup"]["r1000"] == [None, 9.0, *far]
    assert part["statistics"]["needed"]["pup"]["robots"]["r1000"] == 2
    with np.errstate(all="raise"):  # of infinities in figures
        write_report(document, tmp_path / "report.html")


def test_an_experiment_that_is_only_begun_is_reported_too(tmp_path: Path) -> None:
    cells = graph(small())
    failed = dict.fromkeys(cells, "needs record-r1000")
    document = gather(small(), cells, failed, tmp_path)
    write_json(tmp_path / "experiment.json", document)
    assert {line["answer"] for line in document["acceptance"]} == {"incomplete"}
    assert {line["planned"] for line in document["acceptance"]} == {2}
    assert document["bounds"] is None
    write_report(document, tmp_path / "report.html")
    assert "needs record-r1000" in Page(tmp_path / "report.html").text


def test_a_policy_without_eta_acts_the_same_whatever_a_study_tells_it(tmp_path: Path) -> None:
    robust = agents.bundle(tmp_path / "robust", lively=True, method=Method.ROBUST)
    walked = conditioned(robust, tmp_path / "walked", ROBOT)
    before, after = NumpyPolicy.load(robust, ROBOT), NumpyPolicy.load(walked, ROBOT)
    assert after.card.shape.eta == len(after.card.eta_lower) == 1
    rng = np.random.default_rng(0)
    seen = rng.normal(size=(50, before.card.shape.proprioception))
    for eta in (-1.0, 0.0, 0.7):
        assert np.array_equal(before.act(seen, np.zeros(0)), after.act(seen, np.array([eta])))
    pup_ = agents.bundle(tmp_path / "pup")
    assert conditioned(pup_, tmp_path / "nowhere", ROBOT) == pup_


def test_all_that_decides_counts_as_source_of_an_experiment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a diagnosis the package alone does."""
    for package in ("pup", "services"):
        (tmp_path / package).mkdir()
        (tmp_path / package / "__init__.py").touch()
    commit = ("-c", "user.name=a", "-c", "user.email=a@b", "commit", "--quiet", "--message", "a")
    for words in (("init", "--quiet"), ("add", "."), commit):
        subprocess.run(["git", *words], cwd=tmp_path, check=True)
    monkeypatch.setattr(provenance, "PACKAGE", tmp_path / "pup")
    alone, whole = provenance.engine(), provenance.engine(provenance.ALSO)
    assert alone["git_sha"] and not alone["dirty"] and not whole["dirty"]
    (tmp_path / "services" / "walk.py").touch()
    assert provenance.engine() == alone
    changed = provenance.engine(provenance.ALSO)
    assert changed["dirty"] and changed["source_sha256"] != whole["source_sha256"]


REFUSED = {
    ("--robot", "servo_bench"): "needs a gait and servo ids",
    ("--plan", "absent.toml"): "absent.toml: cannot be read",
    ("--methods", "pup,best"): "'best' is unknown",
    ("--stages", "walk"): "stage 'walk' is unknown",
    ("--seeds", "1-x"): "is not A-B,...",
    ("--seeds", "1,1"): "does not name robots, each once",
    ("--cell", "../x"): "is no cell",
    ("--real", "."): "no *.parquet",
    ("--real", "nowhere"): "--real nowhere: is no folder",
    ("--stages", ","): "argument --stages: ',' names nothing; leave the option out for all",
    ("--methods", ""): "argument --methods: '' names nothing; leave the option out for all",
    (
        "--plan",
        "backward.toml",
        "--methods",
        "up",
    ): "--methods: none of these is the plan's, pup, robust",
    ("--small", "--plan", "x"): "not allowed with argument",
}


@pytest.mark.parametrize("options", REFUSED)
def test_mistakes_are_told_in_a_line(
    options: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    walked = "direction = 'backward'\nmethods = ['pup', 'robust']\n"
    Path("backward.toml").write_text(f"schema = 1\n[[walk]]\n{walked}")
    done = pup("experiment", "--out", tmp_path / "out", "--local", *options)
    assert done.code == 2 and REFUSED[options] in done.err, done.err
    assert "Traceback" not in done.err and not (tmp_path / "out").exists()


def test_where_there_is_nothing_to_do_it_says_so(tmp_path: Path) -> None:
    """One robot shares nothing with others."""
    asked = ("experiment", "--small", "--seeds", "1000", "--stages", "diagnosed", "--local")
    refused = pup(*asked, "--out", tmp_path / "out")
    assert refused.code == 2
    assert refused.err.strip().startswith("pup experiment: nothing to do in diagnosed: a diagnosed")
    assert not (tmp_path / "out").exists()
