"""A key's refit gives way to nominal parameters that come nearer to the truth, and to no others."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blind_scores import finding, place, reveal, scored, verdict
from test_blind_effects import plans, world_of

from pup.blind.absorb import view
from pup.blind.bound import bounded, usable
from pup.blind.reference import Reference, readings
from pup.blind.refit import Refit
from pup.blind.seal import commit
from pup.blind.sensors import Noise, measure
from pup.blind.table import markdown
from pup.blind.world import Effect, Place, World
from pup.recording import write_recordings

BARE = world_of("servo_bench")
ROTOR = 0.0003  # kg m2, that a nominal model may as well have
EFFECT = Effect("armature", Place("joint", ("servo",)), ROTOR, "inertia", "kg m2")
NOMINAL = {s.name: s.nominal for s in BARE.robot.parameters}
BEST = NOMINAL | {"armature": NOMINAL["armature"] + ROTOR}
HALF = NOMINAL | {"armature": NOMINAL["armature"] + 0.9 * ROTOR}
NOISE = Noise()
PLANS = plans(BARE.robot, "bench")
NONE = verdict("none")


def truth() -> dict[str, Any]:
    """A key's entry whose refit has moved nothing at all."""
    world = World(BARE.robot, BARE.nominal, (EFFECT,))
    origin = Reference.of(world, PLANS, NOMINAL)
    wanted = {name: seen.stacked() for name, seen in readings(world, PLANS)[0].items()}
    refit = Refit(origin, wanted, NOISE)
    seen = view(refit, refit.still(origin.values, origin.stacked())).document()
    told = {**EFFECT.document(), "besides": [], "comparable": True}
    return {
        "id": "a",
        "robot": "servo_bench",
        "ground": False,
        "stratum": "single",
        "effects": [told],
        "nuisance": [],
        "nominal": NOMINAL,
        "engine": BARE.engine.document(),
        "noise": {**vars(NOISE), "sigma": NOISE.sigma},
        "answer": {"verdicts": ["mismatch"], "set": []},
        "effect_seen": seen,
        "all_seen": seen,
    }


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The case's folder."""
    folder = tmp_path_factory.mktemp("case")
    seen = readings(World(BARE.robot, BARE.nominal, (EFFECT,)), PLANS)[0]
    rng = np.random.default_rng(3)
    made = [measure(BARE, plan, seen[plan.id], NOISE, rng) for plan in PLANS]
    write_recordings(made, folder / "recordings")
    return folder


@pytest.fixture(scope="module")
def entry() -> dict[str, Any]:
    return truth()


def test_parameters_that_hide_everything_leave_nothing(case: Path, entry: Any) -> None:
    assert entry["effect_seen"]["snr"] > 20 and entry["effect_seen"]["material"]
    counted, lower = bounded(entry, case, BARE.robot, BEST)
    for name in ("effect_seen", "all_seen"):
        assert counted[name]["snr"] < 1.0
        assert counted[name]["absorbed"] > 0.95
        assert not counted[name]["material"]
        assert lower is not None and lower[name]["key_snr"] == entry[name]["snr"]
    assert counted["stratum"] == "weak"
    assert "none" in counted["answer"]["verdicts"]


def test_parameters_that_come_near_lower_what_is_left_and_hide_it(case: Path, entry: Any) -> None:
    """Above an SNR of 10 it is there, hidden by more than half."""
    counted, _ = bounded(entry, case, BARE.robot, HALF)
    assert 10 < counted["effect_seen"]["snr"] < 0.5 * entry["effect_seen"]["snr"]
    assert counted["stratum"] == "masked"
    assert counted["answer"] == entry["answer"]


@pytest.mark.parametrize(
    "wrong", [{"kp/servo": NOMINAL["kp/servo"] * 1.5}, {"armature": 0.2 * NOMINAL["armature"]}]
)
def test_parameters_that_are_farther_away_change_nothing(
    case: Path, entry: Any, wrong: dict[str, float]
) -> None:
    assert bounded(entry, case, BARE.robot, NOMINAL | wrong) == (entry, {})


@pytest.mark.parametrize(
    "nominal",
    [
        None,
        "armature",
        {name: value for name, value in BEST.items() if name != "kd/servo"},
        BEST | {"kp/servo": float("nan")},
        BEST | {"kp/servo": float("inf")},
        BEST | {"kp/servo": "3"},
        BEST | {"armature": 1.0},
    ],
)
def test_what_is_no_nominal_model_is_not_looked_at(case: Path, entry: Any, nominal: Any) -> None:
    assert bounded(entry, case, BARE.robot, nominal) == (entry, None)


def test_bounds_of_parameters_belong_to_them() -> None:
    edge = {s.name: s.search[1] for s in BARE.robot.parameters}
    found = usable(BARE.robot, False, edge)
    assert found is not None and found["armature"] == edge["armature"]


def test_a_truth_that_is_not_that_of_the_key_is_not_compared(case: Path, entry: Any) -> None:
    """Old keys lack the seed of what is random in the physics."""
    size = {**entry["effects"][0]["size"], "value": 0.5 * ROTOR}
    other = entry | {"effects": [entry["effects"][0] | {"size": size}]}
    assert bounded(other, case, BARE.robot, BEST) == (other, None)


def test_a_nuisance_is_nobodys_effect(case: Path, entry: Any) -> None:
    """A null's nuisance that a refit can hide is not clear to a matched filter."""
    seen = entry["all_seen"] | {"material": False}
    null = {k: v for k, v in entry.items() if k != "effect_seen"} | {
        "stratum": "null:nuisance",
        "effects": [],
        "nuisance": entry["effects"],
        "all_seen": seen,
    }
    counted, _ = bounded(null, case, BARE.robot, BEST)
    assert counted["stratum"] == "null:nuisance" and counted["all_seen"]["snr"] < 1.0


def test_the_score_tells_of_every_bound_that_was_lower(
    case: Path, entry: Any, tmp_path: Path
) -> None:
    alarm = verdict("mismatch", finding("armature", place("joint", "servo"), 0.9))
    cases = [
        (entry, NONE | {"nominal": BEST}),
        (entry | {"id": "b"}, alarm | {"nominal": NOMINAL}),
        (entry | {"id": "c"}, NONE),
    ]
    folder = reveal(tmp_path, cases)
    for name in "abc":
        target = folder / "set" / f"case_{name}" / "recordings"
        target.mkdir(parents=True)
        for file in (case / "recordings").iterdir():
            (target / file.name).write_bytes(file.read_bytes())
    commit(folder / "set", folder / "key.json")
    scores = scored(folder)
    assert scores["refits"]["compared"] == 2
    (lower,) = scores["refits"]["lower"]
    assert (lower["case"], lower["stratum"], lower["counted_as"]) == ("a", "single", "weak")
    assert lower["effect_seen"]["snr"] < 1.0 < lower["effect_seen"]["key_snr"]
    assert (scores["all"]["detected"]["hits"], scores["all"]["detected"]["of"]) == (1, 2)
    assert [f["case"] for f in scores["failures"]] == ["c"]
    page = markdown(scores)
    assert "key's: 1 of 2 compared" in page
    assert (
        f"| a | servo_bench | single | weak | effect | {lower['effect_seen']['key_snr']:.1f} |"
        in page
    )
