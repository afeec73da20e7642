"""Pre-sysID's fits: which are made, of what, and what is asked of each."""

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from biped import biped
from recordings import make

from pup.errors import InputError
from pup.recording import Recording
from pup.robot import RobotDescription
from pup.sysid.fit import FitResult
from pup.sysid.result import Bounds
from services import presysid
from services.presysid import _Job
from services.presysid_options import Options
from workers.fits import Fit, Progress

TICKS = 10


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> RobotDescription:
    return biped(tmp_path_factory.mktemp("biped"))


def stepped(id_: str, support: str, **changes: object) -> Recording:
    """A step of both legs, which follow halfway."""
    target = np.zeros((TICKS, 2))
    target[2:] = [0.1, -0.1]
    told = {
        "id": id_,
        "robot": "biped",
        "motion": "stand" if support == "ground" else "step",
        "support": support,
        "joints": ("l_hip", "r_hip"),
        "time": np.arange(TICKS) / 30,
        "target": target,
        "position": target / 2,
    }
    return make(**(told | changes))


class Idle:
    """A runner whose fits end where they begin."""

    def __init__(self) -> None:
        self.fits: dict[str, Fit] = {}

    def run(self, fits: Sequence[Fit], checkpoints: Path, progress: Progress) -> list[FitResult]:
        self.fits |= {fit.name: fit for fit in fits}
        return [FitResult(fit.settings.start, 0.0, np.empty(0)) for fit in fits]


def job_of(
    robot: RobotDescription, recordings: tuple[Recording, ...], out: Path, options: Options
) -> tuple[_Job, Idle]:
    runner = Idle()
    return _Job(robot, recordings, options, out, runner, lambda *_: None, 1), runner


def test_a_fold_fits_what_its_recordings_can_see(robot: RobotDescription, tmp_path: Path) -> None:
    """Those in the air know no friction of the ground, which the fold then leaves as it was."""
    recordings = (stepped("air", "suspended"), stepped("floor", "ground"))
    options = Options("pd", folds=2, compare=False)
    job, runner = job_of(robot, recordings, tmp_path, options)
    _, held_out = job._nominal()
    assert "ground_friction" in runner.fits["nominal_pd"].problem.free
    folds = [fit.problem for name, fit in runner.fits.items() if name.startswith("fold")]
    for problem in folds:
        on_ground = problem.recordings[0].support == "ground"
        assert ("ground_friction" in problem.free) is on_ground
    assert held_out is not None and held_out["folds"] == 2
    assert np.isfinite([held_out["loss"], held_out["rmse"]]).all()


def test_repeats_are_no_units_of_folds(robot: RobotDescription, tmp_path: Path) -> None:
    """Four recordings of one motion, of which two repeat the others: two folds, and no more."""
    every = tuple(
        stepped(f"{name}{n}", "suspended", repeat_of=name + "1" if n == 2 else None)
        for name in "ab"
        for n in (1, 2)
    )
    job, _ = job_of(robot, every, tmp_path, Options("pd", folds=2))
    assert job._folds() == [(2, 3), (0, 1)]
    with pytest.raises(InputError, match="3 folds for 2 recordings that repeat no other"):
        job_of(robot, every, tmp_path, Options("pd", folds=3))


def unread(id_: str) -> Recording:
    """A step of which nothing was read but where it began."""
    position = np.full((TICKS, 2), np.nan)
    position[0] = 0.0
    return stepped(id_, "suspended", position=position)


def test_where_nothing_was_read_there_is_nothing_to_fit(
    robot: RobotDescription, tmp_path: Path
) -> None:
    job, _ = job_of(robot, (unread("a"), unread("b")), tmp_path, Options("pd"))
    with pytest.raises(InputError, match="nothing to fit: no parameter changes"):
        job._problem("pd")


