"""The report of pre-sysID: structure, numbers, words and hostile input."""

import base64
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
import pytest

from pup.sysid import wording
from pup.sysid.html import tag
from pup.sysid.loss import ReplayLoss
from pup.sysid.overlays import write_overlays
from pup.sysid.result import SubsetFit
from services.tables import bounds_table, replay_table
from tests.reports import BOUNDS, DARWIN, RECORDINGS, Page, make_recording, make_replay, report


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Page:
    return report(tmp_path_factory.mktemp("report"), BOUNDS, DARWIN, RECORDINGS)


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


def test_table_holds_the_bounds(page: Page) -> None:
    table = page.table("Parameter")
    assert len(table) == 1 + len(BOUNDS.space)
    for i, row in enumerate(table[1:]):
        assert row[:2] == [BOUNDS.space.names[i], BOUNDS.space.units[i]]
        told = [float(cell) for cell in row[2:5]] + [float(x) for x in row[5].split(" to ")]
        expected = [BOUNDS.nominal[i], BOUNDS.lower[i], BOUNDS.upper[i], *BOUNDS.ci90[i]]
        np.testing.assert_allclose(told, expected, rtol=6e-4)


def test_unidentified_parameters_are_grey_and_say_so(page: Page) -> None:
    table = page.table("Parameter")
    classes = page.row_classes[page.tables.index(table)]
    for row, kind, known in zip(table[1:], classes[1:], BOUNDS.identified, strict=True):
        assert (kind == "unknown") == (not known)
        assert row[6].startswith("yes" if known else "not identified by these recordings")
    assert table[1][6] == "yes; at the range's end"
    assert "unknown" in page.source.split("</style>")[0]


def test_the_end_of_a_range_is_told_to_programs_and_in_the_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    document = BOUNDS.document()
    at_end = [p["name"] for p in document["parameters"] if p["at_end"]]
    assert at_end == [BOUNDS.space.names[0]]
    monkeypatch.setenv("COLUMNS", "160")
    loss = {"train": {"loss": 1, "rmse": 1, "loss_before": 2, "rmse_before": 2}, "held_out": None}
    told = document | {"loss": loss, "provenance": {"options": {}, "seconds": 1}}
    bounds_table(told, "rad")
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[1] for line in lines if "at an end of its range" in line] == at_end


def test_a_parameter_that_too_few_subsets_see_is_named() -> None:
    few = np.isin(np.arange(len(BOUNDS.space)), (0, 2))
    a, b = BOUNDS.space.names[0], BOUNDS.space.names[2]
    assert wording.untold(BOUNDS.space, few & False, ()) == []
    (both,) = wording.untold(BOUNDS.space, few, ())
    assert both.startswith(
        f"fewer than two subsets see {a} and {b}: bounds hold the whole interval"
    )
    seen, kept = wording.untold(BOUNDS.space, few, {b})
    assert f"see {a}: bounds" in seen and f"see {b}: kept as described" in kept


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


def test_overlays_show_joints_and_torso(page: Page) -> None:
    for words in ("step of up to 0.3 rad, suspended (2 recordings)", "fall, ground (1 recording)"):
        assert words in page.text
    assert f"Worst: {DARWIN.joint_names[0]} in" in page.text
    assert f"Best: {DARWIN.joint_names[1]} in" in page.text
    assert "torso roll in c" in page.text and "torso pitch in c" in page.text
    assert "no tilt to compare" not in page.text


def test_correlated_pairs_are_named(page: Page) -> None:
    assert "rho/arm and sigma/arm (r = +0.95): raising both together" in page.text


def test_provenance_and_omissions(page: Page) -> None:
    rows = dict(row for row in page.table("What")[1:])
    assert rows["seed"] == "7"
    assert rows["versions.mujoco"] == "4.0.0"
    assert "no standing recording: foot term left out" in page.text


def test_same_bytes_and_settings_left_alone(tmp_path: Path) -> None:
    before = dict(matplotlib.rcParams)
    first = report(tmp_path / "1", BOUNDS, DARWIN, RECORDINGS).source
    second = report(tmp_path / "2", BOUNDS, DARWIN, RECORDINGS).source
    assert first == second
    assert dict(matplotlib.rcParams) == before
    assert [path.name for path in (tmp_path / "1").iterdir()] == ["report.html"]


