"""Fits on a real Ray: the same to the last bit as in one process, whatever is killed meanwhile."""

import os
import shutil
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import ray

from pup.diagnosis.replays import Replays
from pup.diagnosis.residuals import Measured
from pup.errors import InputError
from pup.physics.parameters import robot_space
from pup.recording import load_recordings
from pup.robot import RobotDescription
from pup.sysid.fit import FitResult, FitSettings
from pup.sysid.problem import Problem
from workers import fits as module
from workers.cluster import connected
from workers.fits import Fit, LocalRunner, RayRunner, Status, fetched
from workers.hypotheses import ray_runner

pytestmark = pytest.mark.ray
GENERATIONS = 12


@pytest.fixture(scope="module")
def fits(leg_recordings: Path) -> list[Fit]:
    """Three fits of a leg, one of them pulled to its start."""
    robot = RobotDescription.load("darwin_leg")
    space = robot_space(robot, "pd")
    problem = Problem(robot, load_recordings([leg_recordings]), "pd", space, space.names)
    start = space.normalise(space.nominal)
    return [
        Fit("all", problem, FitSettings(start, 0.25, 8, GENERATIONS, seed=1)),
        Fit("few", problem.of([0]), FitSettings(start, 0.1, 7, GENERATIONS, seed=2)),
        Fit("near", problem.of([1]), FitSettings(start, 0.05, 8, GENERATIONS, 3, start)),
    ]


@pytest.fixture(scope="module")
def wanted(fits: list[Fit], tmp_path_factory: pytest.TempPathFactory) -> list[FitResult]:
    return LocalRunner().run(fits, tmp_path_factory.mktemp("local"), lambda _: None)


@pytest.fixture(scope="module")
def runner() -> Iterator[RayRunner]:
    """One for all tests: its actors stay, as from stage to stage of a job."""
    with connected(cores=2):
        yield RayRunner()


def assert_same(results: Sequence[FitResult], wanted: Sequence[FitResult]) -> None:
    for result, one in zip(results, wanted, strict=True):
        assert result.loss == one.loss
        assert np.array_equal(result.best, one.best)
        assert np.array_equal(result.history, one.history)


class Once:
    """Does something when the fits have come to some generation."""

    def __init__(self, generation: int, deed: Callable[[], Any]) -> None:
        self.generation, self.deed, self.done = generation, deed, False
        self.seen: list[list[Status]] = []

    def __call__(self, statuses: Sequence[Status]) -> None:
        self.seen.append(list(statuses))
        if not self.done and max(s.generation for s in statuses) >= self.generation:
            self.done = True
            self.deed()


def workers_named(name: str) -> list[psutil.Process]:
    """Processes of the embedded Ray of this process whose title begins so."""
    found = []
    for process in psutil.Process().children(recursive=True):
        with suppress(psutil.NoSuchProcess):  # it ended since it was listed
            if process.name().startswith(name[:15]):
                found.append(process)
    return found


def kill_one(name: str) -> None:
    deadline = time.monotonic() + 30
    while not (found := workers_named(name)):
        assert time.monotonic() < deadline, f"no process {name}"
        time.sleep(0.002)
    found[0].send_signal(signal.SIGKILL)


def test_the_same_as_in_one_process(
    runner: RayRunner, fits: list[Fit], wanted: list[FitResult], tmp_path: Path
) -> None:
    told = Once(1, lambda: None)
    assert_same(runner.run(fits, tmp_path, told), wanted)
    assert [s.name for s in told.seen[-1]] == ["all", "few", "near"]
    assert all(s.done and s.generation == GENERATIONS for s in told.seen[-1])
    for before, after in zip(told.seen, told.seen[1:], strict=False):
        for a, b in zip(before, after, strict=True):
            assert a.generation <= b.generation


def test_a_finished_fit_is_not_fitted_again(
    runner: RayRunner, fits: list[Fit], wanted: list[FitResult], tmp_path: Path
) -> None:
    """Checkpoints of one runner are good for the other."""
    LocalRunner().run(fits, tmp_path, lambda _: None)
    written = {f: f.stat().st_mtime_ns for f in tmp_path.iterdir()}
    assert_same(runner.run(fits, tmp_path, lambda _: None), wanted)
    assert written == {f: f.stat().st_mtime_ns for f in tmp_path.iterdir()}


