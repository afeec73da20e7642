"""What an experiment has found is not deleted for a mistake, nor by two processes at once."""

import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import agents
import pytest
from commandline import pup
from jobs import holder
from workshops import Workshop, do, opened, told

from pup.errors import InputError
from services import places
from services.experiment.cells import graph
from services.experiment.inputs import different
from services.experiment.plan import Plan, small
from services.experiment.run import CELLS, FILES, run_again
from services.held import LOCK

STAGES = ("--stages", "policy", "--local", "--json")


@pytest.fixture
def workshop(monkeypatch: pytest.MonkeyPatch) -> Workshop:
    """One whose play nobody reports of."""
    monkeypatch.setattr("services.experiment.gather.gather", lambda *_: {})
    monkeypatch.setattr("services.experiment.report.write_report", lambda *_: None)
    return opened(monkeypatch)


def written(out: Path) -> dict[Path, int]:
    """When all that is in cells was written."""
    return {f: f.stat().st_mtime_ns for f in (out / CELLS).rglob("*") if f.is_file()}


def longer(plan: Plan) -> Plan:
    return replace(plan, trials=replace(plan.trials, trials=4))


def test_a_forgotten_option_deletes_nothing_until_it_is_asked_to(
    workshop: Workshop, tmp_path: Path
) -> None:
    ready, out = tmp_path / "ready", tmp_path / "out"
    agents.bundle(ready / "forward" / "pup")
    small_ = ("experiment", "--small", *STAGES, "--out", out)
    assert pup(*small_, "--policies", ready).code == 0
    before = written(out)
    workshop.done.clear()
    for more in ((), ("--cell", "policy-forward-pup")):
        refused = pup(*small_, *more)
        assert refused.code == 2 and len(refused.err.splitlines()) == 1, refused.err
        assert "policy-forward-pup (another" in refused.err and "ready" in refused.err
        assert "policy-forward-up" not in refused.err and "--redo" in refused.err
        assert written(out) == before and not workshop.done
    assert pup(*small_, "--policies", ready, "--cell", "policy-forward-pup").code == 0
    assert written(out) == before and workshop.done == ["policy-forward-pup"]
    workshop.done.clear()
    assert pup(*small_, "--redo").code == 0
    assert workshop.done == ["policy-forward-pup"]
    assert pup(*small_).code == 0 and len(workshop.done) == 1


def test_a_changed_plan_is_refused_by_the_settings_that_are_other(
    workshop: Workshop, tmp_path: Path
) -> None:
    plan, file, out = "schema = 1\nseeds = [1]\n", tmp_path / "plan.toml", tmp_path / "out"
    asked = ("experiment", "--plan", file, "--stages", "presysid", "--local", "--json")
    asked = (*asked, "--out", out)
    file.write_text(plan)
    assert pup(*asked).code == 0
    before = written(out)
    file.write_text(plan + "[presysid]\ngenerations = 50\n")
    refused = pup(*asked)
    assert refused.code == 2 and "presysid-r1 (another fits.generations)" in refused.err
    assert f"{out}: 1 finished cells" in refused.err and written(out) == before
    file.write_text(plan)
    assert pup(*asked).code == 0 and written(out) == before


DAMAGED = ("", "{", "[]", '{"schema": 1, "stages": []}')


@pytest.mark.parametrize("text", DAMAGED)
def test_a_damaged_journal_is_told_with_what_its_cell_takes(
    workshop: Workshop, tmp_path: Path, text: str
) -> None:
    asked = ("experiment", "--small", *STAGES, "--out", tmp_path)
    assert pup(*asked).code == 0
    name = "policy-forward-up"
    folder = tmp_path / CELLS / name
    (folder / "run.json").write_text(text)
    before = written(tmp_path)
    for more in ((), ("--redo",)):
        refused = pup(*asked, *more)
        line = refused.err.splitlines()[-1]
        assert refused.code == 2 and line.startswith(f"pup experiment: {folder}/run.json: not ")
        assert line.endswith(f"with its folder {folder} deleted, this cell is done anew")
        assert written(tmp_path) == before
    shutil.rmtree(folder)
    workshop.done.clear()
    assert pup(*asked).code == 0 and workshop.done == [name]


def test_settings_that_a_damaged_journal_does_not_tell_are_others(tmp_path: Path) -> None:
    for told_ in ('[{"a": 1}', "[]", "3"):
        assert different({"told": told_}, {"told": '{"a": 1}'}, {}) == ("a",)


