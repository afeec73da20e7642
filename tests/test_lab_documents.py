"""What pages read of recordings and of jobs' documents, and how they draw it."""

import asyncio
import json
import math
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import gateways
import httpx
import numpy as np
import pytest
import stored_findings
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

pytest.importorskip("fastapi")
pytest.importorskip("botorch")

from pup.errors import InputError
from services.gateway import artefacts, charts, drawing, recordings
from services.gateway.documents import BoundsDocument, DiagnosisDocument, TrainingDocument
from services.gateway.recordings import Shelves
from services.job_folder import folder_of, inside

BOUNDS: dict[str, Any] = {
    "schema": 1,
    "robot": "arm",
    "actuator": {"kind": "pd"},
    "parameters": [
        {
            "name": "kp",
            "unit": "N m/rad",
            "nominal": 2.0,
            "lower": 1.0,
            "upper": 3.0,
            "search": [0.0, 10.0],
        }
    ],
    "loss": {"train": {"rmse": 0.01}, "held_out": None},
}
FINDING: dict[str, Any] = {
    "effect": "backlash",
    "place": {"kind": "joint", "names": ["knee"]},
    "probability": 0.9,
}
DIAGNOSIS: dict[str, Any] = {
    "schema": 1,
    "robot": "arm",
    "verdict": "mismatch",
    "noise_floor": {"rms": 0.002, "source": "repeats"},
    "findings": [FINDING],
}


@given(hnp.arrays(float, st.integers(1, 3000), elements=st.floats(-1e3, 1e3)), st.integers(4, 500))
def test_a_thinned_line_keeps_its_ends_and_extremes(y: np.ndarray, most: int) -> None:
    x = np.arange(len(y), dtype=float)
    xs, ys = charts.thinned(x, y, most)
    assert len(xs) <= most + 3 and (np.diff(xs) > 0).all()
    assert xs[0] == x[0] and xs[-1] == x[-1] and (y[xs.astype(int)] == ys).all()
    assert ys.min() == y.min() and ys.max() == y.max()


def test_gaps_are_gaps_and_sparse_samples_are_joined() -> None:
    """The encoder's pause parts its line; a current that is read every other tick is one line."""
    position, current = charts.joint(stored_findings.currents(), 0)
    assert position.count('class="position"') == 2 and position.count('class="command"') == 1
    assert current.count('class="current"') == 1
    assert "nan" not in position + current


def test_a_command_is_drawn_as_long_as_it_holds() -> None:
    """Logs may tell commands only where they change; the last one holds to the end."""
    told = stored_findings.currents()
    target = np.full_like(told.target, np.nan)
    target[[0, 1, 2, 500]] = [[0.0], [0.1], [0.2], [0.4]]
    (picture, _) = charts.joint(replace(told, target=target), 0)
    (line,) = re.findall(r'class="command" points="([^"]+)"', picture)
    x, y = np.array([[float(v) for v in p.split(",")] for p in line.split()]).T
    right = charts.WIDTH - drawing.RIGHT
    assert (x[0], x[-1]) == (drawing.LEFT, right) and y[-1] == y.min()
    flat = np.diff(x) > 0
    assert (np.diff(y)[flat] == 0).all() and (np.diff(x)[~flat] == 0).all()


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=5, max_size=5))
def test_any_finite_bounds_can_be_drawn(values: list[float]) -> None:
    names = ("nominal", "lower", "upper")
    told = BOUNDS["parameters"][0] | dict(zip(names, values, strict=False)) | {"search": values[3:]}
    document = BoundsDocument.model_validate(BOUNDS | {"parameters": [told]})
    drawn = charts.bounds(document.parameters[0], document)
    places = [float(x) for x in re.findall(r' (?:x|x1|x2)="([^"]+)"', drawn)]
    assert places and all(0 <= x <= charts.RANGE_WIDTH for x in places if math.isfinite(x))