def test_a_subset_that_sees_nothing_is_not_searched(
    robot: RobotDescription, tmp_path: Path
) -> None:
    every = (stepped("a", "suspended"), unread("b"), unread("c"))
    options = Options("pd", subsets=6, compare=False)
    job, runner = job_of(robot, every, tmp_path, options)
    problem = job._problem("pd")
    subsets = job._subsets(problem)
    blind = ["a" not in subset.recordings for subset in subsets]
    assert any(blind) and not all(blind)
    assert len(subsets) == 6 and len(runner.fits) == 6 - sum(blind)
    for subset, nothing in zip(subsets, blind, strict=True):
        assert np.isnan(subset.values).all() == nothing
        assert not nothing or subset.loss == 0


def test_what_was_not_diagnosed_is_fitted_and_the_rest_stays(
    robot: RobotDescription, tmp_path: Path
) -> None:
    """A robot that hung tells nothing of the floor; one that stands does."""
    recordings = (stepped("a", "suspended"), stepped("b", "suspended"), stepped("c", "ground"))
    asked = Options(generations=3, subsets=2, subset_generations=1, actuator="pd")
    job, runner = job_of(robot, recordings, tmp_path, asked.corrected(("step",)))
    bounds = job.run()
    fit = runner.fits["others"]
    assert set(fit.problem.free).isdisjoint(job.kept)
    told = dict(zip(bounds.space.names, bounds.ci90, strict=True))
    assert told["ground_friction"][0] < told["ground_friction"][1]
    for name, value in zip(bounds.space.names, bounds.nominal, strict=True):
        assert name not in job.kept or (told[name] == value).all()
    assert "ground_friction" in fit.problem.free
    assert not [name for name in fit.problem.free if name.startswith(("kp", "kd", "tau_max"))]
    assert fit.problem.recordings == recordings
    job, runner = job_of(robot, recordings, tmp_path, asked.corrected())
    bounds = job.run()
    assert "others" not in runner.fits
    assert (bounds.ci90[:, 0] == bounds.ci90[:, 1]).all() and bounds.identified.all()


def test_bounds_that_are_made_again_are_the_same_file(
    robot: RobotDescription, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Others know them by its SHA-256, and how long it took is no part of them."""
    clock = iter(range(0, 1000, 7))
    monkeypatch.setattr(presysid, "time", SimpleNamespace(time=lambda: next(clock) ** 2))
    monkeypatch.setattr(presysid, "write_report", lambda *_: None)
    recordings = (stepped("a", "suspended"), stepped("b", "ground"))
    file = tmp_path / "bounds.json"

    def made(seed: int) -> tuple[bytes, Bounds]:
        options = Options("pd", subsets=2, compare=False, seed=seed)
        bounds = job_of(robot, recordings, tmp_path, options)[0].run()
        return file.read_bytes(), bounds

    first, bounds = made(seed=0)
    again, same = made(seed=0)
    assert again == first and same.provenance == bounds.provenance
    other, bounds = made(seed=1)
    assert other != first and bounds.provenance["seconds"] != same.provenance["seconds"]
    for spoilt in ("[]", "{}", '{"provenance": 1}', "{"):
        file.write_text(spoilt)
        assert bounds.as_before(file) is bounds


class Moved(Idle):
    """A runner whose fits end a tenth further."""

    def run(self, fits: Sequence[Fit], checkpoints: Path, progress: Progress) -> list[FitResult]:
        found = super().run(fits, checkpoints, progress)
        return [FitResult(np.clip(f.best + 0.1, 0, 1), f.loss, f.history) for f in found]


def test_only_what_was_fitted_moves(robot: RobotDescription, tmp_path: Path) -> None:
    recordings = (stepped("a", "suspended"), stepped("b", "ground"))
    options = Options(generations=3, actuator="pd").corrected(("step",))
    job = _Job(robot, recordings, options, tmp_path, Moved(), lambda *_: None, 1)
    problem = job._problem("pd")
    before = problem.free_space.normalise(problem.free_space.nominal)
    after = job._kept(problem).best
    moved = {name for name, a, b in zip(problem.free, after, before, strict=True) if a != b}
    assert "ground_friction" in moved
    assert not [name for name in moved if name.startswith(("kp", "kd", "tau_max", "armature"))]
    assert len(moved) < len(problem.free)
