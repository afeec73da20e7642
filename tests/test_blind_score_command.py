"""The scorer's command, its table, and what it refuses."""

import json
from pathlib import Path

import pytest
from blind_scores import (
    CASES,
    reveal,
    scored,
    verdict,
)
from commandline import pup

from pup.blind.score import score_set
from pup.errors import InputError
from pup.files import write_json


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


def test_a_folder_without_verdicts_is_refused(tmp_path: Path) -> None:
    revealed = reveal(tmp_path, CASES)
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(InputError, match="no case_<id>"):
        score_set(revealed / "set", revealed / "key.json", empty)
    write_json(empty / "case_other" / "diagnosis.json", verdict("none"))
    with pytest.raises(InputError, match="of a case of this set"):
        score_set(revealed / "set", revealed / "key.json", empty)
