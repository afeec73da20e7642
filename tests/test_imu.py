"""An IMU that sits askew and tells late: found beside the model, which stays what it is."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import reports

from pup.physics.parameters import robot_space
from pup.recording import Recording
from pup.robot import RobotDescription, TermSpec
from pup.robot_writer import write_corrected
from pup.sysid import wording
from pup.sysid.excitation import script
from pup.sysid.imu import imu_names, with_imu
from pup.sysid.problem import Problem
from pup.sysid.result import read_fitted
from pup.sysid.uncertainty import spread_at
from pup.sysid.virtual import record_virtual
from services.presysid import _Job
from services.presysid_options import Options
from workers.fits import LocalRunner

DARWIN = RobotDescription.load("darwin_op2")
MOUNT = {"roll": 0.02, "pitch": -0.05, "yaw": 0.04}
LATE = 0.02
COM = 0.01


def askew(folder: Path) -> RobotDescription:
    terms = (
        TermSpec("imu_misalignment", "sensor", "", MOUNT),
        TermSpec("imu_delay", "sensor", "", {"time": LATE}),
    )
    return write_corrected(DARWIN, folder, {}, terms)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> tuple[Recording, ...]:
    """Two falls and a step of a robot whose torso is heavier in front than described."""
    rng = np.random.default_rng(0)
    motions = script(DARWIN, ("fall:forward", "fall:left", "step:0.3"), rng)
    robot = askew(tmp_path_factory.mktemp("askew") / "robot")
    return record_virtual(robot, motions, "pd", {"torso_com/x": COM}, rng)


def identified(recordings: tuple[Recording, ...], folder: Path, imu: bool) -> dict[str, float]:
    """What is fitted beside what a diagnosis of steps has fitted, and equation 1."""
    options = replace(Options(generations=10, actuator="pd").corrected(("step",)), imu=imu)
    job = _Job(DARWIN, recordings, options, folder, LocalRunner(), lambda *_: None, 1)
    problem = job.full["pd"]
    found = job._kept(problem)
    told = dict(zip(problem.space.names, problem.values(found.best[None])[0], strict=True))
    return {n: told[n] for n in problem.free if n not in job.kept} | {"loss": found.loss}


def test_it_is_found_and_the_centre_of_mass_with_it(
    recordings: tuple[Recording, ...], tmp_path: Path
) -> None:
    without = identified(recordings, tmp_path / "without", imu=False)
    beside = identified(recordings, tmp_path / "beside", imu=True)
    assert not any("imu" in name for name in without)
    for axis, angle in MOUNT.items():
        assert beside[f"imu_misalignment/{axis}@sensor"] == pytest.approx(angle, abs=0.01)
    assert beside["imu_delay/time@sensor"] == pytest.approx(LATE, abs=0.004)
    assert abs(beside["torso_com/x"] - COM) < 0.003
    assert abs(beside["torso_com/x"] - COM) < abs(without["torso_com/x"] - COM)
    assert beside["loss"] < 0.5 * without["loss"]


def test_replays_know_how_it_sits(recordings: tuple[Recording, ...], tmp_path: Path) -> None:
    """What is fitted beside it is of a robot whose IMU sits so, whoever reads the bounds."""
    options = Options(generations=1, subsets=2, subset_generations=1, actuator="pd")
    short = tuple(replace_ticks(one, 12) for one in recordings)
    job = _Job(
        DARWIN, short, options.corrected(("step",)), tmp_path, LocalRunner(), lambda *_: None, 1
    )
    bounds = job.run()
    assert len(bounds.imu) == 4 and bounds.imu.nominal.any()
    kind, space = read_fitted(tmp_path / "bounds.json", DARWIN)
    read = Problem(DARWIN, short, kind, space, ())
    assert read.losses(np.empty((1, 0)))[0] == pytest.approx(bounds.train["loss"])
    # How it sits is not known, and so is not what hangs on it.
    alone = replace(job.full["pd"], space=space, free=("torso_com/x",))
    known = spread_at(alone, alone.free_space.normalise(alone.free_space.nominal)).confidence(0.9)
    at = bounds.space.names.index("torso_com/x")
    assert np.diff(bounds.ci90[at]) > known.upper - known.lower


def replace_ticks(recording: Recording, ticks: int) -> Recording:
    """Its beginning."""
    return replace(
        recording,
        time=recording.time[:ticks],
        target=recording.target[:ticks],
        position=recording.position[:ticks],
        extras={name: values[:ticks] for name, values in recording.extras.items()},
    )


def test_in_the_air_there_is_nothing_to_find(
    recordings: tuple[Recording, ...], tmp_path: Path
) -> None:
    hung = tuple(r for r in recordings if r.support == "suspended")
    assert not any("imu" in name for name in identified(hung, tmp_path, imu=True))


def test_what_a_diagnosis_has_found_of_it_is_not_fitted_again(tmp_path: Path) -> None:
    space = robot_space(askew(tmp_path), "pd")
    assert with_imu(space).names == space.names and len(imu_names(space)) == 4
    plain = robot_space(DARWIN, "pd")
    assert imu_names(plain) == () and imu_names(with_imu(plain)) == imu_names(space)


def test_the_report_says_how_it_sits(tmp_path: Path) -> None:
    recordings = (reports.make_recording(DARWIN, "a"),)
    bounds = reports.make_bounds(DARWIN, recordings)
    space = with_imu(robot_space(DARWIN, "pd"))
    told = space.at({"imu_misalignment/pitch@sensor": -0.0437, "imu_delay/time@sensor": 0.0146})
    bounds = replace(bounds, imu=told.select(imu_names(space)))
    assert {p["name"]: p["nominal"] for p in bounds.document()["imu"]} == dict(
        zip(bounds.imu.names, bounds.imu.nominal, strict=True)
    )
    words = wording.imu_words(bounds)
    assert "imu misalignment in pitch -43.7 mrad" in words
    assert words.endswith("imu delay in time 14.6 ms")
    assert (
        f"Fitted beside, of the IMU: {words}."
        in reports.report(tmp_path, bounds, DARWIN, recordings).text
    )
