"""What a fit evaluates: whatever is at once in memory, and by the physics of its number."""

import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from biped import biped
from numpy.typing import NDArray
from recordings import make
from terms import BENCH, SERVO
from test_simulator import recording

from pup.errors import InputError
from pup.physics.parameters import robot_space
from pup.physics.simulator import Trajectories
from pup.recording import Recording
from pup.robot import RobotDescription, TermSpec
from pup.sysid import problem as problems
from pup.sysid.problem import MODEL, Problem

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def walker(tmp_path_factory: pytest.TempPathFactory) -> RobotDescription:
    return biped(tmp_path_factory.mktemp("biped"))


def swing(robot: RobotDescription, ticks: int, support: str, rate: float = 30.0) -> Recording:
    """Both legs swing one against the other; the readings lag behind."""
    time = np.arange(ticks) / rate
    target = 0.15 * np.sin(6 * time)[:, None] * [1, -1]
    return make(
        id=support,
        robot=robot.name,
        motion="stand" if support == "ground" else "step",
        support=support,
        joints=robot.joint_names,
        time=time,
        target=target,
        position=0.8 * target,
        extras={"imu/roll": np.zeros(ticks), "imu/pitch": 0.02 * np.sin(5 * time)},
    )


def of_walker(robot: RobotDescription, ticks: int) -> Problem:
    runs = swing(robot, ticks, "suspended"), swing(robot, ticks // 2, "ground")
    space = robot_space(robot, "pd")
    return Problem(robot, runs, "pd", space, space.names)


def test_losses_do_not_depend_on_how_many_are_in_memory(
    walker: RobotDescription, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = of_walker(walker, 12)
    units = np.random.default_rng(0).uniform(size=(7, len(problem.free)))
    whole = problem.losses(units)
    for memory, at_once in ((1, 1), (20_000, 3)):
        monkeypatch.setattr(problems, "MEMORY", memory)
        part = of_walker(walker, 12)
        assert part.at_once == at_once
        assert np.array_equal(part.losses(units), whole)


def test_errors_do_not_depend_on_how_many_are_in_memory(
    walker: RobotDescription, monkeypatch: pytest.MonkeyPatch
) -> None:
    units = np.random.default_rng(0).uniform(size=(7, 5))
    whole = of_walker(walker, 12).errors(units)
    replay, asked = Problem.replay, []

    def counted(problem: Problem, unit: Array) -> Trajectories:
        asked.append(len(unit))
        return replay(problem, unit)

    monkeypatch.setattr(problems, "MEMORY", 20_000)
    monkeypatch.setattr(Problem, "replay", counted)
    for told, expected in zip(of_walker(walker, 12).errors(units), whole, strict=True):
        assert np.array_equal(told, expected)
    assert asked == [3, 2, 2]


def test_recordings_whose_slopes_do_not_fit_are_refused(
    walker: RobotDescription, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By as many numbers as there are: two joints, roll and pitch, and two feet."""
    problem = of_walker(walker, 12)
    errors, _ = problem.errors(np.full((5, 5), 0.5))
    assert errors.shape[1] == 18 * problem.loss.numbers
    monkeypatch.setattr(problems, "memory", lambda: 3 * errors.nbytes)
    problem.check()
    monkeypatch.setattr(problems, "memory", lambda: 3 * errors.nbytes - 1)
    with pytest.raises(InputError, match="18 samples of 10 errors, by 5 parameters, take") as told:
        problem.check()
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("rows", [2, 3, 5])
def test_recordings_that_end_where_they_begin_are_refused(
    walker: RobotDescription, rows: int
) -> None:
    """The first row tells where one starts: five more tell something of a motion."""
    long, short = swing(walker, 6, "suspended"), swing(walker, rows, "ground")
    enough = replace(of_walker(walker, 12), recordings=(long, short))
    enough.check()
    with pytest.raises(InputError, match=f"positions in more than {rows - 1} rows") as told:
        replace(enough, recordings=(short,)).check()
    assert "\n" not in str(told.value)


def test_readings_that_are_missing_tell_nothing(walker: RobotDescription) -> None:
    problem = of_walker(walker, 12)
    position = problem.recordings[0].position.copy()
    position[2:] = np.nan
    blind = replace(problem, recordings=(replace(problem.recordings[0], position=position),))
    with pytest.raises(InputError, match="positions in more than 1 rows"):
        blind.check()


def test_fewer_readings_than_parameters_are_refused() -> None:
    """Of a servo with the network's 27 weights beside its own parameters."""
    bench = RobotDescription.load("servo_bench")
    space = robot_space(bench, "nn_pd")

    def of_rows(rows: int) -> Problem:
        run = make(
            robot=bench.name,
            joints=bench.joint_names,
            time=np.arange(rows) / 50,
            target=np.zeros((rows, 1)),
            position=np.zeros((rows, 1)),
        )
        return Problem(bench, (run,), "nn_pd", space, space.names)

    free = len(space.names)
    of_rows(free + 1).check()
    with pytest.raises(InputError, match=f"{free - 1} readings cannot tell {free} parameters"):
        of_rows(free).check()


def test_more_candidates_take_no_more_memory(
    walker: RobotDescription, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside what a batch of simulations takes, which is bounded."""
    monkeypatch.setattr(problems, "MEMORY", 2**20)
    problem = of_walker(walker, 300)
    assert problem.at_once < 20

    def peak(candidates: int) -> int:
        tracemalloc.start()
        try:
            problem.losses(np.full((candidates, len(problem.free)), 0.5))
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    few = peak(problem.at_once)
    assert peak(8 * problem.at_once) < 1.2 * few


def on_bench(rate: float = 30.0, effect: str = "", **values: float) -> Problem:
    """A servo that swings its load, with a term more in its description or none.

    Its torque comes on late, and its commands at a rate.
    """
    time = np.arange(1.3 * rate) / rate
    run = recording(BENCH, time, 0.4 * np.sin(9 * time), start=0.1)
    told = 0.1 + 0.3 * np.sin(9 * time - 0.2)
    extras = {"torque_enabled": (time > 0.1).astype(float)}
    terms = (TermSpec(effect, "joint", "servo", values),) if effect else ()
    run = replace(run, position=told[:, None], extras=extras)
    robot = replace(BENCH, terms=terms)
    return Problem(robot, (run,), "pd", robot_space(robot, "pd").at(SERVO), ())


def on_the_floor(folder: Path) -> Problem:
    robot = biped(folder)
    return Problem(robot, (swing(robot, 12, "ground"),), "pd", robot_space(robot, "pd"), ())


GOLDEN = {
    "friction": 4.328640682734563,
    "backlash": 4.481468099997181,
    "integral": 4.918543562049556,
    "dense": 119.23739005876668,
    "floor": 2.550702730232274,
}
"""Equation 1 by the physics that MODEL numbers."""


def test_the_physics_are_those_of_their_number(tmp_path: Path) -> None:
    """Fits, diagnoses and stages of a job are kept by it: it is raised with what they stand on."""
    cases = {
        "friction": on_bench(effect="coulomb_friction", torque=0.08),
        "backlash": on_bench(effect="backlash", gap=0.03, behind=1.0),
        "integral": on_bench(effect="integral_action", gain=15.0, share=0.3),
        "dense": on_bench(rate=900.0),
        "floor": on_the_floor(tmp_path),
    }
    losses = {name: float(case.losses(np.empty((1, 0)))[0]) for name, case in cases.items()}
    assert (MODEL, losses) == (13, pytest.approx(GOLDEN, rel=1e-6)), (
        "the physics or the loss has changed: raise MODEL (pup/sysid/problem.py), and put its "
        f"number and {losses} here; where MuJoCo is another one, the losses alone"
    )
