"""The report on what has no name: missing torques, halves of the data that differ, laws."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from diagnoses import Maker, split
from matplotlib.figure import Figure
from test_diagnosis_report import headings, page, speech
from test_report import Page

from pup.diagnosis import report_missing, report_splits, summary
from pup.diagnosis.lawfit import Law
from pup.diagnosis.report_missing import LASTS, clearest
from pup.diagnosis.result import Diagnosis
from pup.diagnosis.sentences import items, sentence
from pup.diagnosis.verdict import Parameter
from pup.diagnosis.wording import percent
from pup.physics.terms import Place
from pup.robot import RobotDescription
from pup.sysid import html
from pup.sysid.figures import drawing_style
from pup.sysid.html import Html

KNEE = Place("joint", "l_knee")
NAMELESS = "Something that no known effect explains happens"
HALVES = "Parameters that differ between halves of the data"


@pytest.fixture(scope="module")
def leg() -> Maker:
    return Maker(RobotDescription.load("darwin_leg"), ticks=180, most=20)


@pytest.fixture(scope="module")
def backlash(leg: Maker) -> Diagnosis:
    return leg.missing("backlash", KNEE, gap=0.008)


def brake(leg: Maker) -> Law:
    """A law that was found: it brakes by what is asked of the servo."""
    return Law(("|u|*sgn(v)",), (-0.12,), 300.0, 10.0, np.zeros((leg.samples, 1)))


def section(parts: Iterable[Html], folder: Path) -> Page:
    """A section alone, with its figures."""
    with drawing_style():
        content = html.page("a section", *parts)
    path = folder / "section.html"
    path.write_text(content, encoding="utf-8")
    return Page(path)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests of words: figures are made up, but not drawn."""
    monkeypatch.setattr(Figure, "savefig", lambda self, file, **more: file.write(b"<svg/>"))


def test_a_torque_is_shown_where_it_is_most_certain(leg: Maker) -> None:
    missing = leg.located({"l_knee": 0.2})
    stretch = clearest(missing, missing.channels.index("l_knee"))
    assert stretch.recording == 1
    shown = missing.time[1][stretch.knots]
    end = missing.time[1][-1]
    assert shown[0] < end - 0.6 and shown[-1] > end - 0.4  # the half second before the end
    assert shown[-1] - shown[0] == pytest.approx(LASTS, abs=0.1)


def test_missing_torques_are_ranked_and_drawn(
    backlash: Diagnosis, leg: Maker, tmp_path: Path
) -> None:
    missing = leg.located({"l_knee": 0.2, "l_hip_yaw": 0.05, "l_ank_roll": 0.004})
    told = report_missing.torques(replace(backlash, missing=missing), speech(backlash))
    shown = section(told, tmp_path)
    share = 0.2 / summary.limits(backlash)[leg.robot.joint_names.index("l_knee")]
    assert (
        "What the nominal model lacks shows most clearly at the left knee: typically 0.2 N m, "
        f"{percent(share)} of what its servo can give. Also at the left hip yaw."
    ) in shown.text
    captions = [image["alt"] for image in shown.all("img")]
    drawn = [c for c in captions if c.startswith("Missing torque over time")]
    assert [c.split(",")[1].split(" in ")[0] for c in drawn] == [" left knee", " left hip yaw"]
    assert all(" in chirp_1: largest at " in c and "0.4 ± 0.033 N m" in c for c in drawn[:1])
    assert len(captions) == 3  # the ranking and two torques
    assert not list(report_missing.torques(backlash, speech(backlash)))


@pytest.mark.usefixtures("undrawn")
def test_no_torque_may_be_missing(backlash: Diagnosis, leg: Maker, tmp_path: Path) -> None:
    shown = page(replace(backlash, missing=leg.located({})), tmp_path)
    assert "No torque at any joint makes the readings much more probable" in shown.text


@pytest.mark.usefixtures("undrawn")
def test_a_wrench_on_the_torso_is_told(tmp_path: Path) -> None:
    op2 = Maker(RobotDescription.load("darwin_op2"), ticks=90, most=2)
    base = op2.missing("backlash", KNEE)
    missing = op2.located({"force z": 3.0, "torque y": 0.1})
    shown = page(replace(base, missing=missing), tmp_path)
    assert "most clearly as a force on the torso along z: typically 3 N" in shown.text
    rows = shown.table("On the torso")
    assert rows[1][:3] == ["force on the torso along z", "1,500", "3 N"]
    assert rows[1][3].endswith(" %")
    assert rows[2] == ["torque on the torso about y", "50", "0.1 N m", ""]


