"""Pre-sysID's fits: which are made, of what, and what is asked of each."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from biped import biped
from recordings import make

from pup.errors import InputError
from pup.files import read_json, write_json
from pup.physics.parameters import robot_space
from pup.recording import Recording
from pup.robot import Actuator, RobotDescription, TermSpec
from pup.robot_writer import write_corrected
from pup.sysid import problem as problems
from pup.sysid.fit import FitResult
from pup.sysid.result import Bounds, fitted_to, read_fitted
from services import presysid
from services.presysid import FAR_SIGMA, NEAR_SIGMA, _Job, identify
from services.presysid_folds import kept_in_folds
from services.presysid_options import Options
from workers.fits import Fit, LocalRunner, Progress

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


def test_the_left_out_loss_is_equation_1_over_all(robot: RobotDescription, tmp_path: Path) -> None:
    """Where no fold's fit moves, it is the loss of the fit of all: one fold has feet, one has none.

    So do not the means of the folds' own losses, whose recordings are of two numbers besides.
    """
    tilt = {"imu/roll": np.zeros(TICKS), "imu/pitch": np.linspace(0, 0.2, TICKS)}
    recordings = (
        stepped("air", "suspended"),
        stepped("floor", "ground", extras=tilt),
        stepped("more_air", "suspended"),
    )
    job, runner = job_of(robot, recordings, tmp_path, Options("pd", folds=2, compare=False))
    _, held_out = job._nominal()
    whole = runner.fits["nominal_pd"]
    assert held_out is not None
    expected = whole.problem.losses(whole.settings.start[None])[0]
    assert held_out["loss"] == pytest.approx(expected, rel=1e-9)


def test_repeats_are_no_units_of_folds(robot: RobotDescription, tmp_path: Path) -> None:
    """Four recordings of one motion, of which two repeat the others: two folds, and no more."""
    every = tuple(
        stepped(f"{name}{n}", "suspended", repeat_of=name + "1" if n == 2 else None)
        for name in "ab"
        for n in (1, 2)
    )
    assert kept_in_folds(every, 2) == [(2, 3), (0, 1)]
    with pytest.raises(InputError, match="3 folds for 2 recordings that repeat no other"):
        job_of(robot, every, tmp_path, Options("pd", folds=3))


def test_a_robot_described_without_feet_stands_too(robot: RobotDescription, tmp_path: Path) -> None:
    """Feet are optional: what it stands on is in no term of equation 1 then."""
    footless = replace(robot, feet=())
    recordings = (stepped("air", "suspended"), stepped("floor", "ground"))
    job, _ = job_of(footless, recordings, tmp_path, Options("pd", compare=False))
    problem = job._problem("pd")
    unit = np.full((2, len(problem.free)), 0.5)
    errors, blocks = problem.errors(unit)
    norms = np.sqrt(np.add.reduceat(errors**2, blocks, axis=1))
    np.testing.assert_allclose(norms.sum(axis=1), problem.losses(unit), rtol=1e-12)
    assert "the robot is described without feet: foot term left out" in problem.loss.omitted()


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


def test_recordings_longer_than_the_memory_are_refused_before_any_fit(
    robot: RobotDescription, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(problems, "memory", lambda: 1000)
    job, runner = job_of(robot, (stepped("a", "suspended"),) * 2, tmp_path, Options("pd"))
    with pytest.raises(InputError, match="give fewer or shorter recordings"):
        job.run()
    assert not runner.fits


def test_bounds_of_another_torque_law_are_not_replaced(tmp_path: Path) -> None:
    """A user compares both: the second would be in the place of the first."""
    bench = RobotDescription.load("servo_bench")
    run = stepped(
        "a",
        "bench",
        robot="servo_bench",
        joints=("servo",),
        target=np.full((TICKS, 1), 0.1),
        position=0.1 * np.linspace(0, 1, TICKS)[:, None],
    )

    def found(actuator: Actuator) -> Bounds:
        asked = Options(actuator, subsets=2, compare=False, fixed_network=True)
        return job_of(bench, (run,), tmp_path, asked)[0].run()

    first = found("pd")
    kept = (tmp_path / "bounds.json").read_bytes()
    with pytest.raises(InputError, match=r"of the pd torque law; use another --out for .* nn_pd"):
        found("nn_pd")
    assert (tmp_path / "bounds.json").read_bytes() == kept
    assert found("pd").document()["parameters"] == first.document()["parameters"]


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


@pytest.mark.parametrize(("subsets", "seen"), [(1, 0), (10, 1), (19, 2)])
def test_the_only_recording_on_the_floor_tells_of_it(
    robot: RobotDescription,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    subsets: int,
    seen: int,
) -> None:
    """Ten subsets of two deal all of 19; of what too few see the whole interval is told."""
    monkeypatch.setattr(presysid, "write_report", lambda *_: None)
    alone = 3  # drawn anew each time, ten subsets of seed 0 miss it
    supports = ["ground" if i == alone else "suspended" for i in range(19)]
    every = tuple(stepped(f"r{i:02}", support) for i, support in enumerate(supports))
    options = Options("pd", generations=1, subsets=subsets, fraction=0.1, compare=False)
    bounds = job_of(robot, every, tmp_path, options)[0].run()
    at = bounds.space.names.index("ground_friction")
    values = [subset.values[at] for subset in bounds.subsets]
    assert (~np.isnan(values)).sum() == seen
    low, high = bounds.ci90[at]
    assert seen == 2 or bounds.lower[at] <= low < high <= bounds.upper[at]
    assert any("ground_friction" in line for line in bounds.omitted) == (seen < 2)


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


def written(folder: Path, robot: RobotDescription, **terms: float) -> RobotDescription:
    """The robot, with friction of its left hip in its description."""
    friction = TermSpec("coulomb_friction", "joint", "l_hip", terms)
    return write_corrected(robot, folder, {}, (friction,))


@pytest.mark.usefixtures("short_polish")
def test_another_diagnosis_is_identified_in_the_same_folder(
    robot: RobotDescription, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Values that are kept are part of what is fitted beside them: that is another fit then."""
    monkeypatch.setattr(presysid, "write_report", lambda *_: None)
    recordings = (stepped("a", "suspended"), stepped("b", "ground"))
    options = Options(generations=1, population=4, subsets=2, subset_generations=1)
    options = replace(options.corrected(("step",)), imu=False)
    told = []
    for torque in (0.05, 0.1, 0.05):
        corrected = written(tmp_path / f"robot{torque}", robot, torque=torque)
        given = recordings, options, tmp_path / "out", LocalRunner(), lambda *_: None, 1
        told.append(identify(corrected, *given))
    assert told[0].train != told[1].train and told[0].train == told[2].train
    assert len(list((tmp_path / "out/checkpoints").glob("others-*"))) == 2


