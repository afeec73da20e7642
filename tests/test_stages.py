"""Stages of a job: done once, and again when what they depend on changed; left out, and why."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import agents
import pytest
from commandline import TINY, files, pup
from refusals import Place, assert_refused

from pup.errors import InputError
from pup.files import write_json
from pup.robot import RobotDescription
from pup.sysid.result import read_bounds
from services.job_report import Job, found, write_report
from services.mission import TRIALS, Means
from services.pipeline import POLICIES
from services.stages import Done, Journal, Stage
from tests.reports import Page

DARWIN = RobotDescription.load("darwin_op2")


def idle() -> Means:
    """The means of a job of which no stage is run."""
    nothing = [None] * 6
    return Means(*nothing, print, 1)  # type: ignore[arg-type]


class Counter:
    """The work of a stage, which counts how often it is done."""

    def __init__(self, out: Path) -> None:
        self.out, self.count, self.fails = out, 0, False

    def stage(self, value: str = "a", remade: bool = True) -> Stage:
        return Stage(
            "one", {"value": value}, ("one/x.json",), self.work, folder="one", remade=remade
        )

    def work(self) -> None:
        self.count += 1
        (self.out / "one").mkdir(exist_ok=True)
        kept = [f.name for f in (self.out / "one").iterdir()]
        (self.out / "one" / f"attempt{self.count}").touch()
        if self.fails:
            raise KeyboardInterrupt
        write_json(self.out / "one" / "x.json", {"kept": sorted(kept)})


def kept(out: Path) -> list[str]:
    return list(json.loads((out / "one" / "x.json").read_text())["kept"])


def test_a_stage_is_done_once_and_again_when_something_changed(tmp_path: Path) -> None:
    counter = Counter(tmp_path)
    for _ in range(2):
        Journal(tmp_path).once(counter.stage())
    assert counter.count == 1
    done = Journal(tmp_path)
    done.once(counter.stage())
    assert done.done("one").inputs == {"value": "a"}
    assert done.done("one").files.keys() == {"one/x.json"}
    Journal(tmp_path).once(counter.stage("b"))
    assert counter.count == 2 and kept(tmp_path) == []  # nothing of the other inputs is left
    (tmp_path / "one" / "x.json").write_text("{}")
    Journal(tmp_path).once(counter.stage("b"))
    assert counter.count == 3 and kept(tmp_path) == []
    (tmp_path / "one" / "x.json").unlink()
    Journal(tmp_path).once(counter.stage("b", remade=False))
    assert counter.count == 4 and kept(tmp_path) == ["attempt3"]


def test_what_is_done_stays_done_without_its_pictures(tmp_path: Path) -> None:
    """They are drawn again where that can be done alone, and only where there were some."""
    counter, drawn = Counter(tmp_path), []
    pictures = ("one/attempt1", "one/never.png")
    stage = replace(counter.stage(), pictures=pictures, draw=lambda: drawn.append(1))
    Journal(tmp_path).once(stage)
    assert Journal(tmp_path).done("one").files.keys() == {"one/x.json", "one/attempt1"}
    Journal(tmp_path).once(stage)
    assert not drawn
    (tmp_path / "one" / "attempt1").unlink()
    Journal(tmp_path).once(stage)
    Journal(tmp_path).once(replace(stage, draw=None))
    assert counter.count == 1 and drawn == [1]


def test_an_interrupted_stage_finds_what_it_left_unless_its_inputs_changed(tmp_path: Path) -> None:
    counter = Counter(tmp_path)
    counter.fails = True
    for value, count in (("a", 1), ("a", 2), ("b", 3)):
        with pytest.raises(KeyboardInterrupt):
            Journal(tmp_path).once(counter.stage(value))
        assert counter.count == count
    counter.fails = False
    Journal(tmp_path).once(counter.stage("b"))
    assert kept(tmp_path) == ["attempt3"]


def test_a_stage_that_is_done_anew_goes_on_from_what_it_left(tmp_path: Path) -> None:
    """However often it is interrupted: that it was done once is forgotten when it is begun."""
    counter = Counter(tmp_path)
    Journal(tmp_path).once(counter.stage())
    (tmp_path / "one" / "x.json").write_text("{}")
    counter.fails = True
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            Journal(tmp_path).once(counter.stage())
    counter.fails = False
    Journal(tmp_path).once(counter.stage())
    assert kept(tmp_path) == ["attempt2", "attempt3"]


@pytest.mark.parametrize("value", ["a", "b"])
def test_who_is_stopped_while_a_folder_is_emptied_empties_it_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, value: str
) -> None:
    """Neither what is half gone nor what is left of other inputs is taken for a beginning."""
    counter = Counter(tmp_path)
    Journal(tmp_path).once(counter.stage())
    (tmp_path / "one" / "x.json").write_text("{}")

    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("services.stages.shutil.rmtree", stop)
        Journal(tmp_path).once(counter.stage(value))
    assert not Journal(tmp_path).inputs("one")
    Journal(tmp_path).once(counter.stage(value))
    assert counter.count == 2 and kept(tmp_path) == []


@pytest.mark.parametrize(
    "change", [{"files": []}, {"files": None}, {"seconds": None}, {"inputs": "a"}]
)
def test_a_stage_whose_entry_was_changed_is_done_again(
    tmp_path: Path, change: dict[str, object]
) -> None:
    """From what it left: nothing is lost."""
    counter = Counter(tmp_path)
    Journal(tmp_path).once(counter.stage())
    told = json.loads((tmp_path / "run.json").read_text())
    told["stages"]["one"] |= change
    write_json(tmp_path / "run.json", told)
    journal = Journal(tmp_path)
    journal.once(counter.stage())
    assert counter.count == 2 and "attempt1" in kept(tmp_path)
    assert journal.done("one").files


def test_what_is_no_journal_is_refused(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text('{"stages": []}')
    with pytest.raises(InputError, match="not the journal"):
        Journal(tmp_path)


REFUSED = {
    "--train-steps": ("servo_bench", ("--train-steps", 1000), "has no gait to train"),
    "--trials": ("servo_bench", ("--trials", 3), "no policy to walk with"),
    "trials without a policy": (
        "darwin_op2",
        ("--trials", 3, "--train-steps", 0),
        "no policy to walk with",
    ),
    "too few": ("servo_bench", ("--trials", -1), "-1 is not between 0 and 1000"),
    "half a step": ("servo_bench", ("--train-steps", 0.5), "'0.5' is not a whole number"),
    "a walk of nobody": ("servo_bench", ("--repeats", "x"), "'x' is not a whole number"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_a_robot_cannot_do_is_refused_before_anything_is_done(
    place: Place, name: str, tmp_path: Path
) -> None:
    robot, options, words = REFUSED[name]
    folder = shutil.copytree(RobotDescription.load(robot).folder, tmp_path / "its" / robot)
    shutil.rmtree(folder / POLICIES, ignore_errors=True)
    given = () if robot == "darwin_op2" else ("--recordings", place.bench)
    done = pup("run", "--robot", folder, *given, "--out", place.out, *TINY, *options)
    assert_refused(done, words)
    assert not files(place.out)


def test_a_virtual_robot_walks_for_no_other(tmp_path: Path) -> None:
    """Its walks would be diagnosed together with recordings of a robot that it knows nothing of."""
    from services.mission import Mission, default_recordings
    from services.pipeline import _Job
    from services.presysid_options import Options

    def job(source: str, trials: int | None) -> _Job:
        *others, last = default_recordings(DARWIN)
        recordings = [*others, replace(last, source=source)]
        return _Job(DARWIN, recordings, Mission(Options(), 1000, trials), tmp_path, idle())

    assert job("simulation", None).trials == TRIALS
    real = job("hardware", None)
    assert real.trials == 0 and "pup transfer" in real.left_out["transfer"]
    with pytest.raises(InputError, match="--trials: the robot that was recorded is not here"):
        job("hardware", 3)


def test_a_shipped_policy_is_started_from_where_there_is_one(
    tmp_path: Path,
) -> None:
    from services.mission import Mission
    from services.pipeline import Half, _Job
    from services.presysid_options import Options

    folder = shutil.copytree(DARWIN.folder, tmp_path / "darwin_op2")
    shutil.rmtree(folder / POLICIES, ignore_errors=True)
    names = read_bounds(DARWIN.identified_path, DARWIN).names
    out = tmp_path / "out"
    (out / "presysid").mkdir(parents=True)
    shutil.copy(DARWIN.identified_path, out / "presysid" / "bounds.json")

    def start() -> Path | None:
        robot = RobotDescription.load(folder)
        job = _Job(robot, (), Mission(Options(), 1000, 0), out, idle())
        return job._start(Half(robot, Options()))

    assert start() is None
    shipped = agents.bundle(folder / POLICIES / "forward", parameters=names)
    assert start() == shipped
    shutil.rmtree(shipped)
    agents.bundle(shipped, parameters=names[1:])
    assert start() == shipped  # of other parameters: it learns to see them


def test_what_is_replayed_depends_on_the_physics(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A job that goes on by another pup keeps no bounds and no errors of the one before."""
    from services import pipeline
    from services.mission import Mission
    from services.presysid_options import Options

    (tmp_path / "presysid").mkdir()
    shutil.copy(DARWIN.identified_path, tmp_path / "presysid" / "bounds.json")
    job = pipeline._Job(DARWIN, (), Mission(Options(), 0, 0), tmp_path, idle())

    def inputs() -> list[dict[str, str]]:
        makers = job._presysid, job._replay
        return [dict(make(job.first).inputs) for make in makers] + [dict(job._diagnosis().inputs)]

    before = inputs()
    assert inputs() == before
    monkeypatch.setattr(pipeline, "MODEL", pipeline.MODEL + 1)
    assert all(now != then for now, then in zip(inputs(), before, strict=True))