def test_splits_count_beyond_chance_and_by_simulation() -> None:
    real = split("hip", "fast", "slow", tau_max=1.9, kp=1.01)
    chance = split("knee", "fast", "slow", chance=0.005, tau_max=1.2)
    linear = replace(split("ankle", "fast", "slow", tau_max=3.0), gained=2.0)
    gaps = report_splits.found_gaps((real, chance, linear), ())
    assert [(gap.group, gap.before.parameter) for gap in gaps] == [("hip", "tau_max")]
    assert gaps[0].after is None and not gaps[0].closed


def test_a_gap_is_closed_or_not() -> None:
    before = (split("hip", "fast", "slow", tau_max=1.9), split("hip", "late", "early", kp=0.5))
    after = (split("hip", "fast", "slow", tau_max=1.02), split("hip", "late", "early", kp=0.6))
    gaps = {gap.first: gap for gap in report_splits.found_gaps(before, after)}
    assert gaps["fast"].closed and not gaps["late"].closed
    assert report_splits.sentence(gaps["fast"]) == (
        "The torque limit tau_max of the hip is 1.9 times as large in fast motion as in slow "
        "(90 % interval of the ratio 1.81 to 1.99); with what was found, the ratio is 1.02 "
        "(0.97 to 1.07)."
    )
    assert report_splits.sentence(gaps["late"]).startswith(
        "The stiffness kp of the hip is 2 times as large early in a recording as late in it "
        "(90 % interval of the ratio 1.90 to 2.10); with what was found, the ratio is 1.67"
    )
    hidden = split("hip", "fast", "slow", tau_max=1 / 460)
    assert report_splits.sentence(report_splits.found_gaps((hidden,), ())[0]) == (
        "The torque limit tau_max of the hip is 460 times as large in slow motion as in fast "
        "(90 % interval of the ratio 438 to 483)."
    )
    apart = report_splits.found_gaps((split("hip", "fast", "slow", tau_max=1.954),), ())
    assert "is 1.95 times as large" in report_splits.sentence(apart[0])
    small = report_splits.found_gaps((split("hip", "on the ground", "in the air", kd=1.2),), ())
    assert "is 20 % larger on the ground than in the air" in report_splits.sentence(small[0])


def test_halves_that_differ_are_drawn_before_and_after(backlash: Diagnosis, tmp_path: Path) -> None:
    before = (
        split("hip", "on the ground", "in the air", tau_max=1.9, kp=0.7),
        split("knee", "fast", "slow", kd=1.3),
    )
    after = (
        split("hip", "on the ground", "in the air", tau_max=1.02, kp=0.99),
        split("knee", "fast", "slow", kd=1.25),
    )
    told = report_splits.gaps(replace(backlash, splits=(before, after)), speech(backlash))
    shown = section(told, tmp_path)
    assert (
        "3 differences between halves of the data; with what was found in the model, 1 is left."
    ) in shown.text
    assert "is 1.9 times as large on the ground as in the air" in shown.text
    assert len(shown.all("img")) == 1
    assert "outside the picture" not in shown.text


def test_a_ratio_that_leaves_the_picture_is_admitted(backlash: Diagnosis, tmp_path: Path) -> None:
    before = (split("hip", "fast", "slow", tau_max=1 / 460),)
    told = report_splits.gaps(replace(backlash, splits=(before, before)), speech(backlash))
    assert "Dots beyond 8 to 1 are outside the picture." in section(told, tmp_path).text


@pytest.mark.usefixtures("undrawn")
def test_halves_may_agree(backlash: Diagnosis, tmp_path: Path) -> None:
    alike = (split("hip", "fast", "slow", chance=0.5, tau_max=1.01),)
    none = page(replace(backlash, splits=(alike, alike)), tmp_path / "none")
    assert HALVES in headings(none)
    assert "None of 1 comparison of halves shows a difference" in none.text
    assert HALVES not in headings(page(backlash, tmp_path / "bare"))


