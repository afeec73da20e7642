"""The scorer, on made-up verdicts whose scores can be told by hand."""

import json
from pathlib import Path
from typing import Any

import pytest
from commandline import pup

from pup.blind.judge import ranking
from pup.blind.score import Replayed, score_set
from pup.blind.seal import commit, write_key
from pup.blind.statistics import calibration, rate
from pup.errors import InputError
from pup.files import write_json

SIGMA = 0.002


def place(kind: str, *names: str) -> dict[str, Any]:
    return {"kind": kind, "names": list(names)}


def effect(name: str, where: dict[str, Any], size: float = 0.1, unit: str = "N m") -> Any:
    return {
        "effect": name,
        "place": where,
        "size": {"name": "size", "value": size, "unit": unit},
        "besides": [],
        "comparable": name != "unknown",
    }


def case(name: str, stratum: str, *effects: Any, **changes: Any) -> dict[str, Any]:
    null = stratum.startswith("null:")
    return {
        "id": name,
        "robot": "darwin_op2",
        "stratum": stratum,
        "effects": list(effects),
        "noise": {"sigma": SIGMA},
        "answer": {"verdicts": ["none"] if null else ["mismatch"], "set": []},
        "all_seen": {"material": not null, "when": []},
    } | changes


def named(name: str, where: dict[str, Any], probability: float, **more: Any) -> dict[str, Any]:
    return {"effect": name, "place": where, "probability": probability} | more


def finding(name: str, where: dict[str, Any], probability: float, **more: Any) -> dict[str, Any]:
    whole = {"equivalents": [], "parameters": {}, "when": [], "law": None}
    return named(name, where, probability, **(whole | more))


def verdict(kind: str, *findings: Any, **more: Any) -> dict[str, Any]:
    document = {"schema": 1, "verdict": kind, "findings": list(findings), "next_recording": None}
    return document | more


KNEE, HIP, BUS = place("joint", "l_knee"), place("joint", "l_hip_pitch"), place("bus", "bus")
SPAN = {"recording": "r01", "start": 0.0, "end": 2.0}
TORQUE = {"torque": {"value": 0.08, "unit": "N m", "ci90": [0.05, 0.09]}}
CASES = [
    (
        case("a", "single", effect("coulomb_friction", KNEE), all_seen={"when": [SPAN]}),
        verdict(
            "mismatch",
            finding(
                *("coulomb_friction", KNEE, 0.9),
                parameters=TORQUE,
                when=[{**SPAN, "start": 1.0, "end": 3.0}],
            ),
        ),
    ),
    (
        case("b", "below_noise", effect("backlash", HIP, unit="rad")),
        verdict(
            "mismatch",
            finding(
                *("dead_band", place("joint", "r_hip_pitch"), 0.6),
                equivalents=[named("backlash", HIP, 0.3)],
            ),
            next_recording={"motion": "hold"},
        ),
    ),
    (case("c", "masked", effect("voltage_sag", BUS, unit="ohm")), verdict("none")),
    (
        case(
            "d", "pair", effect("coulomb_friction", KNEE), effect("command_delay", BUS, 0.01, "s")
        ),
        verdict(
            "mismatch",
            finding("command_delay", place("robot", "darwin_op2"), 0.8),
            finding("payload", place("body", "body"), 0.7),
            finding("coulomb_friction", KNEE, 0.5),
        ),
    ),
    (case("e", "single", effect("cogging", KNEE)), None),
    (
        case(
            *("u", "unidentifiable", effect("command_delay", BUS, 0.01, "s")),
            answer={"verdicts": ["mismatch"], "set": ["command_delay", "measurement_delay"]},
        ),
        verdict("mismatch", finding("measurement_delay", BUS, 0.95)),
    ),
    (
        case("o", "unlisted", effect("unknown", KNEE)),
        verdict("mismatch", finding("unknown", KNEE, 0.6, law="-0.3 tanh(qdot)")),
    ),
    (case("n1", "null:noise"), verdict("none")),
    (case("n2", "null:engine"), verdict("mismatch", finding("cogging", KNEE, 0.7))),
    (
        case("n3", "null:nuisance", all_seen={"material": True, "when": []}),
        verdict("mismatch", finding("cogging", KNEE, 0.7)),
    ),
]


@pytest.fixture
def revealed(tmp_path: Path) -> Path:
    """A set under `set`, its `key.json` and the verdicts under `diagnoses`."""
    (tmp_path / "set").mkdir()
    write_key(tmp_path / "key.json", {"schema": 1, "salt": "ab", "cases": [c for c, _ in CASES]})
    commit(tmp_path / "set", tmp_path / "key.json", {"darwin_op2": len(CASES)})
    for truth, told in CASES:
        if told is not None:
            write_json(tmp_path / "diagnoses" / f"case_{truth['id']}" / "diagnosis.json", told)
    return tmp_path


def scored(folder: Path, **more: Any) -> dict[str, Any]:
    return score_set(folder / "set", folder / "key.json", folder / "diagnoses", **more)