def test_hostile_text_stays_text(tmp_path: Path) -> None:
    markup = "</style><script>alert(1)</script><img src=http://x onerror='a()'>\x00\u202e & "
    evil = markup + "\ud800"  # which recordings refuse
    recordings = (
        make_recording(DARWIN, 'a<b>&"$x^$', notes=markup, motion=markup),
        make_recording(DARWIN, "$x_{$'", support="ground", motion="stand"),
    )
    bounds = replace(
        BOUNDS, robot="<b>", omitted=(evil,), provenance={evil: [evil, {"x": evil}], "n": None}
    )
    page = report(tmp_path, bounds, DARWIN, recordings, {"<i>authors</i>": 0.01})
    assert not page.all("script") and not page.all("b") and not page.all("i")
    assert 'a<b>&"$x^$' in [row[0] for row in page.table("Recording")]
    assert "<script>alert(1)</script>" in page.text
    assert "\x00" not in page.source and "\u202e" not in page.source
    paths = write_overlays(
        tmp_path / "plots",
        DARWIN,
        recordings,
        make_replay(loss := ReplayLoss(DARWIN, recordings), DARWIN, 0.1),
        loss,
        "$",
    )
    assert [path.name for path in paths] == ['a<b>&"$x^$.png', "$x_{$'.png"]


def test_elements_escape_all_but_markup() -> None:
    assert tag("p", "<", tag("b", "&"), class_='"') == '<p class="&quot;">&lt;<b>&amp;</b></p>'
    assert tag("img", alt="a") == '<img alt="a">'


def test_single_recording_without_anything_else(tmp_path: Path) -> None:
    bare = replace(
        BOUNDS,
        held_out=None,
        subsets=(),
        splits=(),
        histories={},
        omitted=(),
        provenance={},
        identified=np.zeros(len(BOUNDS.space), dtype=bool),
        correlation=np.eye(len(BOUNDS.space)),
    )
    page = report(tmp_path, bare, DARWIN, (make_recording(DARWIN, "only"),), {"PD": 0.02})
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


def test_ground_without_imu(tmp_path: Path) -> None:
    recordings = (make_recording(DARWIN, "a", support="ground", motion="stand"),)
    page = report(tmp_path, BOUNDS, DARWIN, recordings)
    assert "no tilt to compare" in page.text
    assert "torso pitch in" not in page.text


def test_split_is_told_with_its_meaning(tmp_path: Path) -> None:
    splits = list(BOUNDS.splits)
    at = BOUNDS.space.names.index("torque_limit")
    splits[at] = replace(splits[at], p_value=0.0004, two_clusters=0.0005)
    splits[1] = replace(splits[1], p_value=0.03)  # rho/head, not identified
    splits[2] = replace(splits[2], two_clusters=0.0005)
    friction = BOUNDS.space.names.index("ground_friction")
    stuck = np.full(4, BOUNDS.nominal[friction])
    splits[friction] = replace(splits[friction], without=stuck, p_value=0.001, two_clusters=0.001)
    page = report(tmp_path, replace(BOUNDS, splits=tuple(splits)), DARWIN, RECORDINGS)
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


def test_names_are_printed_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    names = ("walk[fast]", "[bold]x", ":smile:", "a[", "b]")
    replay_table(
        {
            "robot": "r",
            "unit": "rad",
            "per_recording": dict.fromkeys(names, 0.1),
            "diverged": [],
            "rmse": 0.1,
            "actuator": "pd",
            "model": "robots[/old]/robot.toml",
        }
    )
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[1] for line in lines[4 : 4 + len(names)]] == list(names)
    assert lines[-1] == "model: pd, robots[/old]/robot.toml"


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
    supports: tuple[str, ...],
    contact: tuple[bool, ...],
    reason: str,
) -> None:
    recordings = [make_recording(DARWIN, f"r{i}", support=s) for i, s in enumerate(supports)]
    values = BOUNDS.nominal
    untested = replace(
        BOUNDS,
        subsets=tuple(SubsetFit(("r0",), c, 1.0, values) for c in contact),
        splits=tuple(replace(s, p_value=float("nan")) for s in BOUNDS.splits),
    )
    told = wording.split_words(untested, recordings)
    assert told.startswith("Could not be tested because ") and reason in told
    assert not wording.split_meaning(untested)
