"""Made-up verdicts whose scores can be told by hand."""

from pathlib import Path
from typing import Any

from pup.blind.score import score_set
from pup.blind.seal import commit, write_key
from pup.files import write_json
from pup.robot import RobotDescription

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


GROUP = next(j.group for j in RobotDescription.load("darwin_op2").joints if j.name == "l_knee")
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
            next_recording={"motion": "hold", "splits": [["backlash", "dead_band"]]},
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


def reveal(folder: Path, cases: Any) -> Path:
    """Write a set under `set`, its `key.json` and the verdicts under `diagnoses`."""
    (folder / "set").mkdir()
    write_key(folder / "key.json", {"schema": 1, "salt": "ab", "cases": [c for c, _ in cases]})
    commit(folder / "set", folder / "key.json")
    for truth, told in cases:
        if told is not None:
            write_json(folder / "diagnoses" / f"case_{truth['id']}" / "diagnosis.json", told)
    return folder


def scored(folder: Path, **more: Any) -> dict[str, Any]:
    return score_set(folder / "set", folder / "key.json", folder / "diagnoses", **more)


def hits(scores: Any, name: str) -> tuple[int, int]:
    """A rate of some scores, as it is counted."""
    return scores[name]["hits"], scores[name]["of"]