@given(st.lists(st.none() | st.floats(allow_nan=False, allow_infinity=False), max_size=40))
def test_any_curve_can_be_drawn(values: list[float | None]) -> None:
    told = stored_findings.curve(max(1, len(values)))
    told["curve"]["return"] = values or [None]
    document = TrainingDocument.model_validate(told)
    assert len(charts.curves(document.curve)) == 3


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({}, "The simulator lacks backlash at joint knee."),
        ({"findings": [FINDING | {"probability": 0.3}]}, "Perhaps the simulator lacks"),
        ({"findings": [FINDING | {"probability": 0.6}]}, "Most likely the simulator lacks"),
        (
            {"findings": [FINDING, FINDING | {"effect": "encoder_bias"}]},
            "The simulator lacks backlash and encoder bias.",
        ),
        (
            {"findings": [FINDING, FINDING | {"effect": "unknown", "probability": 0.2}]},
            "The simulator lacks backlash at joint knee, and more that has no name.",
        ),
        ({"findings": [FINDING | {"effect": "unknown"}]}, "no known effect explains"),
        ({"verdict": "none", "findings": []}, "Nothing material is missing beyond a noise of 2 m"),
        ({"verdict": "undetermined", "findings": []}, "cannot tell"),
    ],
)
def test_verdicts_in_a_sentence(changed: dict[str, Any], sentence: str) -> None:
    assert sentence in DiagnosisDocument.model_validate(DIAGNOSIS | changed).summary


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("", "EOF"),
        ("[]", "object"),
        ("[" * 100_000, ""),
        (json.dumps(BOUNDS | {"schema": 2}), "schema: "),
        (json.dumps(BOUNDS | {"robot": "x" * 501}), "robot: "),
        (json.dumps(BOUNDS | {"parameters": [{"name": "kp"}]}), "parameters.0"),
        (json.dumps(BOUNDS).replace("2.0", "NaN"), "parameters.0.nominal"),
        (json.dumps(BOUNDS).replace("2.0", "1e999"), "parameters.0.nominal"),
        (b"\xff\xfe\x00", ""),
    ],
)
def test_a_broken_document_is_one_line(tmp_path: Path, content: str | bytes, told: str) -> None:
    file = tmp_path / "bounds.json"
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError) as error:
        artefacts.read(file, BoundsDocument)
    assert told in str(error.value) and "\n" not in str(error.value)


def test_documents_are_read_anew_when_they_change(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "bounds.json"
    file.write_text(json.dumps(BOUNDS))
    first = artefacts.read(file, BoundsDocument)
    assert artefacts.read(file, BoundsDocument) is first
    stored_findings.as_json(file, robot="another")
    assert artefacts.read(file, BoundsDocument).robot == "another"
    monkeypatch.setattr(artefacts, "LIMIT", 10)
    with pytest.raises(InputError, match="larger than 10 bytes"):
        artefacts.read(file, BoundsDocument)


def test_documents_are_those_of_a_job_and_of_its_stages(tmp_path: Path) -> None:
    job = stored_findings.job("one", "run")
    out = folder_of(tmp_path, job.id).out
    for name in ("bounds.json", "presysid/bounds.json", "deep/er/bounds.json"):
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text(json.dumps(BOUNDS))
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "bounds.json").write_text(json.dumps(BOUNDS))
    (out / "link").symlink_to(tmp_path / "other")
    (out / "presysid" / "report.html").write_text("")
    found = artefacts.of_job(artefacts.BOUNDS, job, tmp_path)
    assert [a.name for a in found] == ["bounds.json", "presysid/bounds.json"]
    assert [a.report for a in found] == ["", "presysid/report.html"]
    assert artefacts.of_jobs(artefacts.BOUNDS, [job], tmp_path) == found
    assert artefacts.of_jobs(artefacts.TRAINING, [job], tmp_path) == []


@given(st.text(max_size=300))
def test_no_name_leads_out_of_a_folder(name: str) -> None:
    folder = Path(__file__).parent / "golden"
    path = inside(folder, name)
    assert path is None or (path.is_file() and path.resolve().parent == folder.resolve())


@pytest.mark.parametrize(
    "name", ["../conftest.py", "/etc/hostname", "a/../../conftest.py", "x" * 5000, "a\0b", ".", ""]
)
def test_ways_out_are_no_files(name: str) -> None:
    assert inside(Path(__file__).parent / "golden", name) is None


