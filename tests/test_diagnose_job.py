"""`pup diagnose` as users run it: on Ray the same as without, killed and gone on with the same."""

import json
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blind_sets import FRICTION, motions, poor, shortened
from commandline import pup
from diagnosis_cases import BENCH, recordings
from jobs import Job
from numpy.typing import NDArray

from pup.diagnosis.replays import Batch, Bench, Replays, Runner, threads
from pup.diagnosis.residuals import Measured
from pup.errors import InputError
from pup.physics.parameters import robot_space
from pup.recording import write_recordings
from pup.recording_cuts import beginning
from pup.robot import RobotDescription
from pup.robot_writer import write_corrected
from services.diagnosis import Where, alone, keeper, run_diagnosis
from services.stopwatch import Stopwatch

STOPPED = "pup diagnose: stopped; the same command resumes\n"
RAY = ("--cores", 2)
DIAGNOSE = ("--robot", "servo_bench", "--effects", 1)
KEPT = "checkpoints/*.f32"
TIMES = ("seconds", "processor_seconds", "corrected_robot")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recordings of a servo with friction."""
    folder = tmp_path_factory.mktemp("runs")
    write_recordings(motions(FRICTION)[0], folder)
    return folder


def diagnose(runs: Path, out: Path, *where: object) -> Job:
    return Job("diagnose", runs, *DIAGNOSE, *where, out=out)


def told(out: Path) -> Any:
    """What was found, but for the time it took and the place it is at."""
    document = json.loads((out / "diagnosis.json").read_text())
    return {name: value for name, value in document.items() if name not in TIMES}


@pytest.fixture(scope="module")
def wanted(runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What an undisturbed run leaves, in one process."""
    out = tmp_path_factory.mktemp("undisturbed")
    done = pup("diagnose", runs, *DIAGNOSE, "--local", "--cores", 1, "--out", out)
    assert done.code == 0, done.err
    lines = done.err.splitlines()
    assert any(x.startswith("refits, ") and " at joint:servo found: 5" in x for x in lines)
    return out


def corrected(out: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in (out / "corrected").iterdir()}


def assert_same(out: Path, wanted: Path) -> None:
    assert told(out) == told(wanted)
    assert corrected(out) == corrected(wanted)
    assert not (out / "checkpoints").exists()
    assert (out / "report.html").exists()


def test_it_tells_how_long_it_took(wanted: Path) -> None:
    document = json.loads((wanted / "diagnosis.json").read_text())
    assert document["verdict"] == "mismatch"
    assert 0 < document["processor_seconds"] < 1.5 * document["seconds"]
    assert not (wanted / "checkpoints").exists()


def test_killed_again_and_again(runs: Path, tmp_path: Path, wanted: Path) -> None:
    for kept in (3, 30):
        job = diagnose(runs, tmp_path, "--local", "--cores", 1)
        job.come_to(KEPT, kept)
        job.process.kill()
        assert job.end()[0] == -signal.SIGKILL
        assert not (tmp_path / "diagnosis.json").exists()
    spent = Stopwatch(tmp_path / "checkpoints" / "spent.json", "of another job")
    assert spent.before == (0.0, 0.0)
    before = json.loads(spent.file.read_text())["spent"]
    (tmp_path / "checkpoints" / ".half.f32.written").touch()  # what a kill may leave
    code, _, err = diagnose(runs, tmp_path, "--local", "--cores", 1).end()
    assert code == 0, err
    assert_same(tmp_path, wanted)
    assert json.loads((tmp_path / "diagnosis.json").read_text())["seconds"] > before[0] > 0


@pytest.mark.ray
def test_on_ray_it_is_the_same(runs: Path, tmp_path: Path, wanted: Path) -> None:
    job = diagnose(runs, tmp_path, *RAY)
    job.come_to("ray")
    code, out, err = job.end()
    assert code == 0, err
    job.assert_nothing_left()
    document = json.loads(out)
    assert document == json.loads((tmp_path / "diagnosis.json").read_text())
    assert "processor_seconds" not in document  # the driver's says nothing
    assert_same(tmp_path, wanted)