def test_no_picture_has_anything_done_again(tmp_path: Path) -> None:
    """A removed curve would cost the training, whose folder is emptied before it is made again."""
    from services.mission import Mission
    from services.pipeline import _Job
    from services.presysid_options import Options

    (tmp_path / "presysid").mkdir()
    shutil.copy(DARWIN.identified_path, tmp_path / "presysid" / "bounds.json")
    (tmp_path / "train" / "policy").mkdir(parents=True)
    (tmp_path / "train" / "policy" / "policy.json").write_text("{}")
    (tmp_path / "transfer").mkdir()
    (tmp_path / "transfer" / "study.json").write_text("{}")
    job = _Job(DARWIN, (), Mission(Options(), 1000, 3), tmp_path, idle())
    makers = (job._presysid, job._train, job._walk, job._transfer, job._rehearsal)
    stages = [make(job.first) for make in makers]
    for stage in stages:
        assert {Path(file).suffix for file in stage.files} <= {".json", ".npz", ".onnx"}
    assert stages[1].pictures == ("train/curve.png",)
    curve = {name: [0.1] for name in ("steps", "distance", "time", "reward", "kl")}
    told = {"robot": "r", "method": "pup", "direction": "forward", "steps": 9, "seconds": 9}
    write_json(tmp_path / "train" / "training.json", told | {"curve": curve})
    stages[1].draw()
    assert (tmp_path / "train" / "curve.png").exists()