def start(
    robot: RobotDescription, folder: Path, recordings: Sequence[Recording], **changes: float
) -> Path:
    """Bounds with other values than the description's, of a fit to recordings."""
    space = robot_space(robot, "pd").at(changes)
    document = {
        "schema": 1,
        "robot": robot.name,
        "actuator": {"kind": "pd", "weights": []},
        "parameters": [
            {"name": name, "nominal": float(value)}
            for name, value in zip(space.names, space.nominal, strict=True)
        ],
        "provenance": {"recordings": {r.id: r.digest for r in recordings}},
    }
    write_json(folder / "start.json", document)
    return folder / "start.json"


def test_folds_begin_at_nothing_that_was_fitted_to_what_they_leave_out(
    robot: RobotDescription, tmp_path: Path
) -> None:
    """What the recordings of a fold cannot see would stay what the others have told."""
    recordings = (stepped("air", "suspended"), stepped("floor", "ground"))
    others = (stepped("other", "suspended"), stepped("other_floor", "ground"))
    described = 0.7
    for fitted, begun in ((recordings, described), (recordings[1:], described), (others, 0.9)):
        file = start(robot, tmp_path, fitted, ground_friction=0.9)
        options = Options("pd", folds=2, compare=False, start=file)
        job, runner = job_of(robot, recordings, tmp_path / "out", options)
        job._nominal()
        folds = {fit.problem.recordings: fit for n, fit in runner.fits.items() if "fold" in n}
        fit = folds[recordings[:1]]
        assert "ground_friction" not in fit.problem.free
        assert fit.problem.space.nominal[fit.problem.space.names.index("ground_friction")] == begun
        assert fit.settings.sigma == (FAR_SIGMA if begun == described else NEAR_SIGMA)
        whole = runner.fits["nominal_pd"].problem.space
        assert whole.nominal[whole.names.index("ground_friction")] == 0.9


def test_a_start_that_tells_no_recordings_may_have_seen_them_all(
    robot: RobotDescription, tmp_path: Path
) -> None:
    file = start(robot, tmp_path, ())
    assert fitted_to(file) == frozenset()
    after_another = {"recordings": {"a": "its digest"}, "options": {"start": "of whatever"}}
    for provenance in ({}, [], {"recordings": []}, after_another):
        write_json(file, {"provenance": provenance})
        assert fitted_to(file) is None


def test_an_imu_that_a_start_has_is_told_on(
    robot: RobotDescription, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It acts in the fit, and in whatever reads its bounds."""
    monkeypatch.setattr(presysid, "write_report", lambda *_: None)
    tilt = {"imu/roll": np.zeros(TICKS), "imu/pitch": np.linspace(0, 0.1, TICKS)}
    recordings = (stepped("a", "suspended"), stepped("b", "ground", extras=tilt))
    file = start(robot, tmp_path, ())
    told = {"name": "imu_misalignment/pitch@sensor", "nominal": 0.05}
    write_json(file, read_json(file) | {"imu": [told]})
    options = Options("pd", subsets=2, compare=False, start=file)
    job, _ = job_of(robot, recordings, tmp_path / "out", options)
    bounds = job.run()
    assert dict(zip(bounds.imu.names, bounds.imu.nominal, strict=True)) == {told["name"]: 0.05}
    space = read_fitted(tmp_path / "out" / "bounds.json", robot)[1]
    read = replace(job.full["pd"], space=space, free=())
    assert read.losses(np.empty((1, 0)))[0] == pytest.approx(bounds.train["loss"], rel=1e-12)
