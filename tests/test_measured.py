"""What is taken from recordings, however they were written: columns, commands, turns, rates."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pup.diagnosis.falls import DOWN, TOPPLES, standing
from pup.diagnosis.hypotheses import hypotheses
from pup.diagnosis.noise import noise_floor, quiet_noise
from pup.diagnosis.replays import Bench, Replays, threads, union
from pup.diagnosis.residuals import FLAT, TILTS, Measured
from pup.physics.parameters import robot_space
from pup.physics.terms import Place, column
from pup.recording import Recording, load_recordings
from pup.robot import RobotDescription, TermSpec
from tests.diagnosis_cases import BENCH, recordings

OP2 = RobotDescription.load("darwin_op2")
KNOCKED = ("standup_2", "standup_1.75")


@pytest.fixture(scope="module")
def shipped() -> dict[str, Recording]:
    folder = Path(str(OP2.folder)) / "recordings"
    return {r.id: r for r in load_recordings([folder], OP2)}


def errors(runs: list[Recording]) -> np.ndarray:
    """Of the robot as it is described."""
    measured = Measured.of(OP2, runs)
    space = robot_space(OP2, "pd")
    row = dict(zip(space.names, space.nominal, strict=True))
    return Replays(measured, space, threads(Bench(measured), 1), 1).errors(row)


def test_columns_may_stand_in_any_order(shipped: dict[str, Recording]) -> None:
    runs = [shipped[name] for name in KNOCKED if name in shipped]
    turned = [
        replace(r, joints=r.joints[::-1], target=r.target[:, ::-1], position=r.position[:, ::-1])
        for r in runs
    ]
    one, other = Measured.of(OP2, runs), Measured.of(OP2, turned)
    assert len(runs) and np.array_equal(one.values, other.values)
    assert np.array_equal(one.time, other.time)


def test_a_turn_more_or_less_of_the_torso_is_the_same(shipped: dict[str, Recording]) -> None:
    """Fusion that unwraps its angles tells of a robot that fell by another turn."""
    run = shipped["fall_left"]
    around = {**run.extras, "imu/roll": run.extras["imu/roll"] + 2 * np.pi}
    np.testing.assert_allclose(errors([replace(run, extras=around)]), errors([run]), atol=1e-3)


def test_who_lies_on_its_face_tells_no_roll(shipped: dict[str, Recording]) -> None:
    run = shipped["fall_left"]
    ticks = len(run.time)
    pitch = np.where(np.arange(ticks) < ticks // 2, FLAT + 0.1, 0.0)
    level = {**run.extras, "imu/roll": np.zeros(ticks), "imu/pitch": pitch}
    lying = Measured.of(OP2, [replace(run, extras=level)])
    half = run.time[ticks // 2] - run.time[0]
    roll, tilt = len(OP2.joints), len(OP2.joints) + 1
    assert lying.time[lying.channel == roll].min() >= half
    assert lying.time[lying.channel == tilt].min() < half


def test_what_follows_a_fall_tells_nothing(shipped: dict[str, Recording]) -> None:
    """Where it comes to lie, a hair of a difference decides."""
    run = shipped["fall_left"]
    lean = np.maximum(*(np.abs(run.extras[f"imu/{a}"]) for a in TILTS))
    assert lean[0] < TOPPLES and lean.max() > DOWN
    (cut,) = Measured.of(OP2, [run]).recordings
    assert cut.id == run.id and 2 < len(cut.time) < len(run.time)
    assert lean[: len(cut.time)].max() < TOPPLES <= lean[len(cut.time)]
    leans = replace(run, extras={**run.extras, "imu/roll": 0.9 * run.extras["imu/roll"] / lean})
    lies = {f"imu/{a}": np.full(len(run.time), v) for a, v in zip(TILTS, (0.1, 1.5), strict=True)}
    hangs = replace(run, support="suspended")
    for other in (shipped["standup_2"], leans, replace(run, extras=lies), hangs):
        assert standing(other) is other


def test_commands_that_stand_only_where_they_change_are_the_same_commands() -> None:
    runs = recordings({})
    sparse = []
    for run in runs:
        target = run.target.copy()
        target[1:][np.diff(run.target, axis=0) == 0] = np.nan
        sparse.append(replace(run, target=target))
    whole, told = Measured.of(BENCH, runs), Measured.of(BENCH, sparse)
    for one, other in zip(whole.recordings, told.recordings, strict=True):
        assert np.array_equal(one.target, other.target)
        assert np.array_equal(one.position, other.position)
    off = 0.002 * np.random.default_rng(0).normal(size=len(whole.values))
    assert quiet_noise(told, off).sigma[0] == quiet_noise(whole, off).sigma[0]


@pytest.mark.parametrize("rate", [12.0, 20.0, 33.0, 100.0])
def test_speeds_are_told_at_any_rate(rate: float) -> None:
    time = np.arange(0.0, 6.0, 1 / rate)
    position = 2.0 * time[:, None] - 6.0
    run = replace(recordings({})[0], time=time, target=position, position=position)
    assert Measured.of(BENCH, [run]).speed == pytest.approx(2.0, rel=1e-6)


@pytest.mark.parametrize("motion", [1.0, 0.0])
def test_noise_is_not_told_too_small_where_no_command_rests(motion: float) -> None:
    """The quieter half of all bends is less than noise by a known factor."""
    rng = np.random.default_rng(4)
    time = np.arange(0.0, 40.0, 0.03)
    target = np.sin(time)[:, None]
    run = replace(recordings({})[0], time=time, target=target, position=target)
    measured = Measured.of(BENCH, [run])
    smooth = 0.01 * motion * np.sin(1.3 * measured.time)
    off = smooth + 0.002 * rng.normal(size=len(measured.values))
    assert noise_floor(measured, off).sigma[0] == pytest.approx(0.002, rel=0.12)


RUBBED = replace(BENCH, terms=(TermSpec("coulomb_friction", "joint", "servo", {"torque": 0.08}),))


def test_what_a_robot_has_already_is_not_looked_for() -> None:
    """A corrected robot is diagnosed again: its own friction would be overwritten by a trial's."""
    told = {h.key for h in hypotheses(Measured.of(RUBBED, recordings({})))}
    place = Place("joint", "servo")
    assert ("coulomb_friction", place) not in told
    assert ("stribeck_friction", place) in told


def test_a_robots_own_terms_stand_by_their_places_among_those_tried() -> None:
    """The narrower place has the say where shapes differ, so it comes last."""
    own = OP2.joint_names[0]
    robot = replace(OP2, terms=(TermSpec("cogging", "joint", own, {"sine": 0.1}),))
    space = robot_space(robot, "pd")
    group = Place("group", OP2.groups[0])
    both = union(space, [{column("cogging", "sine", group): 0.2}])
    mine, wide = (
        both.names.index(column("cogging", "sine", place)) for place in (Place("joint", own), group)
    )
    assert wide < mine
    assert both.nominal[mine] == 0.1
