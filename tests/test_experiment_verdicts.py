"""What is said of bars: only what whole intervals show, of all robots that were planned."""

from pathlib import Path
from typing import Any

import experiments
import numpy as np
import pytest
from reports import Page

from pup.files import write_json
from pup.sysid.figures import drawing_style
from services.experiment import figures
from services.experiment.cells import Cell, graph
from services.experiment.diagnosed import diagnoses
from services.experiment.gather import gather
from services.experiment.plan import Plan
from services.experiment.report import write_report
from services.experiment.verdicts import acceptance, of_direction

BUDGETS = {"own": 8, "corrected": 8, "diagnosed": 15, "undiagnosed": 15}
NOBODY = diagnoses(Plan(seeds=(1,)), {}, {})


def walks(**arms: list[float | list[float]]) -> dict[str, Any]:
    """A direction by arm: for each robot a distance, or several; None where a cell failed."""
    names = {arm.replace("_", "+"): told for arm, told in arms.items()}
    walked = {
        arm: {
            f"r{i}": {"distance": np.atleast_1d(far).tolist(), "time": np.ones(np.size(far))}
            for i, far in enumerate(told)
            if far is not None
        }
        for arm, told in names.items()
    }
    planned = {arm: [f"r{i}" for i in range(len(told))] for arm, told in names.items()}
    return {"walks": {a: w for a, w in walked.items() if w}, "planned": planned, "searches": {}}


def lines(part: dict[str, Any], diagnosed: dict[str, Any] = NOBODY) -> dict[str, dict[str, Any]]:
    told = {"forward": {"statistics": of_direction(part, BUDGETS)}}
    return {line["line"]: line for line in acceptance(told, diagnosed)}


def by_robust(pup: list[Any], robust: list[Any]) -> dict[str, Any]:
    return lines(walks(pup=pup, robust=robust))["forward: PUP by Robust"]


def test_a_bar_holds_where_the_whole_interval_is_above_it() -> None:
    rival = [1.0, 1.1, 0.9, 1.0, 1.2, 0.8]
    told = by_robust([2 * far + 0.1 for far in rival], rival)
    assert told["answer"] == "holds" and told["holds"] and not told["indicative"]
    told = by_robust([0.5, 4.0, 0.6, 3.0, 2.0, 0.2], rival)
    assert told["value"] > 1.5 and told["answer"] == "not shown" and not told["holds"]
    told = by_robust([1.1 * far for far in rival], rival)
    assert told["answer"] == "fails" and not told["holds"]


def test_one_robot_shows_nothing() -> None:
    told = by_robust([9.0], [1.0])
    assert (told["value"], told["ci90"], told["answer"]) == (9.0, None, "not shown")
    assert told["indicative"] and not told["holds"]


def test_a_centimetre_against_a_fall_is_no_ratio() -> None:
    told = by_robust([0.01] * 6, [-0.05] * 6)
    assert told["value"] is None and told["answer"] == "not shown" and not told["holds"]


def test_all_of_four_robots_do_not_show_four_of_five() -> None:
    name = "forward: robots on which PUP comes farther than its rivals"
    four = lines(walks(pup=[2.0] * 4, robust=[1.0] * 4, nominal=[0.5] * 4))[name]
    assert (four["value"], four["answer"]) == (1.0, "not shown") and four["indicative"]
    many = lines(walks(pup=[2.0] * 14, robust=[1.0] * 14, nominal=[0.5] * 14))[name]
    assert many["answer"] == "holds"


def test_a_win_needs_more_than_walks_differ_by_against_each_rival() -> None:
    wide, narrow = [2.0, 2.4, 1.6], [2.1, 2.101, 2.099]
    part = walks(pup=[narrow, narrow, -0.1], robust=[wide, 1.0, -0.2], nominal=[1.0, 1.0, -0.3])
    above = of_direction(part, BUDGETS)["above"]
    assert above["robust"]["value"] == pytest.approx(1 / 3)
    assert above["nominal"]["value"] == pytest.approx(2 / 3)
    assert above["robust and nominal"]["value"] == pytest.approx(1 / 3)


def test_robots_that_are_missing_leave_a_bar_incomplete() -> None:
    told = by_robust([2.0, 2.1, 1.9, None], [1.0, 1.0, 1.0, 1.0])
    assert (told["robots"], told["planned"], told["answer"]) == (3, 4, "incomplete")
    assert not told["holds"]
    told = by_robust([None] * 4, [1.0] * 4)
    assert (told["robots"], told["planned"], told["answer"]) == (0, 4, "incomplete")
    assert "forward: PUP by Nominal" not in lines(walks(pup=[1.0]))  # nobody asks for it


def diagnosis(verdict: str, before: float | None = None, after: float = 0.0) -> dict[str, Any]:
    held = before and {"rmse_before": before, "rmse_after": after}
    return {"verdict": verdict, "findings": [], "held_out": held}