def test_recordings_are_listed_with_what_is_wrong_with_them(tmp_path: Path) -> None:
    stored_findings.currents().write(tmp_path / "b" / "currents.parquet")
    (tmp_path / "a.parquet").write_bytes(b"PAR1")
    (tmp_path / "notes.txt").write_text("none")
    (tmp_path / "z.parquet").symlink_to(tmp_path / "b" / "currents.parquet")
    listing = Shelves({"lab": tmp_path}).listed("lab")
    listed = listing.shown
    assert [r.name for r in listed] == ["a.parquet", "b/currents.parquet"]
    assert (listing.end, listing.count) == (2, "2")
    assert "not a readable Parquet file" in listed[0].trouble
    assert str(tmp_path) not in listed[0].trouble
    header = listed[1].header
    assert header and header.joints == ("servo",) and header.rate == pytest.approx(100)


@given(st.integers(0, 25), st.integers(1, 10), st.integers(1, 40))
def test_pages_of_a_list_have_every_recording_once(
    tmp_path_factory: pytest.TempPathFactory, count: int, listed: int, looked: int
) -> None:
    """And say how many there are; of more files than are looked at, that there may be more."""
    folder = tmp_path_factory.mktemp("lab")
    names = [f"{number:02}.parquet" for number in range(count)]
    for name in names:
        (folder / name).touch()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recordings, "LISTED", listed)
        patch.setattr(recordings, "LOOKED", looked)
        shelves, seen, at = Shelves({"lab": folder}), [], 0
        while True:
            page = shelves.listed("lab", at)
            assert page.skipped == at and len(page.shown) <= listed
            seen, at = [*seen, *(r.name for r in page.shown)], page.end
            if at >= page.total:
                break
        assert seen == names[:looked]
        assert page.count == (f"{count}" if count <= looked else f"{looked} or more")
        assert shelves.listed("lab", 99).skipped == 0


def test_a_page_of_recordings_leads_to_the_next_one(tmp_path: Path) -> None:
    """And says how many there are, as the first page of all does."""
    lab = tmp_path / "lab"
    lab.mkdir()
    for number in range(recordings.LISTED + 2):
        (lab / f"{number:03}.parquet").touch()
    with gateways.running(tmp_path / "data", RECORDINGS=str(lab)) as service:
        with service.client("viewer") as http:
            assert "502" in http.get("/").text
            first = http.get("/recordings").text
            assert "1 to 500 of 502" in first and "500.parquet" not in first
            (way,) = re.findall(r'href="([^"]*)">the next ones', first)
            second = http.get(way).text
            assert "501 to 502 of 502" in second and "the next ones" not in second
            assert re.findall(r'href="/recordings/lab/([^"]*)"', second) == [
                *("500.parquet", "501.parquet"),
            ]
            assert http.get("/recordings/nowhere").status_code == 404
            assert http.get("/recordings/lab?skip=-1").status_code == 422
        assert httpx.get(f"{service.url}/recordings/lab").status_code == 303


def test_a_file_s_name_that_no_page_can_hold_does_not_hide_the_others(tmp_path: Path) -> None:
    stored_findings.currents().write(tmp_path / "currents.parquet")
    (tmp_path / os.fsdecode(b"gr\xf6\xdfe.parquet")).write_bytes(b"PAR1")
    first, second = Shelves({"lab": tmp_path}).listed("lab").shown
    assert first.header and second.trouble == "its name is not UTF-8; rename it"
    assert second.name.encode().decode() == "gr\ufffd\ufffde.parquet"


def test_a_folder_that_may_be_read_and_not_entered_does_not_hide_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stored_findings.currents().write(tmp_path / "currents.parquet")
    shut = tmp_path / "shut"
    stored_findings.currents().write(shut / "more.parquet")
    real = os.stat

    def stat(path: Any, *args: Any, **options: Any) -> os.stat_result:
        if str(path).startswith(f"{shut}/"):  # to root, who runs some tests, nothing is shut
            raise PermissionError(13, "Permission denied")
        return real(path, *args, **options)

    monkeypatch.setattr(os, "stat", stat)
    assert [r.name for r in Shelves({"lab": tmp_path}).listed("lab").shown] == ["currents.parquet"]


def test_a_recording_that_is_too_large_is_not_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stored_findings.currents().write(tmp_path / "currents.parquet")
    shelves = Shelves({"lab": tmp_path})
    assert asyncio.run(shelves.read(shelves.file("lab", "currents.parquet"))).id == "currents"
    monkeypatch.setattr(recordings, "CELLS", 100)
    with pytest.raises(InputError, match="recordings of up to 100 are drawn"):
        asyncio.run(shelves.read(shelves.file("lab", "currents.parquet")))