def test_rates_are_those_counted_by_hand(revealed: Path) -> None:
    scores = scored(revealed)
    everything = scores["all"]
    hits = {name: (v["hits"], v["of"]) for name, v in everything.items() if "hits" in v}
    assert hits["detected"] == (4, 6)
    assert hits["exact_top1"] == (2, 5)
    assert hits["exact_top3"] == (3, 5)
    assert hits["class_top1"] == hits["class_top3"] == (3, 5)
    assert hits["pairs_both_in_top3"] == (1, 1)
    assert hits["set_covers"] == (4, 5)
    assert hits["unlisted_flagged"] == (1, 1)
    assert hits["listed_flagged_unknown"] == (0, 5)
    assert hits["unidentifiable_allowed"] == (0, 1)
    assert hits["parameter_in_ci90"] == (0, 1)
    assert hits["ambiguous_with_next_recording"] == (1, 1)
    assert everything["parameter_error"]["mean"] == pytest.approx(0.2)
    assert everything["place_top1"] == {"of": 4, "mean": 0.625, "median": 0.75}
    assert everything["set_size"]["mean"] == pytest.approx(6 / 5)
    assert everything["regime_f1"] == {"of": 1, "mean": 0.5, "median": 0.5}
    assert (scores["cases"], scores["missing"]) == (10, 1)


def test_nulls_with_material_nuisance_are_no_false_positives(revealed: Path) -> None:
    nulls = scored(revealed)["nulls"]
    assert (nulls["false_positives"]["hits"], nulls["false_positives"]["of"]) == (1, 2)
    assert (nulls["material_nuisance"]["hits"], nulls["material_nuisance"]["of"]) == (1, 1)


def test_every_failure_is_listed(revealed: Path) -> None:
    failures = {f["case"]: f["faults"] for f in scored(revealed)["failures"]}
    assert failures == {
        "b": ["wrong effect of the class", "wrong place"],
        "c": ["missed"],
        "e": ["no diagnosis"],
        "u": ["sharp name where the data cannot tell"],
        "n2": ["false positive"],
    }


def test_among_equals_the_order_of_the_document_counts() -> None:
    """A finding, then its equivalents, then the next one; names have no say."""
    told = verdict(
        "mismatch",
        finding(
            *("quadratic_damping", KNEE, 0.5),
            equivalents=[named("torque_speed_limit", KNEE, 0.5), named("backlash", HIP, 0.5)],
        ),
        finding("payload", KNEE, 0.9),
        finding("clock_skew", BUS, 0.5, equivalents=[named("armature", KNEE, 0.2)]),
    )
    assert [n.effect for n in ranking(told)] == [
        *("payload", "quadratic_damping", "torque_speed_limit", "backlash"),
        *("clock_skew", "armature"),
    ]


def test_calibration_over_the_cases_that_name_something(revealed: Path) -> None:
    told = scored(revealed)["calibration"]
    # a .9 right, b .9 right (both of one class), d .8 right, u .95 right, o .6 right, n2 .7 wrong
    assert told["of"] == 6
    misses = [0.1, 0.1, 0.2, 0.05, 0.4, 0.7]
    assert told["brier"] == pytest.approx(sum(m**2 for m in misses) / 6)
    assert told["ece"] == pytest.approx((0.25 + 0.2 + 0.4 + 0.7) / 6)


def test_oracle_ratio_asks_for_a_replay_of_the_test_motions(revealed: Path, leg_recordings) -> None:
    for letter in "ab":
        (revealed / "diagnoses" / f"case_{letter}" / "corrected").mkdir()
    tests = revealed / "set" / "case_a" / "test"
    tests.mkdir(parents=True)
    for file in leg_recordings.glob("*.parquet"):
        (tests / file.name).write_bytes(file.read_bytes())
    commit(revealed / "set", revealed / "key.json", {"darwin_op2": len(CASES)})
    asked = []

    def replay(diagnosed: Path, recordings: Any) -> Replayed:
        asked.append((diagnosed.name, len(recordings)))
        return Replayed(nominal=0.01, corrected=0.004)

    ratio = scored(revealed, replay=replay)["all"]["oracle_ratio"]
    assert asked == [("case_a", 2)]
    assert ratio == {"of": 1, "mean": pytest.approx(0.75), "median": pytest.approx(0.75)}


def test_intervals_are_those_of_clopper_and_pearson() -> None:
    assert rate(0, 150)["ci95"] == [0.0, pytest.approx(1 - 0.025 ** (1 / 150))]
    assert rate(77, 100)["ci95"] == pytest.approx([0.6751, 0.8483], abs=1e-4)
    assert rate(0, 0) == {"hits": 0, "of": 0, "rate": None, "ci95": None}
    assert calibration([], [])["ece"] is None


def test_the_command_writes_scores_and_a_table(revealed: Path) -> None:
    options = ("--set", revealed / "set", "--key", revealed / "key.json")
    where = ("--diagnoses", revealed / "diagnoses", "--out", revealed / "scores.json")
    done = pup("blind", "score", *options, *where, "--json")
    assert done.code == 0 and done.json()["cases"] == 10
    table = (revealed / "scores.md").read_text()
    assert "| detected | 0.67 (4/6) |" in table
    assert "| false positives | 0.50 (1/2) |" in table
    assert table.count("no diagnosis") == 1
    assert json.loads((revealed / "scores.json").read_text())["all"]["detected"]["hits"] == 4


def test_verdicts_that_break_the_contract_are_refused(revealed: Path) -> None:
    broken = revealed / "diagnoses" / "case_a" / "diagnosis.json"
    write_json(broken, verdict("mismatch", {"effect": "cogging"}))
    with pytest.raises(InputError, match="does not follow the contract"):
        scored(revealed)
    write_json(broken, {"schema": 2})
    with pytest.raises(InputError, match="not a diagnosis"):
        scored(revealed)


def test_a_folder_without_verdicts_is_refused(revealed: Path, tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(InputError, match="no case_<id>"):
        score_set(revealed / "set", revealed / "key.json", empty)