def test_a_robot_that_is_undetermined_improves_by_nothing() -> None:
    plan = Plan(seeds=tuple(range(10)))
    found = {f"diagnosis-r{i}": diagnosis("undetermined") for i in range(6)}
    found |= {f"diagnosis-r{i}": diagnosis("mismatch", 0.01, 0.002) for i in range(6, 10)}
    told = diagnoses(plan, found, found)
    assert (told["planned"], told["undetermined"]) == (10, 6)
    line = lines(walks(pup=[1.0]), told)["error held out is lower by (median)"]
    assert (line["value"], line["robots"], line["answer"]) == (0.0, 10, "fails")
    failed = {name: one for name, one in found.items() if one["verdict"] == "mismatch"}
    line = lines(walks(pup=[1.0]), diagnoses(plan, found, failed))[line["line"]]
    assert (line["value"], line["robots"], line["planned"]) == (pytest.approx(0.8), 4, 10)
    assert line["answer"] == "incomplete" and not line["holds"]


def test_what_is_a_share_of_a_fall_is_left_out_and_told() -> None:
    part = walks(pup=[-0.14, 2.0], pup_prior=[-0.1, 2.0])
    # The second arm's fall is luckier than 95 % of -0.14 m.
    part["searches"] = {
        "pup": {"r0": [-0.2, -0.14], "r1": [0.5, 1.95]},
        "pup+prior": {"r0": [-0.1], "r1": [1.0]},
    }
    needed = of_direction(part, BUDGETS)["needed"]
    assert needed["pup"]["robots"] == {"r1": 2} and needed["pup+prior"]["robots"] == {"r1": None}
    assert [one["not_walking"] for one in needed.values()] == [["r0"], ["r0"]]
    assert needed["pup+prior"]["reached"]["value"] == 0.0
    assert needed["pup+prior"]["reached"]["robots"] == 1
    with drawing_style():
        drawn = [figures.searches(part)]
        del part["searches"]["pup"]["r0"], part["searches"]["pup+prior"]["r0"]
        drawn.append(figures.searches(part))
    assert drawn[0] == drawn[1]


def test_what_was_trained_longer_is_said_to_be_so_but_for_a_control_of_the_same_robots() -> None:
    arms = {"pup_fitted": [1.0] * 3, "pup_corrected_fitted": [1.5] * 3}
    name = "forward: no trials, corrected simulator by the fleet's"
    words = ", not controlled for training budget"
    assert f"{name}{words}" in lines(walks(**arms))
    assert f"{name}{words}" in lines(walks(**arms, pup_own_fitted=[1.1, 1.1, None]))
    assert name in lines(walks(**arms, pup_own_fitted=[1.1] * 3))
    # The control of what was trained on for one robot is none of a fleet's.
    fleet = {"pup_fitted": [1.0] * 3, "pup_diagnosed_fitted": [1.5] * 3}
    name = "forward: no trials, diagnosed fleet by the fleet"
    assert f"{name}{words}" in lines(walks(**fleet, pup_own_fitted=[1.1] * 3))
    assert name in lines(walks(**fleet, pup_undiagnosed_fitted=[1.1] * 3))


class Done:
    """A cell that was done, with what it left."""

    def __init__(self, cell: Cell, out: Path) -> None:
        self.cell, self.files = cell, out / cell.name

    def result(self) -> dict[str, Any]:
        return experiments.result(self.cell)

    def made(self) -> dict[str, Any]:
        return {"host": "here", "ended": "now", "by": {"source_sha256": "0" * 64}}

    def seconds(self) -> float:
        return 1.0


def test_a_policy_that_was_given_on_other_bounds_is_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The made-up fits of robots lie within the fleet's bounds; those of the policy are half."""
    monkeypatch.setattr("services.experiment.gather.Order", Done)
    plan = Plan(stages=("record", "presysid", "policy", "trials"), seeds=tuple(range(1000, 1004)))
    cells = graph(plan)
    own = experiments.result(cells["presysid-fleet"])["parameters"]
    fits = [experiments.result(cells[f"presysid-r{seed}"])["parameters"] for seed in plan.seeds]
    first = [robot[0]["nominal"] for robot in fits]
    upper = [float(np.median(first)), *(p["upper"] for p in own[1:])]
    card = {
        "bounds_sha256": "ab" * 32,
        "provenance": {"options": {"steps": 12345}},
        "parameters": [p["name"] for p in own],
        "parameter_lower": [p["lower"] for p in own],
        "parameter_upper": upper,
    }
    for name, cell in cells.items():
        if cell.kind == "policy":
            (tmp_path / name / "policy").mkdir(parents=True)
            write_json(tmp_path / name / "policy" / "policy.json", card)
    (tmp_path / "presysid-fleet").mkdir()
    write_json(tmp_path / "presysid-fleet" / "bounds.json", {})
    document = gather(plan, cells, {}, tmp_path)
    told = document["policies"]["policy-forward-pup"]
    assert told["given"] and told["other_bounds"] and told["steps"] == 12345
    assert told["bounds_sha256"] == "ab" * 32
    assert told["outside"][own[0]["name"]] == 0.5 and sum(told["outside"].values()) == 0.5
    write_report(document, tmp_path / "report.html")
    text = " ".join(Page(tmp_path / "report.html").text.split())
    found = "given, and trained on bounds (abababababab) that are not this fleet's; 4% of the"
    assert found in text
    assert f"({own[0]['name']} 50%)" in text