@pytest.mark.parametrize("share", [3, 100])
def test_the_number_of_tasks_changes_nothing(
    runner: RayRunner,
    fits: list[Fit],
    wanted: list[FitResult],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    share: int,
) -> None:
    """A generation cut for any number of cores, down to single candidates."""
    monkeypatch.setattr(module, "_cores", lambda: share)
    monkeypatch.setattr(module, "POLL_SECONDS", 0.02)
    assert_same(runner.run(fits[1:2], tmp_path, lambda _: None), wanted[1:2])


def test_a_killed_worker_changes_nothing(
    runner: RayRunner, fits: list[Fit], wanted: list[FitResult], tmp_path: Path
) -> None:
    kill = Once(10, lambda: kill_one("ray::evaluate"))
    assert_same(runner.run(fits, tmp_path, kill), wanted)
    assert kill.done


@pytest.mark.parametrize("generation", [1, 10])
def test_a_killed_actor_resumes_from_its_checkpoint(
    runner: RayRunner, fits: list[Fit], wanted: list[FitResult], tmp_path: Path, generation: int
) -> None:
    kill = Once(generation, lambda: kill_one("ray::FitActor"))
    assert_same(runner.run(fits, tmp_path, kill), wanted)
    assert kill.done


def test_a_stopped_runner_leaves_nothing_running_and_resumes(
    runner: RayRunner, fits: list[Fit], wanted: list[FitResult], tmp_path: Path
) -> None:
    def stop() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        runner.run(fits, tmp_path, Once(5, stop))
    deadline = time.monotonic() + 20
    while workers_named("ray::FitActor") or workers_named("ray::evaluate"):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    assert_same(runner.run(fits, tmp_path, lambda _: None), wanted)


def test_more_fits_than_run_at_once(runner: RayRunner, fits: list[Fit], tmp_path: Path) -> None:
    many = [
        Fit(f"f{i}", fits[1].problem, replace(fits[1].settings, generations=2, seed=i))
        for i in range(5)  # four run at once
    ]
    local = LocalRunner().run(many, tmp_path / "local", lambda _: None)
    assert_same(runner.run(many, tmp_path / "ray", lambda _: None), local)


def test_what_a_node_cannot_write_is_nobodys_input(
    runner: RayRunner, fits: list[Fit], tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="on a node of the cluster") as caught:
        runner.run(fits[1:2], tmp_path / "file", lambda _: None)
    assert caught.value.filename is None  # by which `pup` tells bad input


def test_what_a_replay_refuses_is_told_in_its_own_words(
    runner: RayRunner, fits: list[Fit], tmp_path: Path
) -> None:
    """As where a node does not have the robot's folder: Ray's words are a coloured traceback."""
    problem = fits[1].problem
    folder = shutil.copytree(problem.robot.folder, tmp_path / "leg")
    robot = RobotDescription.load(folder)
    measured = Measured.of(robot, problem.recordings)
    shutil.rmtree(folder)
    replays = Replays(measured, robot_space(robot, "pd"), ray_runner(measured, "pd"), 1)
    with pytest.raises(InputError, match=f"^{robot.model_path}: MuJoCo refuses it") as caught:
        replays([{}])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("through_another", [False, True])
def test_a_process_that_is_lost_too_often_is_told_in_a_line(
    runner: RayRunner, through_another: bool
) -> None:
    """What an actor asks for is lost by others than what this process does."""

    def end() -> None:
        os._exit(1)

    lost = ray.remote(max_retries=0)(end)

    def ask() -> None:
        ray.get(lost.remote())

    asked = ray.remote(ask) if through_another else lost
    with pytest.raises(ConnectionError, match=r"lost again and again.*the same command resumes"):
        fetched(asked.remote())


def test_what_is_wrong_with_an_input_is_told_as_such(
    runner: RayRunner, fits: list[Fit], tmp_path: Path
) -> None:
    """The last one: it ends actors that others would have to start again."""
    spare = max(len(runner._idle) - len(fits), 0)
    (tmp_path / "few.npz").write_bytes(b"torn")
    with pytest.raises(InputError, match=r"few\.npz: not a checkpoint"):
        runner.run(fits, tmp_path, lambda _: None)
    deadline = time.monotonic() + 20
    while len(workers_named("ray::FitActor")) > spare:  # those of the other fits are gone too
        assert time.monotonic() < deadline
        time.sleep(0.1)
