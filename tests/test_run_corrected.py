"""`pup run` beyond the diagnosis: the robot as it was found to be is identified again."""

import json
from pathlib import Path
from typing import Any

import pytest
from blind_sets import FRICTION, motions
from commandline import briefly_polished, files, pup
from jobs import Job

from pup.files import sha256
from pup.physics.parameters import robot_space
from pup.recording import write_recordings
from pup.robot import RobotDescription
from tests.reports import Page

FITS = (
    *("--local", "--cores", 1, "--population", 8, "--generations", 10, "--subsets", 2),
    *("--subset-generations", 2, "--actuator", "pd", "--effects", 1),
)
STAGES = ["presysid", "replay", "diagnosis", "corrected-presysid", "corrected-replay"]


@pytest.fixture(scope="module")
def command(tmp_path_factory: pytest.TempPathFactory) -> tuple[object, ...]:
    """`pup run` on recordings of a servo with friction that no simulator of ours knows."""
    folder = tmp_path_factory.mktemp("recordings")
    write_recordings(motions(FRICTION)[0], folder)
    return ("run", "--robot", "servo_bench", "--recordings", folder, *FITS)


def results(out: Path) -> dict[str, Any]:
    """What the stages found, but for times and places."""
    told = {}
    for name in ("presysid/bounds.json", "corrected/presysid/bounds.json"):
        document = json.loads((out / name).read_text())
        told[name] = document["parameters"], document["loss"]
    found = json.loads((out / "diagnosis/diagnosis.json").read_text())
    return told | {"findings": found["findings"]}


@pytest.fixture(scope="module")
def whole(command: tuple[object, ...], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What an undisturbed run leaves; its fits end sooner than those of another process."""
    out = tmp_path_factory.mktemp("whole")
    with briefly_polished():
        done = pup(*command, "--out", out)
    assert done.code == 0, done.err
    return out


def test_what_is_missing_is_found_and_the_corrected_robot_replays_better(
    command: tuple[object, ...], whole: Path
) -> None:
    before = files(whole)
    done = pup(*command, "--out", whole, "--json")
    assert (done.code, done.err) == (0, "")  # all is kept
    assert files(whole) == before
    told = done.json()
    assert list(told["took"]) == STAGES
    assert told["left_out"].keys() == {"train", "transfer"}
    assert "friction" in told["diagnosis"]["findings"][0]["effect"]
    assert told["corrected-replay"]["rmse"] < 0.7 * told["replay"]["rmse"]
    robot = RobotDescription.load(str(whole / "diagnosis" / "corrected"))
    digest = told["corrected-presysid"]["provenance"]["robot_digest"]
    assert robot.terms and digest == robot.digest
    added = {(t.effect, t.kind): t.values for t in robot.terms}
    for finding in json.loads((whole / "diagnosis/diagnosis.json").read_text())["findings"]:
        values = added.get((finding["effect"], finding["place"]["kind"]), {})
        for name in values.keys() & finding["parameters"].keys():
            assert finding["parameters"][name]["value"] == pytest.approx(values[name])


def test_the_values_of_the_diagnosis_stay_and_bounds_are_found_around_them(whole: Path) -> None:
    robot = RobotDescription.load(str(whole / "diagnosis" / "corrected"))
    space = robot_space(robot, "pd")
    described = dict(zip(space.names, space.nominal, strict=True))
    told = json.loads((whole / "corrected/presysid/bounds.json").read_text())
    for p in told["parameters"]:
        assert p["nominal"] == pytest.approx(described[p["name"]], rel=1e-12)
        assert p["lower"] <= p["nominal"] <= p["upper"] and p["lower"] < p["upper"]
    assert told["loss"]["train"]["loss"] == told["loss"]["train"]["loss_before"]


def test_the_report_ties_both_halves_to_their_inputs(whole: Path) -> None:
    page = Page(whole / "report.html")
    journal = json.loads((whole / "run.json").read_text())["stages"]
    assert list(journal) == [*STAGES, "report"]
    for name in STAGES:
        for file, digest in journal[name]["files"].items():
            assert sha256(whole / file) == digest and digest in page.text
    links = [told["href"] for name, told in page.elements if name == "a"]
    assert {"diagnosis/report.html", "corrected/presysid/report.html"} <= set(links)
    assert all((whole / link).is_file() for link in links if not link.startswith("#"))


@pytest.mark.slow
def test_killed_while_it_looks_and_while_it_corrects_it_ends_the_same(
    command: tuple[object, ...], tmp_path: Path
) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert pup(*command, "--out", whole).code == 0
    for moment in ("diagnosis/checkpoints/*.f32", "corrected/presysid/checkpoints/subsets-*/*.npz"):
        job = Job(*command, out=parts)
        job.come_to(moment)
        job.process.kill()
        job.end()
        job.assert_nothing_left()
    assert pup(*command, "--out", parts).code == 0
    assert results(parts) == results(whole)


@pytest.mark.usefixtures("short_polish")
def test_where_nothing_is_missing_there_is_no_second_half(tmp_path: Path) -> None:
    recordings = tmp_path / "recordings"
    write_recordings(motions({})[0], recordings)
    command = ("run", "--robot", "servo_bench", "--recordings", recordings, *FITS)
    done = pup(*command, "--out", tmp_path / "out", "--json")
    assert done.code == 0, done.err
    told = done.json()
    assert told["diagnosis"]["verdict"] == "none"
    assert told["left_out"]["corrected"] == "nothing to correct was found"
    assert list(told["took"]) == STAGES[:3]
