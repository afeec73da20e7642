"""Reports of pre-sysID taken apart, and what they are made from."""

from collections.abc import Mapping
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np

from pup.physics.parameters import NETWORK_NAMES, robot_space
from pup.physics.simulator import Trajectories
from pup.recording import Recording
from pup.robot import RobotDescription
from pup.sysid.bounds import Split
from pup.sysid.loss import ReplayLoss
from pup.sysid.report import write_report
from pup.sysid.result import Bounds, SubsetFit

VOID = {"img", "meta"}
TICKS = 12
ROLL = np.full(TICKS, 3.1)


class Page(HTMLParser):
    """A page taken apart: elements with their attributes, tables as rows of cells, text."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.tables: list[list[list[str]]] = []
        self.row_classes: list[list[str]] = []
        self.text = ""
        self.open: list[str] = []
        self.source = path.read_text(encoding="utf-8")
        self.feed(self.source)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {key: value or "" for key, value in attrs}
        self.elements.append((tag, given))
        if tag not in VOID:
            self.open.append(tag)
        if tag == "table":
            self.tables.append([])
            self.row_classes.append([])
        elif tag == "tr":
            self.tables[-1].append([])
            self.row_classes[-1].append(given.get("class", ""))
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" in self.open:
            return
        self.text += data
        if "td" in self.open or "th" in self.open:
            self.tables[-1][-1][-1] += data

    def all(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.elements if name == tag]

    def table(self, heading: str) -> list[list[str]]:
        return next(t for t in self.tables if t[0][0] == heading)


def make_recording(robot: RobotDescription, name: str, **changes: Any) -> Recording:
    """Steps of 0.3 rad on every joint but the last of several, followed late."""
    step = np.where(np.arange(TICKS) >= 2, 0.3, 0.0)
    target = np.repeat(step[:, None], len(robot.joints), axis=1)
    target[:, 1:][:, -1:] = 0.0
    late = np.vstack([target[:1], target[:-1]])
    fields: dict[str, Any] = {
        "id": name,
        "robot": robot.name,
        "motion": "step",
        "support": "suspended",
        "source": "simulation",
        "joints": robot.joint_names,
        "time": 5.0 + 0.05 * np.arange(TICKS),
        "target": target,
        "position": late,
    }
    return Recording(**(fields | changes))


def tilt(pitch: float) -> dict[str, np.ndarray]:
    return {"imu/roll": np.zeros(TICKS), "imu/pitch": np.linspace(0, pitch, TICKS)}


def make_replay(loss: ReplayLoss, robot: RobotDescription, off: float) -> Trajectories:
    """Off by as much at every joint, but twice as far at the first and half at the second."""
    position = np.nan_to_num(loss.position)[None] + off
    position[..., 0] += off
    position[..., 1:2] -= off / 2
    feet = np.zeros((1, position.shape[1], len(robot.feet), 3))
    return Trajectories(loss.ticks, position, np.nan_to_num(loss.tilt)[None] + off, feet)


def make_bounds(robot: RobotDescription, recordings: tuple[Recording, ...]) -> Bounds:
    full = robot_space(robot, "nn_pd")
    space = full.select([n for n in full.names if n not in NETWORK_NAMES])
    count = len(space)
    rng = np.random.default_rng(3)
    contact = np.arange(8) < 4
    unit = np.clip(0.5 + 0.05 * rng.normal(size=(8, count)), 0, 1)
    fits = space.denormalise(unit)
    splits = tuple(
        Split(name, fits[contact, i], fits[~contact, i], 0.1, 0.7, 0.4)
        for i, name in enumerate(space.names)
    )
    correlation = np.eye(count)
    correlation[0, 5] = correlation[5, 0] = 0.95
    identified = np.ones(count, dtype=bool)
    identified[1] = False
    return Bounds(
        robot=robot.name,
        actuator="nn_pd",
        space=space,
        nominal=space.denormalise(np.linspace(0.0, 0.8, count)),
        lower=fits.min(axis=0),
        upper=fits.max(axis=0),
        ci90=space.denormalise(np.linspace([0.2, 0.3], [0.6, 0.9], count).T).T,
        identified=identified,
        correlation=correlation,
        weights=np.zeros(27),
        imu=space.select(()),
        train={"loss": 1.2, "rmse": 0.0401, "rmse_before": 0.0912},
        held_out={"loss": 1.5, "rmse": 0.0522, "folds": 3},
        subsets=tuple(
            SubsetFit((recordings[0].id,), bool(c), 1.0, f)
            for c, f in zip(contact, fits, strict=True)
        ),
        splits=splits,
        histories={"nn_pd": np.array([9.0, 2.0, 1.2]), "pd": np.array([4.0, 3.0, 2.9])},
        omitted=("no standing recording: foot term left out",),
        provenance={"seed": 7, "versions": {"mujoco": "4.0.0"}},
    )


def report(
    folder: Path,
    bounds: Bounds,
    robot: RobotDescription,
    recordings: tuple[Recording, ...],
    offsets: Mapping[str, float] | None = None,
) -> Page:
    loss = ReplayLoss(robot, recordings)
    offsets = {"NN-PD": 0.01, "PD": 0.02} if offsets is None else offsets
    replays = {label: make_replay(loss, robot, off) for label, off in offsets.items()}
    write_report(folder / "report.html", bounds, robot, recordings, replays, loss)
    return Page(folder / "report.html")


DARWIN = RobotDescription.load("darwin_op2")
RECORDINGS = (
    make_recording(DARWIN, "a"),
    make_recording(DARWIN, "b"),
    make_recording(DARWIN, "c", motion="fall", support="ground", extras=tilt(0.5)),
)
BOUNDS = make_bounds(DARWIN, RECORDINGS)
