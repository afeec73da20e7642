"""Which cases are asked what: nulls, what is immaterial, and lines of their own."""

from pathlib import Path
from typing import Any

from blind_scores import (
    BUS,
    CASES,
    HIP,
    KNEE,
    case,
    effect,
    finding,
    hits,
    reveal,
    scored,
    verdict,
)

from pup.blind.table import markdown


def test_nulls_with_material_nuisance_are_no_false_positives(tmp_path: Path) -> None:
    nulls = scored(reveal(tmp_path, CASES))["nulls"]
    assert (nulls["false_positives"]["hits"], nulls["false_positives"]["of"]) == (1, 2)
    assert (nulls["material_nuisance"]["hits"], nulls["material_nuisance"]["of"]) == (1, 1)


def test_nulls_without_a_diagnosis_are_counted_apart(tmp_path: Path) -> None:
    cases = [(case(n, "null:noise"), verdict("none") if n == "a" else None) for n in "abc"]
    nulls = scored(reveal(tmp_path, cases))["nulls"]
    assert hits(nulls, "false_positives") == (0, 1)
    assert hits(nulls, "told_none") == (1, 1)
    assert hits(nulls, "missing") == (2, 3)


def test_what_is_immaterial_has_a_line_of_its_own(tmp_path: Path) -> None:
    """By the yardstick of nulls: nothing material is missing, and a matched filter sees it."""
    slight = {"material": False, "held_out_gain_sigma": 0.1, "snr": 12.0, "when": []}
    calm = slight | {"snr": 3.0}
    alarm = verdict("mismatch", finding("cogging", HIP, 0.9))
    cases = [
        (case("a", "below_noise", effect("cogging", HIP), effect_seen=slight), alarm),
        (case("b", "single", effect("cogging", HIP), effect_seen=slight), verdict("none")),
        (case("c", "single", effect("cogging", HIP)), verdict("none")),
        (case("n", "null:nuisance", nuisance=[effect("cogging", HIP)], all_seen=slight), alarm),
        (case("m", "null:nuisance", nuisance=[effect("cogging", HIP)], all_seen=calm), alarm),
    ]
    scores = scored(reveal(tmp_path, cases))
    assert hits(scores["all"], "detected") == (0, 1)
    assert hits(scores["lines"]["immaterial"], "detected") == (1, 2)
    assert hits(scores["per_stratum"]["single"], "detected") == (0, 2)
    assert hits(scores["nulls"], "false_positives") == (1, 1)
    assert hits(scores["nulls"], "visible_nuisance") == (1, 1)
    assert [f["case"] for f in scores["failures"]] == ["c", "m"]
    page = markdown(scores)
    assert "| immaterial, of any stratum | 0.50 (1/2) |" in page
    assert "told (not counted above where it is told by its name) | 1.00 (1/1) |" in page


def test_cases_that_are_mostly_absorbed_have_a_line_besides(tmp_path: Path) -> None:
    """Whatever stratum they are drawn for, as long as one effect is to be named."""

    def absorbed(name: str, share: float, stratum: str) -> Any:
        seen = {"material": True, "absorbed": share}
        return case(name, stratum, effect("voltage_sag", BUS), effect_seen=seen), verdict("none")

    cases = [absorbed("a", 0.6, "masked"), absorbed("b", 0.9, "masked")]
    cases += [absorbed("c", 0.9, "below_noise"), absorbed("d", 0.9, "weak")]
    scores = scored(reveal(tmp_path, cases))
    assert hits(scores["per_stratum"]["masked"], "detected") == (0, 2)
    assert hits(scores["lines"]["masked_85"], "detected") == (0, 2)
    assert "| one effect, 85 % absorbed | 0.00 (0/2) |" in markdown(scores)


def test_all_that_is_clear_has_a_line_whether_it_matters_or_not(tmp_path: Path) -> None:
    def clear(name: str, snr: float, **seen: Any) -> Any:
        truth = case(name, "single", effect("cogging", HIP), effect_seen=seen | {"snr": snr})
        return truth, verdict("none")

    cases = [clear("a", 9.0, material=False), clear("b", 9.0), clear("c", 7.0)]
    scores = scored(reveal(tmp_path, cases))
    assert hits(scores["all"], "detected") == (0, 2)
    assert hits(scores["lines"]["snr_over_8"], "detected") == (0, 2)


def test_robots_on_the_ground_have_lines_of_their_own(tmp_path: Path) -> None:
    friction = effect("coulomb_friction", KNEE)
    told = verdict("mismatch", finding("coulomb_friction", KNEE, 0.9))
    cases = [
        (case("a", "single", friction, ground=True), told),
        (case("b", "single", friction), verdict("mismatch", finding("cogging", KNEE, 0.9))),
    ]
    lines = scored(reveal(tmp_path, cases))["lines"]
    assert lines["ground"]["place_top1"] == {"of": 1, "mean": 1.0, "median": 1.0}
    assert lines["suspended"]["place_top1"] == {"of": 1, "mean": 0.0, "median": 0.0}


def test_a_visible_nuisance_is_excused_by_its_name_alone(tmp_path: Path) -> None:
    slight = {"material": False, "held_out_gain_sigma": 0.1, "snr": 12.0, "when": []}
    nuisance = [effect("cogging", HIP)]
    cases = [
        (case(n, "null:nuisance", nuisance=nuisance, all_seen=slight), verdict("mismatch", head))
        for n, head in (("a", finding("cogging", HIP, 0.9)), ("b", finding("payload", HIP, 0.9)))
    ]
    assert hits(scored(reveal(tmp_path, cases))["nulls"], "false_positives") == (1, 1)