@pytest.mark.parametrize("text", [None, "", "{", "{}", "[]", '{"by": 3, "host": "a"}'])
def test_a_result_is_one_without_its_date_too(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, text: str | None
) -> None:
    shop = opened(monkeypatch)
    monkeypatch.setattr("services.experiment.gather._recordings", lambda *_: {})
    asked = ("experiment", "--small", "--stages", "record", "--local", "--json", "--out", tmp_path)
    assert pup(*asked).code == 0
    made = tmp_path / CELLS / "record-r1000" / "made.json"
    made.unlink()
    if text is not None:
        made.write_text(text)
    again = pup(*asked)
    assert again.code == 0 and len(shop.done) == 2, again.err
    cells = again.json()["experiment"]["cells"]
    assert {cells["record-r1000"][part] for part in ("host", "ended")} == {"unknown"}
    assert cells["record-r1001"]["host"] != "unknown"
    assert "unknown" in (tmp_path / "report.html").read_text()


def test_what_comes_to_light_on_the_way_deletes_nothing_either(
    workshop: Workshop, tmp_path: Path
) -> None:
    """A result that is gone may be found otherwise, by other sources say."""
    cells = graph(small())
    do(cells, tmp_path)
    (tmp_path / CELLS / "presysid-r1000" / FILES / "result.json").unlink()
    before = written(tmp_path)
    workshop.done.clear()
    workshop.chance = 1.0
    failed = do(cells, tmp_path)
    assert workshop.done == ["presysid-r1000"]
    told_ = failed["trials-r1000-forward-pup"]
    assert told_.mistaken and "is done, with another presysid-r1000; --redo" in told_.error
    after = written(tmp_path)
    kept = [f for f in before if FILES in f.parts and "presysid-r1000" not in f.parts]
    assert kept and all(after[f] == before[f] for f in kept)


def test_a_cell_is_held_against_nothing_but_what_it_left(
    workshop: Workshop, tmp_path: Path
) -> None:
    name = "trials-r1000-forward-pup"
    do(graph(small()), tmp_path)
    before = written(tmp_path)
    workshop.done.clear()
    with pytest.raises(InputError, match="is done, with another trials"):
        run_again(graph(longer(small())), name, tmp_path, places.OneByOne, told)
    assert not workshop.done and before.items() <= written(tmp_path).items()


BEFORE = {"kind": "k", "told": '{"a": {"b": 1, "c": 2}, "d": 3}', "fit": "0"}
OTHERS = {
    "nothing": (BEFORE, ()),
    "a setting": (BEFORE | {"told": '{"a": {"b": 2, "c": 2}}'}, ("a.b", "d")),
    "how it is written": (BEFORE | {"told": '{"a": {"b": 1, "c": 2}, "d": 3.0}'}, ("told",)),
    "a result": (BEFORE | {"fit": "1"}, ("presysid-r1",)),
    "a part": (BEFORE | {"start": "1"}, ("start",)),
    "not known": ({name: told for name, told in BEFORE.items() if name != "fit"}, ()),
}


@pytest.mark.parametrize("name", OTHERS)
def test_what_is_other_is_named(name: str) -> None:
    now, names = OTHERS[name]
    assert different(BEFORE, now, {"fit": "presysid-r1"}) == names
    assert different({}, now, {"fit": "presysid-r1"}) == ()


@pytest.fixture
def elsewhere(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process that has the folder."""
    with holder(tmp_path) as process:
        yield process


def test_two_processes_do_not_work_in_one_folder(
    workshop: Workshop, tmp_path: Path, elsewhere: subprocess.Popen[str]
) -> None:
    asked = ("experiment", "--small", "--stages", "record", "--local", "--json")
    asked = (*asked, "--out", tmp_path)
    refused = pup(*asked)
    assert refused.code == 1 and len(refused.err.splitlines()) == 1  # no bad input: it passes
    assert f"{tmp_path}: another process works in this folder" in refused.err
    assert not workshop.done and not (tmp_path / CELLS).exists()
    elsewhere.kill()
    elsewhere.wait()
    assert pup(*asked).code == 0 and len(workshop.done) == 2
    assert not (tmp_path / LOCK).exists()


def test_policies_that_are_not_there_are_not_trained_instead(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--policies .*polices: is no folder"):
        graph(small(), tmp_path / "polices")
    agents.bundle(tmp_path / "pup" / "forward" / "pup")  # a folder too high
    with pytest.raises(InputError, match="holds no policy that walks in this plan, such as forw"):
        graph(small(), tmp_path)
    assert graph(small(), tmp_path / "pup")
