"""The report of a diagnosis: sections, figures, and what must not be in it."""

import base64
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnoses import Maker
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from test_report import Page

from pup.diagnosis import summary
from pup.diagnosis.document import document
from pup.diagnosis.drawing import MARKS, draw_robot, ink_on
from pup.diagnosis.experiment import NextRecording, Pair
from pup.diagnosis.nominal import Certificate
from pup.diagnosis.report import write_report
from pup.diagnosis.report_findings import badge
from pup.diagnosis.result import Diagnosis
from pup.diagnosis.wording import Speech
from pup.physics.terms import Place
from pup.robot import RobotDescription, built_in_robots
from pup.sysid.accuracy import JointUnits
from pup.sysid.figures import drawing_style

NEXT = {
    "motion": "a slow triangle",
    "reason": "it crosses zero load",
    "splits": [["backlash", "dead_band"]],
}


@pytest.fixture(scope="module")
def bench() -> Maker:
    return Maker(RobotDescription.load("servo_bench"))


@pytest.fixture(scope="module")
def backlash() -> Diagnosis:
    leg = Maker(RobotDescription.load("darwin_leg"), ticks=60, most=30)
    return leg.missing("backlash", Place("joint", "l_knee"), gap=0.008)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests of words: figures are made up, but not drawn."""
    monkeypatch.setattr(Figure, "savefig", lambda self, file, **more: file.write(b"<svg/>"))


def speech(diagnosis: Diagnosis) -> Speech:
    units = JointUnits.of(diagnosis.robot, diagnosis.measured.recordings)
    return Speech(diagnosis.robot, units)


def page(diagnosis: Diagnosis, folder: Path, provenance: dict[str, Any] | None = None) -> Page:
    path = folder / "report.html"
    write_report(diagnosis, path, provenance or {})
    return Page(path)


def headings(shown: Page) -> list[str]:
    return re.findall("<h2>(.*?)</h2>", shown.source)


@pytest.mark.usefixtures("undrawn")
def test_report_of_a_mismatch(backlash: Diagnosis, tmp_path: Path) -> None:
    shown = page(
        backlash, tmp_path, {"command": "pup diagnose <x>", "next_recording": NEXT, "seed": 0}
    )
    assert headings(shown) == [
        "What is missing",
        "Where",
        "Before and after",
        "When the model is off",
        "Evidence",
        "What could hide",
        "What to record next",
        "The nominal fit",
        "Provenance",
    ]
    assert "The left knee loses 0.92° at every load reversal" in shown.text
    assert "Your fit hid it in the damping kd of the hip (31 % too high)." in shown.text
    held, words = backlash.held_out, speech(backlash).units.words
    assert held is not None
    assert f"falls from {words(held.before)} to {words(held.after)}" in shown.text
    assert "gear backlash from a dead band of the controller" in shown.text
    assert ["command", "pup diagnose <x>"] in shown.table("What")
    assert "next_recording" not in shown.text
    finalists = shown.table("Finalist")
    assert finalists[1][0] == "backlash, left knee" and finalists[1][-1] == "was added"
    parameters = {row[0]: row for row in shown.table("Parameter")}
    assert parameters["damping kd of the hip"][-1].startswith("0 %")
    assert len(shown.table("Recording")) == 4


@pytest.mark.usefixtures("undrawn")
def test_what_a_recording_tells_apart_has_its_own_name(backlash: Diagnosis, tmp_path: Path) -> None:
    """Where the document, by the contract, has none."""
    pair = Pair("stribeck_friction", "rising_static_friction", 50.0)
    ask = NextRecording("drop", "a drop", "bench", {}, False, "a drop would tell", (pair, pair))
    told = replace(backlash, ask=ask)
    assert ask.document()["splits"] == [["stribeck_friction", "unknown"]]
    shown = page(told, tmp_path, {"next_recording": ask.document()})
    wanted = (
        "dry friction that is higher at rest from dry friction that grows with the time at rest"
    )
    assert shown.text.count(wanted) == 1


@pytest.mark.parametrize("colour", MARKS)
def test_numbers_of_findings_can_be_read(colour: str) -> None:
    """Contrast of small text by WCAG 2.1, success criterion 1.4.3."""

    def luminance(of: str) -> float:
        parts = [x / 12.92 if x <= 0.04045 else ((x + 0.055) / 1.055) ** 2.4 for x in to_rgb(of)]
        return 0.2126 * parts[0] + 0.7152 * parts[1] + 0.0722 * parts[2]

    dark, light = sorted((luminance(colour), luminance(ink_on(colour))))
    assert (light + 0.05) / (dark + 0.05) >= 4.5
    number = MARKS.index(colour) + 1
    assert f"color: {ink_on(colour)}; background: {colour}" in badge(number)


@pytest.mark.usefixtures("undrawn")
def test_no_effect_is_seen_at_any_size(backlash: Diagnosis, tmp_path: Path) -> None:
    sizes = [row[3] for row in page(backlash, tmp_path).table("Effect")[1:]]
    assert sizes and all(float(size.replace(",", "")) > 0 for size in sizes)


@pytest.mark.usefixtures("undrawn")
def test_what_no_recording_tells_apart_is_admitted(backlash: Diagnosis, tmp_path: Path) -> None:
    shown = page(backlash, tmp_path)
    assert "tells gear backlash at the left knee from commands that arrive late" in shown.text


def test_figures_are_self_contained_and_told(backlash: Diagnosis, tmp_path: Path) -> None:
    shown = page(backlash, tmp_path)
    images = shown.all("img")
    assert len(images) >= 12
    for image in images:
        kind, _, data = image["src"].partition(",")
        assert kind == "data:image/svg+xml;base64"
        svg = base64.b64decode(data)
        assert ElementTree.fromstring(svg).tag.endswith("svg")
        links = re.findall(r'(?:href|src)="([^"#][^"]*)"', svg.decode())
        assert all(link.startswith("data:image/png") for link in links)
        assert image["alt"]
    assert shown.source.count("<figcaption>") == len(images)
    linked = [e.get("href", e.get("src", "")) for _, e in shown.elements]
    assert all(link.startswith(("#", "data:")) for link in linked if link)
    assert not shown.all("script") and not shown.all("link")
    assert len(shown.source) < 1_500_000
    targets = {link["href"][1:] for link in shown.all("a")}
    assert targets == {section["id"] for section in shown.all("section")}


def test_report_is_the_same_every_time(bench: Maker, tmp_path: Path) -> None:
    diagnosis = bench.nothing()
    first, second = (page(diagnosis, tmp_path / name).source for name in ("a", "b"))
    assert first == second


@pytest.mark.usefixtures("undrawn")
def test_report_of_nothing_missing(bench: Maker, tmp_path: Path) -> None:
    diagnosis = bench.nothing()
    shown = page(diagnosis, tmp_path)
    limit = 1000 * summary.smallest_material(diagnosis)
    assert f"Nothing material is missing from the simulator beyond {limit:.2g} mrad" in shown.text
    assert "will do for motions like these" in shown.text
    assert "measured from repeats" in shown.text
    found = headings(shown)
    assert "What is missing" not in found and "Provenance" not in found
    assert "Errors on motions left out" in found
    assert len(shown.table("Effect")) > 5  # what would not have been seen


@pytest.mark.usefixtures("undrawn")
def test_parts_of_one_recording_are_told_as_that_recording(bench: Maker, tmp_path: Path) -> None:
    """Times count from where the recording begins, not the part; slides are off by micrometres."""
    found = bench.missing("backlash", Place("joint", "servo"), gap=0.008)
    parts = [r.id for r in found.measured.recordings]
    begins = {id: ("long", 4.0 * number) for number, id in enumerate(parts)}
    whole = replace(found, origins=begins)
    told, before = document(whole, "corrected"), document(found, "corrected")
    for one, other in zip(told["findings"][0]["when"], before["findings"][0]["when"], strict=True):
        begin = begins[other["recording"]][1]
        assert one == {
            "recording": "long",
            "start": begin + other["start"],
            "end": begin + other["end"],
        }
    assert told["held_out"]["recordings"] == ["long"]
    shown = page(whole, tmp_path)
    assert f"from one recording, in {len(parts)} parts between its rests" in shown.text


@pytest.mark.usefixtures("undrawn")
def test_effects_that_do_not_matter_are_those_that_were_left_last(
    bench: Maker, tmp_path: Path
) -> None:
    """Not those that rounds added and others took the place of."""
    found = bench.missing("backlash", Place("joint", "servo"), gap=0.008)
    assert found.model is not None
    small = replace(bench.nothing(), rounds=found.rounds, slight=found.model.hypotheses)
    assert "but too little to matter" in page(small, tmp_path).text
    none = replace(small, slight=())
    assert "but too little to matter" not in page(none, tmp_path).text


@pytest.mark.usefixtures("undrawn")
def test_assumed_noise_is_admitted(bench: Maker, tmp_path: Path) -> None:
    diagnosis = bench.nothing()
    noise = replace(diagnosis.noise, source="assumed")
    diagnosis = replace(diagnosis, nominal=replace(diagnosis.nominal, noise=noise))
    assert "the noise level is assumed" in page(diagnosis, tmp_path).text


@pytest.mark.usefixtures("undrawn")
def test_motions_that_come_late_are_admitted(bench: Maker, tmp_path: Path) -> None:
    diagnosis = bench.nothing()
    noise = replace(diagnosis.noise, late=0.012)
    diagnosis = replace(diagnosis, nominal=replace(diagnosis.nominal, noise=noise))
    assert "a motion comes earlier or later by ±12 ms" in page(diagnosis, tmp_path).text


@pytest.mark.usefixtures("undrawn")
def test_what_a_met_stop_hides_is_told_where_nothing_was_found(tmp_path: Path) -> None:
    """A torque that falls with speed may show in the swing back from a drop, and nowhere else."""
    calm = Maker(RobotDescription.load("darwin_leg"), most=30).nothing()
    assert not document(calm, "corrected")["reason"]
    first, *rest = calm.measured.recordings
    position = first.position.copy()
    position[:, first.joints.index("l_knee")] = np.where(np.arange(120) < 90, -0.5, 0.5)
    measured = replace(calm.measured, recordings=(replace(first, position=position), *rest))
    fell = replace(calm, measured=measured)
    told = f"not judged, as a joint met its stop: 0.3 s after that in {first.id}"
    assert document(fell, "corrected")["reason"] == told
    assert f"which is not judged: one did in {first.id}." in page(fell, tmp_path).text
    assert "met its stop" not in page(calm, tmp_path).text


@pytest.mark.usefixtures("undrawn")
def test_recordings_that_were_left_out_are_told(backlash: Diagnosis, tmp_path: Path) -> None:
    shown = page(replace(backlash, lost=("r1", "r7")), tmp_path)
    assert "Recordings r1 and r7 were left out: nothing that was found" in shown.text
    assert "left out: nothing that was found" not in page(backlash, tmp_path).text


@pytest.mark.usefixtures("undrawn")
def test_substeps_that_were_halved_are_told(backlash: Diagnosis, tmp_path: Path) -> None:
    step = backlash.robot.timestep
    shown = page(replace(backlash, too_long=2 * step), tmp_path)
    assert f"sub-steps of {2e3 * step:g} ms are too long" in shown.text
    assert f"simulated in sub-steps of {1e3 * step:g} ms" in shown.text
    assert "too long" not in page(backlash, tmp_path).text
    assert document(backlash, "corrected")["timestep"] == step


@pytest.mark.usefixtures("undrawn")
def test_an_error_that_nothing_explains_is_admitted(bench: Maker, tmp_path: Path) -> None:
    shown = page(bench.nothing(2.9), tmp_path)
    assert "No known effect is missing, but the simulator is off by 2.9 times" in shown.text
    assert "will do for motions like these" not in shown.text


@pytest.mark.usefixtures("undrawn")
def test_report_of_undetermined(bench: Maker, tmp_path: Path) -> None:
    diagnosis = bench.nothing()
    nominal = replace(diagnosis.nominal, certificate=Certificate((100.0, 250.0), False, 0.0))
    bare = replace(
        diagnosis,
        verdict="undetermined",
        reason="the nominal fit does not settle",
        nominal=nominal,
        held_out=None,
        model=None,
        found=(),
        enough=0.0,
    )
    shown = page(bare, tmp_path)
    assert "These recordings cannot tell whether anything is missing." in shown.text
    assert "The nominal fit does not settle." in shown.text
    assert "Record at least two types of motion" in shown.text
    assert "do not agree" in shown.text
    assert headings(shown) == ["Where", "When the model is off", "The nominal fit"]
    advised = page(bare, tmp_path, {"next_recording": NEXT})
    assert "Record at least two types of motion" not in advised.text
    assert "a slow triangle" in advised.text
    unfitted = replace(nominal, certificate=Certificate((100.0,), False, 0.0))
    shown = page(replace(bare, nominal=unfitted), tmp_path)
    assert "Nothing was fitted" in shown.text and "do not agree" not in shown.text
    assert "robot as it is described" in shown.text and "not made" in shown.text
    assert "Nominal parameters, with" not in shown.text


@pytest.mark.usefixtures("undrawn")
def test_a_finding_that_was_not_added_is_told(backlash: Diagnosis, tmp_path: Path) -> None:
    chosen = replace(backlash.rounds[0], holding=0)
    before = chosen.before
    shown = page(
        replace(backlash, verdict="none", findings=(), model=before, rounds=(chosen,)), tmp_path
    )
    assert "Closest was gear backlash at the left knee" in shown.text


@pytest.mark.usefixtures("undrawn")
def test_one_effect_at_two_places_is_one_item(backlash: Diagnosis, tmp_path: Path) -> None:
    first = backlash.findings[0]
    second = replace(first, place=Place("joint", "l_hip_yaw"))
    shown = page(replace(backlash, findings=(first, second)), tmp_path)
    assert "The simulator lacks backlash at the left knee and left hip yaw." in shown.text
    assert "Your fit hid them in" in shown.text
    assert "The left hip yaw loses" in shown.text
    assert shown.text.count("makes up for them by the damping kd of the hip (31 % too high)") == 1


@pytest.mark.usefixtures("undrawn")
def test_what_is_less_likely_than_not_is_told_as_such(backlash: Diagnosis, tmp_path: Path) -> None:
    first = backlash.findings[0]
    drag = replace(first, effect="quadratic_damping", probability=0.3, equivalents=())
    shown = page(replace(backlash, findings=(first, drag)), tmp_path)
    assert "The simulator lacks backlash at the left knee, perhaps 1 more." in shown.text
    assert "2Perhaps: " in shown.text
    assert "1Perhaps: " not in shown.text
    unsure = (replace(first, probability=0.4, equivalents=()), drag)
    assert (
        "Perhaps the simulator lacks 2 effects."
        in page(replace(backlash, findings=unsure), tmp_path).text
    )


@pytest.mark.usefixtures("undrawn")
def test_several_effects_are_listed_with_their_numbers(backlash: Diagnosis, tmp_path: Path) -> None:
    first = backlash.findings[0]
    drags = [
        replace(first, effect="quadratic_damping", place=Place("group", g), absorbed_by={})
        for g in ("hip", "ankle")
    ]
    shown = page(replace(backlash, findings=(first, *drags)), tmp_path)
    assert "The simulator lacks 2 effects." in shown.text
    items = [
        "1The left knee loses 0.92° at every load reversal: gear backlash.",
        "23Quadratic damping at the hip and ankle joints: "
        "a drag that grows with the square of the speed.",
    ]
    assert "".join(items) in shown.text
    assert "Without it, the nominal fit makes up for it by the damping kd" in shown.text


@pytest.mark.usefixtures("undrawn")
def test_a_likely_finding_is_told_as_such(backlash: Diagnosis, tmp_path: Path) -> None:
    unsure = replace(backlash.findings[0], probability=0.5)
    shown = page(replace(backlash, findings=(unsure,)), tmp_path)
    assert "Most likely: The left knee loses" in shown.text
    doubtful = replace(backlash.findings[0], probability=0.3, equivalents=())
    shown = page(replace(backlash, findings=(doubtful,)), tmp_path)
    assert "Perhaps: The left knee loses" in shown.text


@pytest.mark.parametrize("name", built_in_robots())
def test_robots_are_drawn(name: str) -> None:
    robot = RobotDescription.load(name)
    joint = robot.joint_names[0]
    places = [Place("joint", joint), Place("joint", joint), Place("group", robot.groups[0])]
    places += [Place(kind) for kind in ("bus", "robot", "ground", "sensor")]
    places += [Place("foot", foot) for foot in robot.feet]
    places += [Place("body", robot.torso)] if robot.torso else []
    with drawing_style():
        support = "suspended" if robot.floating else "bench"
        drawing = draw_robot(robot, support, places, {joint: 3.0})
    texts = "".join(ElementTree.fromstring(drawing.svg).itertext())
    assert all(str(number) in texts for number in range(1, len(places) + 1))
    assert drawing.width == pytest.approx(442, abs=1)


def test_why_finalists_fell_behind(backlash: Diagnosis) -> None:
    best, other = summary.rivals(backlash.rounds[0], backlash)
    assert "less of motions left out" in summary.why_behind(other, best)
    lost = replace(other, outside=0.1 * other.inside)
    assert summary.why_behind(lost, best) == "fits these motions but does not predict others"
    near = replace(other, probability=0.2)
    assert summary.why_behind(near, best) == "explains about as much"
    same = replace(near, score=best.score)
    assert "hardly to be told apart: 100 %" in summary.why_behind(same, best)
