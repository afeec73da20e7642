"""Rivals of the diagnosis on concealed cases: what they say, what it costs, how they are scored."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blind_sets import FRICTION, motions, seal
from commandline import files
from diagnosis_cases import BENCH

from benchmarks import blind_rivals
from benchmarks.rivals.case import Case
from benchmarks.rivals.network import FILE, SHARE, Network, in_the_loop
from benchmarks.rivals.refits import LADDER, _starts, chosen, refitted, with_effect
from benchmarks.rivals.sparse import DICTIONARY, Problem, _law
from benchmarks.rivals.torques import seen
from pup.blind.make import make_set
from pup.blind.table import ROWS
from pup.diagnosis.hypotheses import hypotheses
from pup.files import read_json, write_json
from pup.physics.terms import BEYOND, TERMS

CASE = "0f"
QUICK = ["residual_rms", "friction_ladder", *["sparse_regression"] * bool(find_spec("pysindy"))]
OURS = {"verdict": "none", "findings": [], "simulations": 100, "processor_seconds": 5.0}


@dataclass(frozen=True)
class Scored:
    """A set of one servo with dry friction, and what came of its rivals."""

    folder: Path
    told: dict[str, Any]
    code: int

    def verdict(self, rival: str) -> dict[str, Any]:
        return read_json(self.folder / "rivals" / rival / f"case_{CASE}" / "diagnosis.json")

    def score(self, rival: str, name: str) -> Any:
        return self.told["methods"][rival]["all"][name]


def arguments(folder: Path, *more: str) -> list[str]:
    own = {
        "--set": folder / "set",
        "--key": folder / "key.json",
        "--diagnoses": folder / "diagnoses",
        "--out": folder / "rivals.json",
    }
    return [*(str(part) for pair in own.items() for part in pair), *more]


def sealed(folder: Path, missing: Mapping[str, float]) -> Path:
    """A set of one case, with a diagnosis of it that says nothing is missing."""
    given, tests = motions(missing)
    seal(folder, {CASE: given}, {CASE: missing}, {CASE: tests})
    document = OURS | {"schema": 1, "robot": "servo_bench"}
    write_json(folder / "diagnoses" / f"case_{CASE}" / "diagnosis.json", document)
    return folder


@pytest.fixture(scope="module")
def scored(tmp_path_factory: pytest.TempPathFactory) -> Scored:
    folder = sealed(tmp_path_factory.mktemp("rivals"), FRICTION)
    code = blind_rivals.main(arguments(folder, "--rivals", *QUICK))
    return Scored(folder, read_json(folder / "rivals.json"), code)


def test_every_rival_gives_a_verdict_that_follows_the_contract(
    scored: Scored, check_contract: Any
) -> None:
    assert scored.code == 0
    assert list(scored.told["methods"]) == ["pup diagnose", *QUICK]
    for rival in QUICK:
        assert not (scored.folder / "rivals" / rival / f"case_{CASE}" / "error.json").exists()
        assert scored.verdict(rival)["verdict"] in ("mismatch", "none")
        check_contract(scored.folder / "rivals" / rival / f"case_{CASE}" / "diagnosis.json")


def test_dry_friction_is_named_by_who_knows_it(scored: Scored) -> None:
    assert scored.score("friction_ladder", "class_top1")["hits"] == 1
    assert scored.score("friction_ladder", "place_top1")["of"] == 0  # a servo has one joint


def test_who_looks_at_residuals_has_no_name(scored: Scored) -> None:
    assert [f["effect"] for f in scored.verdict("residual_rms")["findings"]] == ["unknown"]
    assert scored.score("residual_rms", "detected")["hits"] == 1
    assert scored.score("residual_rms", "class_top3")["hits"] == 0
    assert scored.told["methods"]["residual_rms"]["costs"]["gain"] == 0


def test_a_right_model_predicts_motions_left_out_to_the_noise(scored: Scored) -> None:
    held = scored.verdict("friction_ladder")["held_out"]
    assert held["rmse_after"] < 0.6 * held["rmse_before"]
    assert scored.score("friction_ladder", "oracle_ratio")["mean"] > 0.8


def test_simulations_are_counted_with_those_of_the_nominal_fit(scored: Scored) -> None:
    counts = {rival: scored.verdict(rival)["simulations"] for rival in QUICK}
    assert 0 < counts["residual_rms"] < counts["friction_ladder"]
    told = scored.told["methods"]["friction_ladder"]["costs"]
    assert told["simulations"] == counts["friction_ladder"]
    assert told["fewer"] == counts["friction_ladder"] / OURS["simulations"]
    held = scored.verdict("friction_ladder")["held_out"]
    assert told["gain"] == pytest.approx(1 - held["rmse_after"] / held["rmse_before"])


def test_the_page_has_the_columns_of_pup_blind_score(scored: Scored) -> None:
    page = (scored.folder / "rivals.md").read_text()
    assert "| method | detected | exact effect, first | class, first |" in page
    for name in ("pup diagnose", *QUICK):
        assert f"| {name} | " in page
    assert all(f"| {told} | " in page for told in ROWS.values())


def test_what_is_done_is_left_as_it_is(scored: Scored) -> None:
    before = files(scored.folder / "rivals")
    assert blind_rivals.main(arguments(scored.folder, "--rivals", *QUICK)) == 0
    assert files(scored.folder / "rivals") == before
    assert read_json(scored.folder / "rivals.json") == scored.told


# --- Parts ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def case() -> Case:
    return Case.of(BENCH, motions(FRICTION)[0])


def test_of_exhaustive_refits_bic_chooses_the_truth(case: Case) -> None:
    few = ("coulomb_friction", "quadratic_damping", "command_delay", "encoder_bias")
    some = [h for h in hypotheses(case.measured) if h.effect in few]
    refits = refitted(case, case.nominal.fit, some)
    assert [refit.hypothesis.effect for refit in refits] == [h.effect for h in some]
    verdict = chosen(case, refits)
    assert verdict.mismatch and verdict.named[0].effect == "coulomb_friction"
    assert verdict.named[0].probability > 0.9
    assert verdict.fit is not None
    told = verdict.fit.values["coulomb_friction/torque@joint:servo"]
    assert told == pytest.approx(0.03, rel=0.15)


def test_refits_start_within_their_ranges(case: Case) -> None:
    base = case.nominal.fit
    for hypothesis in hypotheses(case.measured):
        fit = with_effect(base, hypothesis)
        for at in _starts(hypothesis, fit, len(base.at)):
            assert all(c.lower <= x <= c.upper for c, x in zip(fit.coordinates, at, strict=True))


def test_inverse_dynamics_finds_a_torque_that_brakes(case: Case) -> None:
    """Roughly: second differences of noise are as large as the friction that is looked for."""
    every = seen(case)
    missing = np.concatenate([s.missing[s.usable, 0] for s in every])
    speed = np.concatenate([s.velocity[s.usable, 0] for s in every])
    fast = np.abs(speed) > 0.3
    assert fast.sum() > 30
    assert np.median(missing[fast] * np.sign(speed[fast])) == pytest.approx(-0.03, abs=0.02)


def test_inverse_dynamics_knows_the_setup(case: Case) -> None:
    """Twice the load needs twice the torque against gravity."""
    first = case.measured.recordings[0]
    heavy = replace(first, setup={"mass": 2 * 0.3247})
    torques = [
        seen(replace(case, replays=_replays(case, recording)))[0].gravity[0, 0]
        for recording in (first, heavy)
    ]
    assert torques[1] == pytest.approx(2 * torques[0], rel=0.02)


def _replays(case: Case, recording: Any) -> Any:
    narrowed = case.replays.narrowed([0])
    narrowed.measured = replace(narrowed.measured, recordings=(recording,))
    return narrowed


def test_sparse_regression_finds_one_column_among_all() -> None:
    pytest.importorskip("pysindy")
    rng = np.random.default_rng(1)
    names = [name for name, _ in DICTIONARY]
    columns, known = rng.normal(size=(600, len(names))), rng.normal(size=(600, 4))
    wanted = names.index("quadratic_damping")
    target = 0.5 * columns[:, wanted] + known @ np.ones(4) + 0.5 * rng.normal(size=600)
    problem = Problem(columns, known, target, np.repeat(np.arange(6), 100))
    surprise, weights = _law(problem, [[0, 1], [2, 3], [4, 5]])
    assert surprise > 2
    assert int(np.argmax(np.abs(weights))) == wanted
    nothing = replace(problem, target=known @ np.ones(4) + 0.5 * rng.normal(size=600))
    assert _law(nothing, [[0, 1], [2, 3], [4, 5]])[0] < 2


def test_names_of_rivals_are_those_of_the_library() -> None:
    assert {name for name, _ in DICTIONARY} | {name for name, _ in LADDER} <= set(TERMS)


def test_a_network_survives_its_file(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    shapes = ((8, 4), (8,), (8, 8), (8,), (1, 8), (1,))
    layers = tuple(rng.normal(size=shape) for shape in shapes)
    network = Network(np.zeros(4), np.ones(4), layers)
    network.save(tmp_path / FILE)
    known = [rng.normal(size=(5, 1)) for _ in range(3)]
    assert np.array_equal(Network.load(tmp_path / FILE).torque(*known), network.torque(*known))


def test_a_network_acts_in_the_simulation_as_a_torque(case: Case) -> None:
    """One that always tells the same torque is a preload; afterwards no term is left of it."""
    network = Network(np.zeros(4), np.ones(4), (np.zeros((1, 4)), np.array([0.02])))
    with in_the_loop(network):
        told = case.replays([{SHARE: 0.5}], [0])
    wanted = case.replays([{"joint_spring/preload@joint:servo": 0.01}], [0])
    assert np.abs(told - wanted).max() < 1e-9
    assert np.abs(told - case.replays([{}], [0])).max() > 1e-3
    assert set(BEYOND) == {"learned_law"}


def test_refuses_what_it_cannot_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = sealed(tmp_path, {})
    for more, said in (
        (("--robots", "darwin_op2"), "no case of darwin_op2"),
        (("--out", str(tmp_path / "table.md")), "needs a file for JSON"),
    ):
        assert blind_rivals.main(arguments(folder, *more, "--rivals", "residual_rms")) == 2
        told = capsys.readouterr().err
        assert said in told and "Traceback" not in told


def test_without_pysindy_it_is_refused_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(blind_rivals, "find_spec", lambda name: None)
    assert blind_rivals.main(arguments(sealed(tmp_path, {}))) == 2
    assert "sparse_regression needs pysindy" in capsys.readouterr().err
    assert not (tmp_path / "rivals").exists()


# --- A set of `pup blind make` --------------------------------------------------------------------


@pytest.mark.slow
def test_cases_of_a_made_set(tmp_path: Path) -> None:
    """The whole way, from the concealed truth to the table."""
    pytest.importorskip("pysindy")
    make_set({"servo_bench": 1}, {"servo_bench": 1}, "rivals of one case", tmp_path / "set",
             tmp_path / "key.json", lambda *_: None)  # fmt: skip
    for case in (tmp_path / "set").glob("case_*"):
        document = OURS | {"schema": 1, "robot": "servo_bench"}
        write_json(tmp_path / "diagnoses" / case.name / "diagnosis.json", document)
    assert blind_rivals.main(arguments(tmp_path)) == 0
    told = read_json(tmp_path / "rivals.json")
    assert len(told["cases"]) == 2
    for scores in told["methods"].values():
        assert (scores["cases"], scores["missing"]) == (2, 0)
        assert scores["costs"]["simulations"] > 0
    out = tmp_path / "rivals"
    networks = list((out / "residual_network").glob(f"case_*/corrected/{FILE}"))
    assert len(networks) == 2 and all(Network.load(file).layers for file in networks)
    for name in ("exhaustive_bic", "friction_ladder"):
        counts = [told["methods"][n]["costs"]["simulations"] for n in (name, "residual_rms")]
        assert counts[0] > 1.5 * counts[1]
