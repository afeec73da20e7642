"""What the report of pre-sysID shows of joints and recordings, and how well they fit."""

from pathlib import Path

import numpy as np
import pytest

from pup.physics.parameters import robot_space
from pup.physics.simulator import Trajectories, tick_slices
from pup.robot import RobotDescription
from pup.sysid.accuracy import JointUnits, accuracy
from pup.sysid.figures import drawing_style
from pup.sysid.loss import LOST_POSITION, ReplayLoss
from pup.sysid.overlays import Overlays, Panel, _small, by_motion, write_overlays
from pup.sysid.report import write_report
from pup.sysid.result import Bounds
from tests.reports import (
    BOUNDS,
    DARWIN,
    RECORDINGS,
    ROLL,
    TICKS,
    Page,
    make_recording,
    make_replay,
    tilt,
)


def test_gaps_and_broken_simulations(tmp_path: Path) -> None:
    position = np.zeros((TICKS, len(DARWIN.joints)))
    position[4:, 3] = np.nan
    target = np.ones_like(position)
    target[1::2] = np.nan
    roll = {"imu/roll": np.zeros(TICKS)}
    recordings = (
        make_recording(DARWIN, "a", position=position, target=target),
        make_recording(DARWIN, "b", support="ground", extras=roll),
    )
    loss = ReplayLoss(DARWIN, recordings)
    replay = make_replay(loss, DARWIN, 0.01)
    replay.position[0, 6:TICKS] = np.nan
    measures = accuracy(loss, replay)
    assert measures.diverged.tolist() == [True, False]
    assert measures.cells[0, 3] == pytest.approx(0.01)
    expected = np.sqrt((6 * 0.01**2 + 6 * LOST_POSITION**2) / 12)
    assert measures.cells[0, 4] == pytest.approx(expected)
    np.testing.assert_allclose(measures.tilt, [[np.nan, np.nan], [0.01, np.nan]])
    write_report(tmp_path / "r.html", BOUNDS, DARWIN, recordings, {"NN-PD": replay}, loss)
    page = Page(tmp_path / "r.html")
    assert page.table("Recording")[1][1].endswith("(broke down)")
    assert "torso roll in b" in page.text and "torso pitch" not in page.text
    assert len(write_overlays(tmp_path / "plots", DARWIN, recordings, replay, loss)) == 2


def test_accuracy_weighs_every_recording_the_same() -> None:
    long = make_recording(DARWIN, "a", support="ground", extras=tilt(0.0) | {"imu/roll": ROLL})
    short = make_recording(
        DARWIN, "b", time=long.time[:3], target=long.target[:3], position=long.position[:3]
    )
    loss = ReplayLoss(DARWIN, (long, short))
    position = loss.position[None].copy()
    position[:, loss.ticks[1]] += 0.1
    shape = position.shape[:2]
    ticks = tick_slices((long, short))
    replay = Trajectories(ticks, position, np.full((*shape, 2), -3.1), np.zeros((*shape, 2, 3)))
    measures = accuracy(loss, replay)
    assert measures.total == pytest.approx(0.1 / np.sqrt(2))
    np.testing.assert_allclose(measures.per_recording, [0, 0.1], atol=1e-12)
    np.testing.assert_allclose(measures.per_joint, 0.1 / np.sqrt(2))
    around = 2 * np.pi - 6.2  # from 3.1 to -3.1 rad
    np.testing.assert_allclose(measures.tilt, [[around, 3.1], [np.nan, np.nan]])


def test_joints_told_to_stay_are_shown_only_as_the_worst() -> None:
    recordings = (make_recording(DARWIN, "a"), make_recording(DARWIN, "b"))
    loss = ReplayLoss(DARWIN, recordings)
    still = len(DARWIN.joints) - 1

    def shown(off: float) -> list[tuple[str, str]]:
        replay = make_replay(loss, DARWIN, 0.01)
        replay.position[..., still] = loss.position[:, still] + off
        measures = {"x": accuracy(loss, replay)}
        units = JointUnits.of(DARWIN, recordings)
        overlays = Overlays(DARWIN, loss, {"x": replay}, measures, units)
        return [(p.rank, p.signal) for p in overlays.joint_panels([0, 1], "x")]

    names = DARWIN.joint_names
    calm, wild = shown(0.0), shown(0.5)
    assert calm[0] == ("worst", names[0]) and calm[-1] == ("best", names[1])
    assert wild[0] == ("worst", names[still]) and wild[-1] == ("best", names[1])


