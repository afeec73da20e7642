"""The scorer, on made-up verdicts whose scores can be told by hand."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blind_scores import (
    BUS,
    CASES,
    GROUP,
    HIP,
    KNEE,
    SIGMA,
    SPAN,
    TORQUE,
    case,
    effect,
    finding,
    hits,
    named,
    place,
    reveal,
    scored,
    verdict,
)
from blind_sets import poor

from pup.blind.claims import ranking
from pup.blind.score import Replayed
from pup.blind.seal import commit
from pup.recording import write_recordings


@pytest.fixture
def revealed(tmp_path: Path) -> Path:
    """The set of CASES."""
    return reveal(tmp_path, CASES)


def test_rates_are_those_counted_by_hand(revealed: Path) -> None:
    scores = scored(revealed)
    everything = scores["all"]
    hits = {name: (v["hits"], v["of"]) for name, v in everything.items() if "hits" in v}
    assert hits["detected"] == (4, 6)
    assert hits["exact_top1"] == (2, 5)
    assert hits["exact_top3"] == (3, 5)
    assert hits["class_top1"] == hits["class_top3"] == (3, 5)
    assert hits["pairs_both_in_top3"] == (1, 1)
    assert hits["set_covers"] == (3, 6)  # all on the list, and u, which names something
    assert hits["unlisted_flagged"] == (1, 1)
    assert hits["listed_flagged_unknown"] == (0, 5)
    assert hits["unidentifiable_allowed"] == (0, 1)
    assert hits["parameter_in_ci90"] == (0, 1)
    assert hits["ambiguous_with_next_recording"] == (1, 1)
    assert everything["parameter_error"]["mean"] == pytest.approx(0.2)
    assert everything["place_top1"] == {"of": 5, "mean": 0.5, "median": 0.5}
    assert everything["set_size"]["mean"] == pytest.approx(5 / 4)
    assert everything["regime_f1"] == {"of": 1, "mean": 0.5, "median": 0.5}
    assert (scores["cases"], scores["missing"]) == (10, 1)


@pytest.mark.parametrize("kind", ["none", "undetermined"])
def test_findings_count_where_the_verdict_is_a_mismatch(tmp_path: Path, kind: str) -> None:
    right = finding("coulomb_friction", KNEE, 0.9, parameters=TORQUE, when=[SPAN], law="x")
    truth = case("a", "single", effect("coulomb_friction", KNEE), all_seen={"when": [SPAN]})
    scores = scored(reveal(tmp_path, [(truth, verdict(kind, right))]))
    for name in ("detected", "exact_top1", "class_top3", "set_covers", "listed_flagged_unknown"):
        assert hits(scores["all"], name) == (0, 1)
    assert scores["all"]["place_top1"] == {"of": 1, "mean": 0.0, "median": 0.0}
    for name in ("regime_f1", "parameter_error", "calibration"):
        assert scores["all"][name]["of"] == 0


def test_a_set_holds_what_is_at_its_place(tmp_path: Path) -> None:
    """And an effect at two places is two of it."""
    friction = effect("coulomb_friction", KNEE)

    def told(name: str, *where: Any) -> Any:
        first, *others = (named("coulomb_friction", place, 0.3) for place in where)
        head = finding(*first.values(), equivalents=others)
        return case(name, "single", friction), verdict("mismatch", head)

    everything = scored(reveal(tmp_path, [told("a", HIP), told("b", HIP, KNEE)]))["all"]
    assert hits(everything, "set_covers") == (1, 2)
    assert everything["set_size"]["mean"] == 1.5


@pytest.mark.parametrize(
    ("splits", "told"),
    [
        ([["command_delay", "measurement_delay"]], True),
        ([["coulomb_friction", "cogging"]], False),  # of another finding
        ([], False),
    ],
)
def test_a_next_recording_splits_a_set_that_holds_the_truth(
    tmp_path: Path, splits: Any, told: bool
) -> None:
    head = finding("command_delay", BUS, 0.5, equivalents=[named("measurement_delay", BUS, 0.4)])
    asked = {"motion": "hold", "splits": splits}
    truth = case("a", "masked", effect("command_delay", BUS, 0.01, "s"))
    cases = [(truth, verdict("mismatch", head, next_recording=asked))]
    everything = scored(reveal(tmp_path, cases))["all"]
    assert hits(everything, "ambiguous_with_next_recording") == (int(told), 1)


def test_a_set_without_the_truth_is_not_ambiguous(tmp_path: Path) -> None:
    head = finding("payload", BUS, 0.5, equivalents=[named("measurement_delay", BUS, 0.4)])
    asked = {"motion": "hold", "splits": [["payload", "measurement_delay"]]}
    truth = case("a", "masked", effect("command_delay", BUS, 0.01, "s"))
    cases = [(truth, verdict("mismatch", head, next_recording=asked))]
    everything = scored(reveal(tmp_path, cases))["all"]
    assert everything["ambiguous_with_next_recording"]["of"] == 0
    assert hits(everything, "found_or_split") == (0, 1)


def test_a_masked_one_may_be_in_a_set_that_is_split(tmp_path: Path) -> None:
    head = finding("com_offset", KNEE, 0.5, equivalents=[named("voltage_sag", BUS, 0.4)])
    asked = {"motion": "hold", "splits": [["com_offset", "voltage_sag"]]}
    truth = case("a", "masked", effect("voltage_sag", BUS, unit="ohm"))
    scores = scored(reveal(tmp_path, [(truth, verdict("mismatch", head, next_recording=asked))]))
    assert hits(scores["all"], "class_top1") == (0, 1)
    assert hits(scores["all"], "found_or_split") == (1, 1)


def test_what_cannot_be_decided_is_not_told_by_other_names(tmp_path: Path) -> None:
    delays = {"verdicts": ["mismatch"], "set": ["command_delay", "measurement_delay"]}
    mass = {"verdicts": ["none", "undetermined"], "set": []}
    rivals = finding("cogging", KNEE, 0.5, equivalents=[named("backlash", KNEE, 0.4)])
    sure = finding("payload", KNEE, 0.95)
    late = effect("command_delay", BUS, 0.01, "s")
    cases = [
        (case("a", "unidentifiable", late, answer=delays), verdict("mismatch", rivals)),
        (
            case("b", "unidentifiable", effect("payload", KNEE), answer=mass),
            verdict("mismatch", sure),
        ),
    ]
    everything = scored(reveal(tmp_path, cases))["all"]
    assert hits(everything, "unidentifiable_allowed") == (0, 2)
    assert hits(everything, "set_covers") == (0, 2)


def test_a_name_is_sharp_by_its_share_of_the_finding(tmp_path: Path) -> None:
    """Equivalents without probability are no reserve, nor is a low probability of the finding."""
    answer = {"verdicts": ["mismatch"], "set": ["command_delay", "measurement_delay"]}
    sag = effect("command_delay", BUS, 0.01, "s")

    def told(name: str, first: float, second: float) -> Any:
        other = [named("measurement_delay", BUS, second)]
        delay = finding("command_delay", BUS, first, equivalents=other)
        return case(name, "unidentifiable", sag, answer=answer), verdict("mismatch", delay)

    cases = [told("a", 0.3, 0.01), told("b", 0.6, 0.3), told("c", 0.9, 0.0)]
    scores = scored(reveal(tmp_path, cases))
    assert hits(scores["all"], "unidentifiable_allowed") == (1, 3)


def test_unknown_counts_first_or_where_it_is_stated(tmp_path: Path) -> None:
    def told(name: str, probability: float, where: Any = KNEE) -> Any:
        first, later = finding("cogging", KNEE, 0.9), finding("unknown", where, probability)
        truth = case(name, "unlisted", effect("unknown", KNEE))
        return truth, verdict("mismatch", first, later)

    cases = [told("a", 0.4), told("b", 0.6), told("c", 0.6, place("joint", "head_pan"))]
    scores = scored(reveal(tmp_path, cases))
    assert hits(scores["all"], "unlisted_flagged") == (1, 3)


def test_each_of_a_pair_needs_a_finding_of_its_own(tmp_path: Path) -> None:
    both = (effect("coulomb_friction", KNEE), effect("cogging", KNEE))
    within = finding("coulomb_friction", KNEE, 0.5, equivalents=[named("cogging", KNEE, 0.4)])
    apart = [finding("coulomb_friction", KNEE, 0.5), finding("cogging", KNEE, 0.4)]
    hardly = finding("payload", KNEE, 0.3, equivalents=[named("cogging", KNEE, 0.01)])
    cases = [
        (case("a", "pair", *both), verdict("mismatch", within)),
        (case("b", "pair", *both), verdict("mismatch", *apart)),
        (case("c", "pair", *both), verdict("mismatch", within, hardly)),
        (case("d", "pair", *both), verdict("mismatch", finding("payload", KNEE, 0.9))),
    ]
    everything = scored(reveal(tmp_path, cases))["all"]
    assert hits(everything, "pairs_both_in_top3") == (1, 4)
    assert hits(everything, "pairs_one_in_top3") == (3, 4)


def test_sizes_are_compared_where_the_places_meet(tmp_path: Path) -> None:
    def told(name: str, where: Any) -> Any:
        truth = case(name, "single", effect("coulomb_friction", KNEE))
        return truth, verdict("mismatch", finding("coulomb_friction", where, 1, parameters=TORQUE))

    cases = [told("a", KNEE), told("b", HIP), told("c", place("group", GROUP))]
    assert scored(reveal(tmp_path, cases))["all"]["parameter_error"]["of"] == 2


@pytest.mark.parametrize(
    ("told", "credit"),
    [
        (KNEE, 1.0),
        (place("joint", "r_knee"), 0.5),
        (place("group", GROUP), 0.5),
        (place("joint", "l_knee", "l_hip_pitch"), 0.0),
        (BUS, 0.0),
    ],
)
def test_half_a_place_is_the_mirror_or_a_group(tmp_path: Path, told: Any, credit: float) -> None:
    truth = case("a", "single", effect("coulomb_friction", KNEE))
    cases = [(truth, verdict("mismatch", finding("coulomb_friction", told, 0.9)))]
    assert scored(reveal(tmp_path, cases))["all"]["place_top1"]["mean"] == credit


def test_a_robot_of_one_joint_has_no_place_to_find(tmp_path: Path) -> None:
    servo = place("joint", "servo")
    truth = case("a", "single", effect("cogging", servo), robot="servo_bench")
    cases = [(truth, verdict("mismatch", finding("cogging", servo, 0.9)))]
    assert scored(reveal(tmp_path, cases))["all"]["place_top1"]["of"] == 0


def test_times_in_repeats_do_not_count(tmp_path: Path) -> None:
    truth = case("a", "single", effect("cogging", KNEE), all_seen={"when": [SPAN]})
    when = [SPAN, {**SPAN, "recording": "r02"}]
    cases = [(truth, verdict("mismatch", finding("cogging", KNEE, 0.9, when=when)))]
    folder = reveal(tmp_path, cases)
    run = poor(1)[0]
    runs = [replace(run, id="r01"), replace(run, id="r02", repeat_of="r01")]
    assert scored(folder)["all"]["regime_f1"]["mean"] == pytest.approx(2 / 3)
    write_recordings(runs, folder / "set" / "case_a" / "recordings")
    commit(folder / "set", folder / "key.json")
    assert scored(folder)["all"]["regime_f1"]["mean"] == 1.0


def test_every_failure_is_listed(revealed: Path) -> None:
    failures = {f["case"]: f["faults"] for f in scored(revealed)["failures"]}
    assert failures == {
        "b": ["wrong effect of the class", "wrong place"],
        "c": ["missed"],
        "e": ["no diagnosis"],
        "u": ["sharp name where the data cannot tell"],
        "n2": ["false positive"],
    }


def test_the_first_finding_is_first_and_the_others_go_by_probability() -> None:
    """Among equals: a finding, then its equivalents, then the next one; names have no say."""
    told = verdict(
        "mismatch",
        finding(
            *("quadratic_damping", KNEE, 0.5),
            equivalents=[named("torque_speed_limit", KNEE, 0.5), named("backlash", HIP, 0.5)],
        ),
        finding("payload", KNEE, 0.9),
        finding("clock_skew", BUS, 0.5, equivalents=[named("armature", KNEE, 0.2)]),
    )
    assert [n.effect for n in ranking(told["findings"])] == [
        *("quadratic_damping", "payload", "torque_speed_limit", "backlash"),
        *("clock_skew", "armature"),
    ]
    assert ranking([]) == []


def test_unknown_is_first_where_more_is_believed_in_it() -> None:
    friction = finding("coulomb_friction", KNEE, 0.4, equivalents=[named("cogging", KNEE, 0.45)])
    payload = finding("payload", KNEE, 0.9)

    def first(probability: float) -> str:
        told = verdict("mismatch", friction, payload, finding("unknown", KNEE, probability))
        return ranking(told["findings"])[0].effect

    assert [first(p) for p in (0.39, 0.4, 0.41)] == ["coulomb_friction"] * 2 + ["unknown"]
    within = verdict("mismatch", friction | {"equivalents": [named("unknown", KNEE, 0.6)]})
    assert ranking(within["findings"])[0].effect == "coulomb_friction"


def test_scores_go_by_the_first_finding_not_by_the_most_probable(tmp_path: Path) -> None:
    """Stribeck friction at 0.80 stands before clock skew at 0.82."""
    told = verdict(
        "mismatch",
        finding(
            *("stribeck_friction", KNEE, 0.8),
            equivalents=[named("coulomb_friction", KNEE, 0.11)],
        ),
        finding("clock_skew", BUS, 0.82),
    )
    truths = (
        case("f", "single", effect("stribeck_friction", KNEE)),
        case("g", "single", effect("clock_skew", BUS)),
    )
    scores = scored(reveal(tmp_path, [(truth, told) for truth in truths]))["all"]
    assert scores["exact_top1"]["hits"] == scores["class_top1"]["hits"] == 1
    assert scores["exact_top3"]["hits"] == scores["class_top3"]["hits"] == 2
    # f 1; g 0, for what stands first is of another class, wherever it is
    assert scores["place_top1"]["mean"] == 0.5
    # f .91 right, g .91 wrong
    assert scores["calibration"]["brier"] == pytest.approx((0.09**2 + 0.91**2) / 2)


NUISANCE = [effect("cogging", HIP), effect("command_delay", BUS, 0.001, "s")]


def test_nuisances_that_are_there_have_rows_beside_the_strict_ones(tmp_path: Path) -> None:
    """Cogging at the hip is there, cogging at the other hip is not; delay is there at any joint."""
    friction = finding("coulomb_friction", KNEE, 0.3)

    def single(name: str, first: Any) -> Any:
        truth = case(name, "single", effect("coulomb_friction", KNEE), nuisance=NUISANCE)
        return truth, verdict("mismatch", first, friction)

    calm = {"material": False, "held_out_gain_sigma": 0.2489, "when": []}
    cases = [
        single("p", finding("cogging", HIP, 0.9)),
        single("q", finding("cogging", place("joint", "r_hip_pitch"), 0.9)),
        single("r", finding("measurement_delay", KNEE, 0.9)),
        single("s", finding("stribeck_friction", KNEE, 0.9)),
        (
            case("n", "null:nuisance", nuisance=NUISANCE, all_seen=calm),
            verdict("mismatch", finding("cogging", HIP, 0.9)),
        ),
    ]
    scores = scored(reveal(tmp_path, cases))
    everything = scores["all"]
    assert (everything["class_top1"]["hits"], everything["class_top1"]["of"]) == (1, 4)
    either = everything["class_top1_or_nuisance"]
    assert (either["hits"], either["of"]) == (3, 4)
    # p 0, q 0, r 0, s 1; with nuisances p 1, and r 0: a joint is not the bus
    assert everything["place_top1"]["mean"] == 0.25
    assert everything["place_top1_or_nuisance"]["mean"] == 0.5
    assert everything["calibration"]["ece"] == pytest.approx(0.65)
    assert everything["calibration_or_nuisance"]["ece"] == pytest.approx(0.15)
    assert scores["calibration"]["ece"] == pytest.approx(0.9 - 1 / 5)
    assert scores["calibration_or_nuisance"]["ece"] == pytest.approx(0.9 - 4 / 5)
    assert scores["nulls"]["false_positives"]["hits"] == 1
    assert {f["case"]: f["faults"] for f in scores["failures"]} == {
        "p": ["wrong class (a nuisance that is there)"],
        "q": ["wrong class"],
        "r": ["wrong class (a nuisance that is there)"],
        "s": ["wrong effect of the class"],
        "n": ["false positive (nuisance of 0.25 sigma)"],
    }


def test_without_a_nuisance_both_readings_are_one(revealed: Path) -> None:
    everything = scored(revealed)["all"]
    for name in ("class_top1", "place_top1", "calibration"):
        assert everything[f"{name}_or_nuisance"] == everything[name]


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
    commit(revealed / "set", revealed / "key.json")
    asked = []

    def replay(diagnosed: Path, recordings: Any) -> Replayed:
        asked.append((diagnosed.name, len(recordings)))
        return Replayed(nominal=0.01, corrected=0.004)

    ratio = scored(revealed, replay=replay)["all"]["oracle_ratio"]
    assert asked == [("case_a", 2)]
    assert ratio == {"of": 1, "mean": pytest.approx(0.75), "median": pytest.approx(0.75)}


def test_the_key_says_what_a_refit_leaves_of_test_motions(tmp_path: Path) -> None:
    """Whatever the diagnosis tells of it; who tells no model has nothing of the gain."""
    left = float(np.sqrt(0.01**2 - SIGMA**2))

    def single(name: str, left: float) -> Any:
        seen = {"after_refit_test_rms_rad": left, "when": []}
        return case(name, "single", effect("cogging", KNEE), all_seen=seen)

    told = verdict("mismatch", finding("cogging", KNEE, 0.9))
    truths = [single("a", left), single("b", left), single("c", 0.001), single("d", left)]
    null = case("n", "null:nuisance")
    folder = reveal(tmp_path, [*((t, told) for t in truths[:3]), (truths[3], None), (null, told)])
    for name in "abcdn":
        write_recordings(poor(1), folder / "set" / f"case_{name}" / "test")
        if name not in "bd":
            (folder / "diagnoses" / f"case_{name}" / "corrected").mkdir()
    commit(folder / "set", folder / "key.json")
    asked = []

    def replay(diagnosed: Path, recordings: Any) -> Replayed:
        asked.append(diagnosed.name)
        return Replayed(nominal=0.5, corrected=0.004)

    ratio = scored(folder, replay=replay)["all"]["oracle_ratio"]
    assert asked == ["case_a"]  # c has nothing to be gained, n is a null
    assert ratio == {"of": 3, "mean": pytest.approx(0.25), "median": 0.0}