def test_the_report_tells_what_each_stage_found_and_hashes(tmp_path: Path) -> None:
    """Words of documents are text, never markup."""
    walks = [
        {"number": i + 1, "purpose": p, "eta": [0.1], "state": "succeeded", "attempt": 1}
        | {"distance": 0.5 + 0.1 * i, "time": 3.0, "reason": "<b>fell</b>"}
        for i, p in enumerate(("initial", "search", "repeat", "compare"))
    ]
    loss = {"loss": 1.0, "loss_before": 2.0, "rmse": 0.1, "rmse_before": 0.2}
    parameter = {"name": "rho", "unit": "1", "nominal": 1, "lower": 0, "upper": 2}
    documents = {
        "presysid": {"parameters": [parameter | {"identified": True}]}
        | {"loss": {"train": loss}, "provenance": {"options": {"as_described": False}}},
        "replay": {"per_recording": {"<i>a": 0.1}, "rmse": 0.1, "unit": "rad"},
        "transfer": {
            "horizon": 15.0,
            "virtual_robot": 0,
            "eta": [0.1],
            "fitted_eta": [0.2],
            "chosen": {"distance": [0.7, 0.9], "mean": 0.8, "std": 0.1414},
            "fitted": {"distance": [], "mean": None, "std": None},
            "walks": walks,
        },
        "diagnosis": {
            "verdict": "mismatch",
            "reason": "",
            "held_out": None,
            "findings": [
                {"effect": "unknown", "place": {"kind": "robot", "names": ["r"]}, "law": None}
                | {"regime": "at high speed", "probability": 0.29}
            ],
        },
    }
    done = {n: Done({"robot r": "f" * 64}, 61.4, {f"{n}/x.json": "e" * 64}) for n in documents}
    write_report(Job("r<obot", tmp_path, documents, done, {"train": "as told"}))
    page = Page(tmp_path / "report.html")
    assert "<b>fell" in page.text and "Job of r<obot" in page.text
    assert not {"b", "i", "script"} & {name for name, _ in page.elements}
    assert "left out: as told" in page.text
    assert "at high speed29%none that held" in page.text  # a part without a name or a law
    assert "e" * 64 in page.text and "f" * 64 in page.text
    words = found(documents)["transfer"]
    assert words == "2 trials; chosen eta 0.80 ± 0.14 m, eta of the fitted parameters not walked"


def test_a_walk_is_told_as_fitted_and_over_the_bounds() -> None:
    """Wide bounds hold robots that no policy keeps up; the fitted one may walk nevertheless."""
    shown = {"distance": 1.3, "time": 14.0, "fell": False}
    median = {"distance_median": 0.2, "time_median": 1.0, "upright_share": 0.25}
    over = "median 0.20 m in 1.0 s over the bounds, 25% without a fall"
    told = found({"walk": {"shown": shown, **median}})["walk"]
    assert told == f"1.30 m with the fitted parameters; {over}"
    fallen = {"distance": -0.1, "time": 2.5, "fell": True}
    told = found({"corrected-walk": {"shown": fallen, **median}})["corrected-walk"]
    assert told == f"-0.10 m with the fitted parameters, fallen after 2.5 s; {over}"