@pytest.mark.parametrize(
    ("place", "where"),
    [
        (KNEE, "at the left knee"),
        (Place("group", "hip"), "at the hip joints"),
        (Place("robot"), "at most joints of the robot"),
        (Place("sensor"), "in the readings of the IMU"),
        (Place("body", "l_knee_link"), "at the left knee link"),
    ],
)
def test_a_nameless_cause_has_a_place(leg: Maker, place: Place, where: str) -> None:
    told = leg.beyond(leg.nothing(2.0), place, None)
    assert sentence(told, told.findings[0], speech(told)) == f"{NAMELESS} {where}."
    assert items(told, speech(told))[0].text == f"{NAMELESS} {where}."


def test_a_nameless_cause_that_names_are_patches_for_says_so(leg: Maker) -> None:
    told = leg.beyond(leg.nothing(2.0), KNEE, None)
    patched = replace(told.findings[0], parameters={"astray": Parameter(2.14, "1", 2.14, 2.14)})
    assert sentence(told, patched, speech(told)) == (
        f"{NAMELESS} at the left knee: the effects that are told of may be patches for it, and "
        "leave 2.1 times the noise on motions that were left out."
    )


@pytest.mark.usefixtures("undrawn")
def test_a_nameless_cause_alone_is_the_headline(leg: Maker, tmp_path: Path) -> None:
    told = leg.beyond(leg.nothing(2.0), KNEE, None)
    alike = (split("hip", "fast", "slow", tau_max=1.9),)
    shown = page(replace(told, splits=(alike, alike)), tmp_path)
    assert f"<h1>{NAMELESS} at the left knee.</h1>" in shown.source
    assert "So nothing was added to the corrected robot" in shown.text
    assert "no law for it holds on motions left out" in shown.text
    assert "corrected model" not in shown.text.lower()
    assert "falls from" not in shown.text
    assert "1 difference between halves of the data." in shown.text  # there is no after
    assert "errors are 2.00 times the noise" in shown.text
    assert shown.table("Law")[1:] == [["tau += 0.031 N m s/rad v", "not added"]]
    assert "Symbols: v speed." in shown.text
    lacks = shown.table("Where")
    assert lacks[1] == ["left knee", "2.00", "12.0 sd", "1.50", "8.0 sd", "1.10"]
    assert lacks[2][3:5] == ["not repeated", ""]
    assert "What no known effect explains" in headings(shown)
    assert "Errors on motions left out" in headings(shown)


@pytest.mark.usefixtures("undrawn")
def test_a_law_that_holds_is_told(leg: Maker, tmp_path: Path) -> None:
    shown = page(leg.beyond(leg.nothing(2.0), KNEE, brake(leg)), tmp_path)
    assert f"{NAMELESS} at the left knee; it acts like the torque \u22120.12 |u|*sgn(v)." in (
        shown.text
    )
    assert ["tau += -0.12 |u|*sgn(v)", "in the corrected robot"] in shown.table("Law")
    assert shown.table("Quantity")[1][0] == "|u|*sgn(v)"
    assert "Before and after" in headings(shown)
    assert "Corrected" in shown.table("Parameter")[0]


def test_a_law_that_explains_little_is_not_said_to_describe_it(leg: Maker) -> None:
    leg.rng = np.random.default_rng(2)  # whatever tests ran before
    told = leg.beyond(leg.nothing(2.0), KNEE, brake(leg))
    weak = replace(told.findings[0], gain=0.01 * told.findings[0].gain)
    words = sentence(told, weak, speech(told))
    assert words.startswith(f"{NAMELESS} at the left knee; the best law for it explains only 2")
    assert "torque" not in words


@pytest.mark.usefixtures("undrawn")
def test_known_and_nameless_causes_share_a_headline(
    backlash: Diagnosis, leg: Maker, tmp_path: Path
) -> None:
    shown = page(leg.beyond(backlash, KNEE, None), tmp_path)
    assert (
        "The simulator lacks backlash at the left knee, and something that no known effect "
        "explains."
    ) in shown.text
    assert "With backlash at the left knee in the model, more than noise is left." in shown.text
    assert "The torque that is still missing" in shown.text
    assert "Probability 97 % that it is there" in shown.text


def test_limits_are_those_of_the_nominal_fit(backlash: Diagnosis) -> None:
    values = backlash.nominal.fit.values
    knee = backlash.robot.joint_names.index("l_knee")
    group = backlash.robot.joints[knee].group
    assert summary.limits(backlash)[knee] == pytest.approx(values[f"tau_max/{group}"])
    assert np.isfinite(summary.limits(backlash)).all()
