"""The report of pre-sysID and the overlays: structure, numbers, words and hostile input."""

import base64
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import matplotlib
import numpy as np
import pytest

from pup.physics.parameters import NETWORK_NAMES, robot_space
from pup.physics.simulator import Trajectories, tick_slices
from pup.recording import Recording
from pup.robot import RobotDescription
from pup.sysid import wording
from pup.sysid.accuracy import JointUnits, accuracy
from pup.sysid.bounds import Split
from pup.sysid.html import tag
from pup.sysid.loss import LOST_POSITION, ReplayLoss
from pup.sysid.overlays import Overlays, by_motion, write_overlays
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


@pytest.fixture(scope="module")
def robot() -> RobotDescription:
    return RobotDescription.load("darwin_op2")


def make_recording(robot: RobotDescription, name: str, **changes: object) -> Recording:
    """Steps of 0.3 rad on every joint but the last of several, followed late."""
    step = np.where(np.arange(TICKS) >= 2, 0.3, 0.0)
    target = np.repeat(step[:, None], len(robot.joints), axis=1)
    target[:, 1:][:, -1:] = 0.0
    late = np.vstack([target[:1], target[:-1]])
    fields: dict[str, object] = {
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
    return Recording(**(fields | changes))  # type: ignore[arg-type]


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


@pytest.fixture(scope="module")
def recordings(robot: RobotDescription) -> tuple[Recording, ...]:
    return (
        make_recording(robot, "a"),
        make_recording(robot, "b"),
        make_recording(robot, "c", motion="fall", support="ground", extras=tilt(0.5)),
    )


@pytest.fixture(scope="module")
def bounds(robot: RobotDescription, recordings: tuple[Recording, ...]) -> Bounds:
    return make_bounds(robot, recordings)


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


@pytest.fixture(scope="module")
def page(
    tmp_path_factory: pytest.TempPathFactory,
    bounds: Bounds,
    robot: RobotDescription,
    recordings: tuple[Recording, ...],
) -> Page:
    return report(tmp_path_factory.mktemp("report"), bounds, robot, recordings)


def test_needs_nothing_but_itself(page: Page) -> None:
    assert not page.all("script") + page.all("link") + page.all("iframe") + page.all("object")
    for _, attributes in page.elements:
        for key in ("src", "href", "srcset", "action"):
            assert attributes.get(key, "#").startswith(("#", "data:image/svg+xml;base64,"))
        assert not any(key.startswith("on") for key in attributes)
    assert "url(" not in page.source and "@import" not in page.source


def test_figures_are_sound_and_have_a_text(page: Page) -> None:
    images = page.all("img")
    assert len(images) >= 8
    for image in images:
        assert len(image["alt"]) > 20
        svg = ElementTree.fromstring(base64.b64decode(image["src"].split(",", 1)[1]))
        assert svg.tag.endswith("}svg")
        for element in svg.iter():
            for key, value in element.attrib.items():
                assert not key.endswith("href") or value.startswith(("#", "data:image/png"))
    assert not page.all("svg")  # drawings are images with alt texts


def test_page_is_accessible(page: Page) -> None:
    assert page.all("html")[0]["lang"] == "en"
    assert any(meta.get("name") == "viewport" for meta in page.all("meta"))
    ids = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    assert {link["href"][1:] for link in page.all("a")} <= set(ids)
    assert all(cell.get("scope") in ("row", "col") for cell in page.all("th"))
    assert len(page.all("caption")) == len(page.tables)
    assert [name for name, _ in page.elements if re.fullmatch("h[1-6]", name)][:2] == ["h1", "h2"]


def test_sections_stand_in_order(page: Page) -> None:
    assert [s["id"] for s in page.all("section")] == [
        "bounds",
        "convergence",
        "real-against-simulated",
        "errors",
        "correlation",
        "splits",
        "left-out",
        "provenance",
    ]


def test_headline_tells_the_outcome(page: Page) -> None:
    assert "3 recordings (2 suspended, 1 on the ground)" in page.text
    assert "40.1 mrad (2.30°)" in page.text
    assert "before the fit: 91.2 mrad (5.23°)" in page.text
    assert "52.2 mrad (2.99°)each left out once, in 3 folds" in page.text
    assert "13 of 14" in page.text
    assert "not determined: rho/head" in page.text
    assert "No split found" in page.text


def test_table_holds_the_bounds(page: Page, bounds: Bounds) -> None:
    table = page.table("Parameter")
    assert len(table) == 1 + len(bounds.space)
    for i, row in enumerate(table[1:]):
        assert row[:2] == [bounds.space.names[i], bounds.space.units[i]]
        told = [float(cell) for cell in row[2:5]] + [float(x) for x in row[5].split(" to ")]
        expected = [bounds.nominal[i], bounds.lower[i], bounds.upper[i], *bounds.ci90[i]]
        np.testing.assert_allclose(told, expected, rtol=6e-4)


def test_unidentified_parameters_are_grey_and_say_so(page: Page, bounds: Bounds) -> None:
    table = page.table("Parameter")
    classes = page.row_classes[page.tables.index(table)]
    for row, kind, known in zip(table[1:], classes[1:], bounds.identified, strict=True):
        assert (kind == "unknown") == (not known)
        assert row[6].startswith("yes" if known else "not identified by these recordings")
    assert table[1][6] == "yes; at the range's end"
    assert "unknown" in page.source.split("</style>")[0]


def test_recordings_and_their_errors(page: Page) -> None:
    table = page.table("Recording")
    assert [row[0] for row in table[1:]] == ["a", "b", "c"]
    assert [row[3:] for row in table[1:]] == [
        ["step", "suspended", "0.55", "12"],
        ["step", "suspended", "0.55", "12"],
        ["fall", "ground", "0.55", "12"],
    ]
    off = np.ones(20)
    off[:2] = 2, 0.5
    expected = f"{10 * np.sqrt(np.mean(off**2)):.1f}"
    assert table[1][1] == expected
    assert f"NN-PD {expected} mrad" in page.text


def test_overlays_show_joints_and_torso(page: Page, robot: RobotDescription) -> None:
    for words in ("step of up to 0.3 rad, suspended (2 recordings)", "fall, ground (1 recording)"):
        assert words in page.text
    assert f"Worst: {robot.joint_names[0]} in" in page.text
    assert f"Best: {robot.joint_names[1]} in" in page.text
    assert "torso roll in c" in page.text and "torso pitch in c" in page.text
    assert "no tilt to compare" not in page.text


def test_correlated_pairs_are_named(page: Page) -> None:
    assert "rho/arm and sigma/arm (r = +0.95): raising both together" in page.text


def test_provenance_and_omissions(page: Page) -> None:
    rows = dict(row for row in page.table("What")[1:])
    assert rows["seed"] == "7"
    assert rows["versions.mujoco"] == "4.0.0"
    assert "no standing recording: foot term left out" in page.text


def test_same_bytes_and_settings_left_alone(
    tmp_path: Path, bounds: Bounds, robot: RobotDescription, recordings: tuple[Recording, ...]
) -> None:
    before = dict(matplotlib.rcParams)
    first = report(tmp_path / "1", bounds, robot, recordings).source
    second = report(tmp_path / "2", bounds, robot, recordings).source
    assert first == second
    assert dict(matplotlib.rcParams) == before
    assert [path.name for path in (tmp_path / "1").iterdir()] == ["report.html"]


def test_hostile_text_stays_text(tmp_path: Path, bounds: Bounds, robot: RobotDescription) -> None:
    evil = "</style><script>alert(1)</script><img src=http://x onerror='a()'>\x00\u202e & \ud800"
    recordings = (
        make_recording(robot, 'a<b>&"$x^$', notes=evil, motion=evil),
        make_recording(robot, "$x_{$'", support="ground", motion="stand"),
    )
    bounds = replace(
        bounds, robot="<b>", omitted=(evil,), provenance={evil: [evil, {"x": evil}], "n": None}
    )
    page = report(tmp_path, bounds, robot, recordings, {"<i>authors</i>": 0.01})
    assert not page.all("script") and not page.all("b") and not page.all("i")
    assert 'a<b>&"$x^$' in [row[0] for row in page.table("Recording")]
    assert "<script>alert(1)</script>" in page.text
    assert "\x00" not in page.source and "\u202e" not in page.source
    paths = write_overlays(
        tmp_path / "plots",
        robot,
        recordings,
        make_replay(loss := ReplayLoss(robot, recordings), robot, 0.1),
        loss,
        "$",
    )
    assert [path.name for path in paths] == ['a<b>&"$x^$.png', "$x_{$'.png"]


def test_elements_escape_all_but_markup() -> None:
    assert tag("p", "<", tag("b", "&"), class_='"') == '<p class="&quot;">&lt;<b>&amp;</b></p>'
    assert tag("img", alt="a") == '<img alt="a">'


def test_single_recording_without_anything_else(
    tmp_path: Path, bounds: Bounds, robot: RobotDescription
) -> None:
    bare = replace(
        bounds,
        held_out=None,
        subsets=(),
        splits=(),
        histories={},
        omitted=(),
        provenance={},
        identified=np.zeros(len(bounds.space), dtype=bool),
        correlation=np.eye(len(bounds.space)),
    )
    page = report(tmp_path, bare, robot, (make_recording(robot, "only"),), {"PD": 0.02})
    for words in (
        "1 recording (1 suspended)",
        "no recording was left out",
        "0 of 14",
        "bounds from no fits",
        "Could not be tested because no fits to subsets of the recordings were made.",
        "No history of the fits was kept.",
        "No two parameters are correlated beyond 0.9.",
        "Nothing: the recordings give every term of the loss.",
        "None was recorded.",
    ):
        assert words in page.text


def test_ground_without_imu(tmp_path: Path, bounds: Bounds, robot: RobotDescription) -> None:
    recordings = (make_recording(robot, "a", support="ground", motion="stand"),)
    page = report(tmp_path, bounds, robot, recordings)
    assert "no tilt to compare" in page.text
    assert "torso pitch in" not in page.text


def test_split_is_told_with_its_meaning(
    tmp_path: Path, bounds: Bounds, robot: RobotDescription, recordings: tuple[Recording, ...]
) -> None:
    splits = list(bounds.splits)
    at = bounds.space.names.index("torque_limit")
    splits[at] = replace(splits[at], p_value=0.0004, two_clusters=0.0005)
    splits[1] = replace(splits[1], p_value=0.03)  # rho/head, not identified
    splits[2] = replace(splits[2], two_clusters=0.0005)
    friction = bounds.space.names.index("ground_friction")
    stuck = np.full(4, bounds.nominal[friction])
    splits[friction] = replace(splits[friction], without=stuck, p_value=0.001, two_clusters=0.001)
    page = report(tmp_path, replace(bounds, splits=tuple(splits)), robot, recordings)
    assert (
        "rho/head (p = 0.0300) and torque_limit (p = 0.0004) take other values with ground contact"
        in page.text
    )
    assert "the model lacks something" in page.text
    assert (
        "The values of ground_friction differ too (p = 0.0010), but the subsets without contact "
        "left it at its nominal value" in page.text
    )
    assert "do not identify rho/head" in page.text
    assert "the values of rho/hip fall into two clusters" in page.text
    rows = {row[0]: row for row in page.tables[2][1:]}
    split = splits[at]
    assert rows["ground_friction"][-1] == "not seen without contact"
    assert rows["torque_limit [N m]"][1:] == [
        wording.spread(split.without),
        wording.spread(split.with_contact),
        "0.0004",
        "0.0005",
        "split",
    ]


@pytest.mark.parametrize(
    ("supports", "contact", "reason"),
    [
        (("suspended", "suspended"), (False,) * 4, "no recording is on the ground"),
        (("bench",), (False,) * 4, "no recording is on the ground"),
        (("ground", "ground"), (True,) * 4, "every recording is on the ground"),
        (("ground", "suspended"), (True,) * 4, "of the 4 subset fits none is without"),
        (("ground", "suspended"), (True, False, False), "of the 3 subset fits 1 is with ground"),
        (("ground", "suspended"), (), "no fits to subsets"),
    ],
)
def test_why_there_is_no_test(
    bounds: Bounds,
    robot: RobotDescription,
    supports: tuple[str, ...],
    contact: tuple[bool, ...],
    reason: str,
) -> None:
    recordings = [make_recording(robot, f"r{i}", support=s) for i, s in enumerate(supports)]
    values = bounds.nominal
    untested = replace(
        bounds,
        subsets=tuple(SubsetFit(("r0",), c, 1.0, values) for c in contact),
        splits=tuple(replace(s, p_value=float("nan")) for s in bounds.splits),
    )
    told = wording.split_words(untested, recordings)
    assert told.startswith("Could not be tested because ") and reason in told
    assert not wording.split_meaning(untested)


def test_gaps_and_broken_simulations(
    tmp_path: Path, bounds: Bounds, robot: RobotDescription
) -> None:
    position = np.zeros((TICKS, len(robot.joints)))
    position[4:, 3] = np.nan
    target = np.ones_like(position)
    target[1::2] = np.nan
    roll = {"imu/roll": np.zeros(TICKS)}
    recordings = (
        make_recording(robot, "a", position=position, target=target),
        make_recording(robot, "b", support="ground", extras=roll),
    )
    loss = ReplayLoss(robot, recordings)
    replay = make_replay(loss, robot, 0.01)
    replay.position[0, 6:TICKS] = np.nan
    measures = accuracy(loss, replay)
    assert measures.diverged.tolist() == [True, False]
    assert measures.cells[0, 3] == pytest.approx(0.01)
    expected = np.sqrt((6 * 0.01**2 + 6 * LOST_POSITION**2) / 12)
    assert measures.cells[0, 4] == pytest.approx(expected)
    np.testing.assert_allclose(measures.tilt, [[np.nan, np.nan], [0.01, np.nan]])
    write_report(tmp_path / "r.html", bounds, robot, recordings, {"NN-PD": replay}, loss)
    page = Page(tmp_path / "r.html")
    assert page.table("Recording")[1][1].endswith("(broke down)")
    assert "torso roll in b" in page.text and "torso pitch" not in page.text
    assert len(write_overlays(tmp_path / "plots", robot, recordings, replay, loss)) == 2


def test_accuracy_weighs_every_recording_the_same(robot: RobotDescription) -> None:
    long = make_recording(robot, "a", support="ground", extras=tilt(0.0) | {"imu/roll": ROLL})
    short = make_recording(
        robot, "b", time=long.time[:3], target=long.target[:3], position=long.position[:3]
    )
    loss = ReplayLoss(robot, (long, short))
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


def test_joints_told_to_stay_are_shown_only_as_the_worst(robot: RobotDescription) -> None:
    recordings = (make_recording(robot, "a"), make_recording(robot, "b"))
    loss = ReplayLoss(robot, recordings)
    still = len(robot.joints) - 1

    def shown(off: float) -> list[tuple[str, str]]:
        replay = make_replay(loss, robot, 0.01)
        replay.position[..., still] = loss.position[:, still] + off
        measures = {"x": accuracy(loss, replay)}
        units = JointUnits.of(robot, recordings)
        overlays = Overlays(robot, loss, {"x": replay}, measures, units)
        return [(p.rank, p.signal) for p in overlays.joint_panels([0, 1], "x")]

    names = robot.joint_names
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


def test_recordings_are_grouped_by_motion_and_step(robot: RobotDescription) -> None:
    small = make_recording(robot, "a").target / 3
    recordings = [
        make_recording(robot, "a"),
        make_recording(robot, "b", target=small),
        make_recording(robot, "c", motion="walk", support="ground"),
        make_recording(robot, "d", target=np.ones_like(small)),
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


def test_overlays_are_one_picture_per_recording(
    tmp_path: Path, robot: RobotDescription, recordings: tuple[Recording, ...]
) -> None:
    loss = ReplayLoss(robot, recordings)
    replay = make_replay(loss, robot, 0.01)
    paths = write_overlays(tmp_path, robot, recordings, replay, loss)
    assert [path.name for path in paths] == ["a.png", "b.png", "c.png"]
    assert all(path.read_bytes().startswith(b"\x89PNG\r\n\x1a\n") for path in paths)
    assert sorted(tmp_path.iterdir()) == sorted(paths)
    again = write_overlays(tmp_path / "again", robot, recordings, replay, loss)
    assert [path.read_bytes() for path in again] == [path.read_bytes() for path in paths]