@pytest.mark.ray
@pytest.mark.slow
def test_killed_on_ray_and_stopped(runs: Path, tmp_path: Path, wanted: Path) -> None:
    job = diagnose(runs, tmp_path, *RAY)
    job.come_to(KEPT, 5)
    job.process.kill()
    assert job.end()[0] == -signal.SIGKILL
    job.assert_nothing_left()
    job = diagnose(runs, tmp_path, *RAY)
    job.come_to(KEPT, 20)
    job.process.terminate()
    code, out, err = job.end()
    assert (code, out) == (130, "") and err.endswith(STOPPED)
    job.assert_nothing_left()
    code, _, err = diagnose(runs, tmp_path, *RAY).end()
    assert code == 0, err
    assert_same(tmp_path, wanted)


def test_checkpoints_of_another_job_are_left(tmp_path: Path) -> None:
    """`pup presysid` may keep its own in the same folder."""
    kept = tmp_path / "checkpoints"
    kept.mkdir()
    (kept / "nominal.npz").touch()
    run_diagnosis(BENCH, poor(1), tmp_path, alone(1), lambda stage, share: None, report=False)
    assert [file.name for file in kept.iterdir()] == ["nominal.npz"]


def test_a_corrected_robot_is_not_diagnosed_into_its_own_folder(tmp_path: Path) -> None:
    """This is said before anything is simulated."""
    robot = write_corrected(BENCH, tmp_path / "corrected", {}, [])
    nowhere = Where(lambda measured, actuator: pytest.fail("simulated"), 1, here=True)
    with pytest.raises(InputError, match=r"corrected: is the folder of 'servo_bench' itself"):
        run_diagnosis(robot, recordings({}, 1), tmp_path, nowhere, lambda stage, share: None)


def test_a_file_in_place_of_the_corrected_robot_is_told_first(tmp_path: Path) -> None:
    """This, too, and not after hours of fits."""
    (tmp_path / "corrected").write_text("mine")
    nowhere = Where(lambda measured, actuator: pytest.fail("simulated"), 1, here=True)
    with pytest.raises(InputError, match=r"corrected: a file is in the place of this folder"):
        run_diagnosis(BENCH, recordings({}, 1), tmp_path, nowhere, lambda stage, share: None)
    assert (tmp_path / "corrected").read_text() == "mine"


def test_planned_recordings_do_not_take_answers_of_those_measured(tmp_path: Path) -> None:
    """Two sets of recordings under the same parameters are two questions."""
    asked: list[int] = []

    def runner(measured: Measured, actuator: str) -> Runner:
        def run(batches: Sequence[Batch]) -> list[NDArray[np.float64]]:
            asked.append(len(batches))
            return threads(Bench(measured, actuator), 1)(batches)

        return run

    kept = keeper(Where(runner, 1, here=True), tmp_path)
    answers = []
    for runs in (poor(1), poor(2), poor(1)):
        measured = Measured.of(BENCH, runs)
        replays = Replays(measured, robot_space(BENCH, "pd"), kept(measured), 1)
        answers.append(replays([{"kp/servo": 3.0}])[0])
    assert asked == [1, 1, 0]
    assert np.array_equal(answers[0], answers[2])
    assert not np.array_equal(answers[0], answers[1])


def test_the_beginnings_of_recordings_can_be_taken_alone(tmp_path: Path) -> None:
    """`--seconds`: the page says of what it is."""
    two = [shortened(recordings({}, 1)[number], 40) for number in (0, 2)]
    write_recordings(two, tmp_path / "runs")
    where = ("--local", "--seconds", 1, "--out", tmp_path / "out")
    done = pup("diagnose", tmp_path / "runs", *DIAGNOSE, *where)
    assert done.code == 0, done.err
    page = (tmp_path / "out" / "report.html").read_text()
    for recording in two:
        cut = beginning(recording, 1.0)
        assert cut.time[-1] - cut.time[0] < 1.0 < recording.time[-1] - recording.time[0]
        assert cut.digest in page and recording.digest not in page


def test_what_tells_nothing_corrects_nothing(tmp_path: Path) -> None:
    """The robot is written as it was: a fit that says nothing is no better."""
    write_recordings(recordings({}, 1)[:1], tmp_path / "runs")
    done = pup("diagnose", tmp_path / "runs", *DIAGNOSE, "--local", "--out", tmp_path / "out")
    assert done.code == 0, done.err
    folder = tmp_path / "out" / "corrected"
    assert json.loads((tmp_path / "out" / "diagnosis.json").read_text())["verdict"] == (
        "undetermined"
    )
    assert (folder / "robot.toml").read_text().startswith("# As described")
    assert RobotDescription.load(str(folder)).parameters == BENCH.parameters
