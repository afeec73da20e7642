"""The scorer's command, its table, and what it refuses."""

import json
from pathlib import Path
from typing import Any

import pytest
from blind_scores import (
    CASES,
    KNEE,
    SPAN,
    TORQUE,
    finding,
    named,
    reveal,
    scored,
    verdict,
)
from commandline import files, pup

from pup.blind.score import score_set
from pup.errors import InputError
from pup.files import write_json

NO_NUMBER = {"torque": TORQUE["torque"] | {"value": float("nan")}}


def test_the_command_writes_scores_and_a_table(tmp_path: Path) -> None:
    revealed = reveal(tmp_path, CASES)
    options = ("--set", revealed / "set", "--key", revealed / "key.json")
    where = ("--diagnoses", revealed / "diagnoses", "--out", revealed / "scores.json")
    done = pup("blind", "score", *options, *where, "--json")
    assert done.code == 0 and done.json()["cases"] == 10
    table = (revealed / "scores.md").read_text()
    assert "| detected | 0.67 (4/6) |" in table
    assert "| false positives | 0.50 (1/2) |" in table
    assert table.count("no diagnosis") == 1
    assert "| class, first, nuisances that are there counted as true | 0.60 (3/5) |" in table
    assert json.loads((revealed / "scores.json").read_text())["all"]["detected"]["hits"] == 4


def test_verdicts_that_break_the_contract_are_refused(tmp_path: Path) -> None:
    revealed = reveal(tmp_path, CASES)
    broken = revealed / "diagnoses" / "case_a" / "diagnosis.json"
    write_json(broken, verdict("mismatch", {"effect": "cogging"}))
    with pytest.raises(InputError, match="does not follow the contract"):
        scored(revealed)
    write_json(broken, {"schema": 2})
    with pytest.raises(InputError, match="not a diagnosis"):
        scored(revealed)


@pytest.mark.parametrize(
    "broken",
    [
        verdict("Mismatch"),
        verdict("mismatch", robot="servo_bench"),
        verdict("mismatch", 1),
        verdict("mismatch", finding("cogging", KNEE, 7.0)),
        verdict("mismatch", finding("cogging", KNEE, float("nan"))),
        verdict(
            "mismatch", finding("cogging", KNEE, 0.9, equivalents=[named("backlash", KNEE, -1)])
        ),
        verdict("mismatch", finding("coulomb_friction", KNEE, 0.9, parameters=NO_NUMBER)),
        verdict("mismatch", finding("cogging", KNEE, 0.9, when=[{**SPAN, "end": float("inf")}])),
        verdict("mismatch", finding("coulomb_friction", KNEE, 0.9), next_recording="hold"),
    ],
)
def test_what_would_count_as_something_else_is_refused(tmp_path: Path, broken: Any) -> None:
    """Or would be told only when all has been scored, as what is no JSON."""
    revealed = reveal(tmp_path, CASES)
    told = revealed / "diagnoses" / "case_a" / "diagnosis.json"
    told.write_text(json.dumps(broken))
    with pytest.raises(InputError, match=r"case_a/diagnosis\.json: does not follow the contract"):
        scored(revealed)


@pytest.mark.parametrize("name", ["key.json", "set/scores.json", "diagnoses/run.json"])
def test_scores_do_not_take_the_place_of_what_is_scored(tmp_path: Path, name: str) -> None:
    revealed = reveal(tmp_path, CASES)
    before = files(revealed)
    options = ("--set", revealed / "set", "--key", revealed / "key.json")
    where = ("--diagnoses", revealed / "diagnoses", "--out", revealed / name)
    done = pup("blind", "score", *options, *where)
    assert done.code == 2 and "use another --out" in done.err
    assert files(revealed) == before


def test_a_folder_without_verdicts_is_refused(tmp_path: Path) -> None:
    revealed = reveal(tmp_path, CASES)
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(InputError, match="no case_<id>"):
        score_set(revealed / "set", revealed / "key.json", empty)
    write_json(empty / "case_other" / "diagnosis.json", verdict("none"))
    with pytest.raises(InputError, match="of a case of this set"):
        score_set(revealed / "set", revealed / "key.json", empty)