def test_the_only_joint_is_shown_in_several_recordings() -> None:
    robot = RobotDescription.load("servo_bench")
    recordings = tuple(make_recording(robot, name, support="bench") for name in "abcd")
    loss = ReplayLoss(robot, recordings)
    replay = make_replay(loss, robot, 0.0)
    for part, off in zip(loss.ticks, (0.03, 0.01, 0.04, 0.02), strict=True):
        replay.position[:, part] += off
    measures = {"x": accuracy(loss, replay)}
    overlays = Overlays(robot, loss, {"x": replay}, measures, JointUnits.of(robot, recordings))
    panels = overlays.joint_panels(range(4), "x")
    shown = [(panel.rank, panel.recording.id) for panel in panels]
    assert shown == [("worst", "c"), ("median", "d"), ("best", "b")]


@pytest.mark.parametrize(
    ("unit", "end", "low", "high"),
    [
        ("rad", 12.1, -1.5708, -1.5608),  # a joint that hardly moves, and a chirp's end
        ("m", 17.6, -0.005, 0.005),
        ("rad or m", 1.02, -0.1, 0.11),
        ("rad", 100.4, -3.1, 3.1),
    ],
)
def test_what_stands_at_a_panels_axes_is_inside_it(
    unit: str, end: float, low: float, high: float
) -> None:
    time, values = np.linspace(0, end, 50), np.linspace(low, high, 50)
    panel = Panel("", RECORDINGS[0], "knee", time, values, values, {"PD": values}, {"PD": 0.0})
    with drawing_style():
        figure = _small(panel, ["PD"], max(high - low, 0.01), unit)
        figure.canvas.draw()
        box, (width, height) = figure.get_tightbbox(), figure.get_size_inches()
    assert box.x0 >= 0 and box.x1 <= width
    assert box.y0 >= 0 and box.y1 <= height


def test_recordings_are_grouped_by_motion_and_step() -> None:
    small = make_recording(DARWIN, "a").target / 3
    recordings = [
        make_recording(DARWIN, "a"),
        make_recording(DARWIN, "b", target=small),
        make_recording(DARWIN, "c", motion="walk", support="ground"),
        make_recording(DARWIN, "d", target=np.ones_like(small)),
    ]
    assert by_motion(recordings, "rad") == {
        "step, suspended (1 recording)": [3],
        "step of up to 0.1 rad, suspended (1 recording)": [1],
        "step of up to 0.3 rad, suspended (1 recording)": [0],
        "walk, ground (1 recording)": [2],
    }


def test_sliding_joints_are_told_in_millimetres(tmp_path: Path) -> None:
    robot = RobotDescription.load("emps")
    recordings = (make_recording(robot, "a", support="bench"),)
    units = JointUnits.of(robot, recordings)
    assert units.words(0.0123) == "12.3 mm"
    space = robot_space(robot, "pd")
    count = len(space)
    bounds = Bounds(
        robot=robot.name,
        actuator="pd",
        space=space,
        nominal=space.nominal,
        lower=space.lower,
        upper=space.upper,
        ci90=np.stack([space.lower, space.upper], axis=1),
        identified=np.ones(count, dtype=bool),
        correlation=np.eye(count),
        weights=np.empty(0),
        imu=space.select(()),
        train={"loss": 1.0, "rmse": 0.0123},
        held_out=None,
        subsets=(),
        splits=(),
        histories={"pd": np.array([3.0])},
        omitted=(),
    )
    loss = ReplayLoss(robot, recordings)
    position = loss.position[None] + 0.01
    empty = np.full((1, TICKS, 2), np.nan)
    replay = Trajectories(loss.ticks, position, empty, np.empty((1, TICKS, 0, 3)))
    write_report(tmp_path / "r.html", bounds, robot, recordings, {"PD": replay}, loss)
    page = Page(tmp_path / "r.html")
    assert "12.3 mm" in page.text and "mrad" not in page.text and "°" not in page.text


def test_overlays_are_one_picture_per_recording(tmp_path: Path) -> None:
    loss = ReplayLoss(DARWIN, RECORDINGS)
    replay = make_replay(loss, DARWIN, 0.01)
    paths = write_overlays(tmp_path, DARWIN, RECORDINGS, replay, loss)
    assert [path.name for path in paths] == ["a.png", "b.png", "c.png"]
    assert all(path.read_bytes().startswith(b"\x89PNG\r\n\x1a\n") for path in paths)
    assert sorted(tmp_path.iterdir()) == sorted(paths)
    again = write_overlays(tmp_path / "again", DARWIN, RECORDINGS, replay, loss)
    assert [path.read_bytes() for path in again] == [path.read_bytes() for path in paths]
