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
from benchmarks.rivals.refits import LADDER
from benchmarks.rivals.run import RIVALS
from benchmarks.rivals.sparse import DICTIONARY, Problem, _law
from benchmarks.rivals.torques import seen
from pup.blind.make import make_set
from pup.blind.table import ROWS
from pup.files import read_json, write_json
from pup.physics.terms import BEYOND, TERMS, split_column

CASE = "0f"
RAN = [r for r in RIVALS if r != "sparse_regression" or find_spec("pysindy")]
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
    code = blind_rivals.main(arguments(folder, "--rivals", *RAN))
    return Scored(folder, read_json(folder / "rivals.json"), code)


def test_every_rival_gives_a_verdict_that_follows_the_contract(
    scored: Scored, check_contract: Any
) -> None:
    assert scored.code == 0
    assert list(scored.told["methods"]) == ["pup diagnose", *RAN]
    for rival in RAN:
        assert not (scored.folder / "rivals" / rival / f"case_{CASE}" / "error.json").exists()
        assert scored.verdict(rival)["verdict"] == "mismatch"
        check_contract(scored.folder / "rivals" / rival / f"case_{CASE}" / "diagnosis.json")


@pytest.mark.parametrize("rival", ["friction_ladder", "exhaustive_bic", "sparse_regression"])
def test_dry_friction_is_named_by_all_that_know_it(scored: Scored, rival: str) -> None:
    if rival not in RAN:
        pytest.skip("needs PySINDy")
    assert scored.score(rival, "class_top1")["hits"] == 1
    assert scored.score(rival, "place_top1")["mean"] == 1.0


@pytest.mark.parametrize("rival", ["residual_rms", "residual_network"])
def test_who_has_no_names_gives_none(scored: Scored, rival: str) -> None:
    named = {finding["effect"] for finding in scored.verdict(rival)["findings"]}
    assert named <= {"unknown"}
    assert scored.score(rival, "detected")["hits"] == 1
    assert scored.score(rival, "class_top3")["hits"] == 0


def test_a_right_model_predicts_motions_left_out_to_the_noise(scored: Scored) -> None:
    for rival in ("friction_ladder", "exhaustive_bic"):
        held = scored.verdict(rival)["held_out"]
        assert held["rmse_after"] < 0.6 * held["rmse_before"]
        assert scored.score(rival, "oracle_ratio")["mean"] > 0.8


def test_the_network_is_judged_in_simulation_too(scored: Scored) -> None:
    held = scored.verdict("residual_network")["held_out"]
    assert held["rmse_after"] < held["rmse_before"]
    ratio = scored.score("residual_network", "oracle_ratio")
    assert ratio["of"] == 1
    assert ratio["mean"] < scored.score("exhaustive_bic", "oracle_ratio")["mean"]


def test_simulations_are_counted_with_those_of_the_nominal_fit(scored: Scored) -> None:
    counts = {rival: scored.verdict(rival)["simulations"] for rival in RAN}
    assert 0 < counts["residual_rms"] < counts["friction_ladder"] < counts["exhaustive_bic"]
    told = scored.told["methods"]["exhaustive_bic"]["costs"]
    assert told["simulations"] == counts["exhaustive_bic"]
    assert told["fewer"] == counts["exhaustive_bic"] / OURS["simulations"]
    assert told["gain"] == pytest.approx(
        1 - scored.verdict("exhaustive_bic")["held_out"]["rmse_after"]
        / scored.verdict("exhaustive_bic")["held_out"]["rmse_before"]
    )  # fmt: skip


def test_the_page_has_the_columns_of_pup_blind_score(scored: Scored) -> None:
    page = (scored.folder / "rivals.md").read_text()
    assert "| method | detected | exact effect, first | class, first |" in page
    for name in ("pup diagnose", *RAN):
        assert f"| {name} | " in page
    assert all(f"| {told} | " in page for told in ROWS.values())


def test_what_is_done_is_left_as_it_is(scored: Scored) -> None:
    before = files(scored.folder / "rivals")
    assert blind_rivals.main(arguments(scored.folder, "--rivals", *RAN)) == 0
    assert files(scored.folder / "rivals") == before
    assert read_json(scored.folder / "rivals.json") == scored.told


# --- Parts ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def case() -> Case:
    return Case.of(BENCH, motions(FRICTION)[0])


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


def test_a_network_survives_its_file_and_leaves_no_trace(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    shapes = ((8, 4), (8,), (8, 8), (8,), (1, 8), (1,))
    layers = tuple(rng.normal(size=shape) for shape in shapes)
    network = Network(np.zeros(4), np.ones(4), layers)
    network.save(tmp_path / FILE)
    known = [rng.normal(size=(5, 1)) for _ in range(3)]
    assert np.array_equal(Network.load(tmp_path / FILE).torque(*known), network.torque(*known))
    with in_the_loop(network):
        assert split_column(SHARE) is not None
    assert set(BEYOND) == {"learned_law"}


def test_refuses_what_it_cannot_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = sealed(tmp_path, {})
    for more, said in (
        (("--robots", "darwin_op2"), "no case of darwin_op2"),
        (("--out", str(tmp_path / "table.md")), "needs a file for JSON"),
    ):
        assert blind_rivals.main(arguments(folder, *more)) == 2
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
    make_set({"servo_bench": 1}, {"servo_bench": 1}, "rivals", tmp_path / "set",
             tmp_path / "key.json", lambda *_: None)  # fmt: skip
    for case in (tmp_path / "set").glob("case_*"):
        document = OURS | {"schema": 1, "robot": "servo_bench"}
        write_json(tmp_path / "diagnoses" / case.name / "diagnosis.json", document)
    assert blind_rivals.main(arguments(tmp_path)) == 0
    told = read_json(tmp_path / "rivals.json")
    assert len(told["cases"]) == 2
    for scores in told["methods"].values():
        assert (scores["cases"], scores["missing"]) == (2, 0)
    counts = {name: scores["costs"]["simulations"] for name, scores in told["methods"].items()}
    assert counts["exhaustive_bic"] > 3 * counts["residual_rms"]
