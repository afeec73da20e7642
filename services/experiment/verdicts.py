"""Numbers of an experiment against each other, and against what was to be shown."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from services.experiment.cells import DIAGNOSED, UNDIAGNOSED
from services.experiment.statistics import (
    FEW,
    best_so_far,
    farther,
    mean,
    needed,
    ratio,
    share,
)

ENOUGH = 0.95
"""Share of the distance after all trials that counts as as far."""
PUP = "pup"
RIVALS = ("robust", "nominal", "up")
FITTED = "+fitted"
"""How arms end whose eta is that of the fitted parameters."""
OWN = "own"
"""How the arm ends that is the control of those trained on in their corrected simulators."""
CONTROLS = {"corrected": OWN, DIAGNOSED: UNDIAGNOSED}
"""Arms of policies that were trained on with a diagnosis, and those that were without, by ends."""
FLEETS = ("", f"+{DIAGNOSED}")
"""How arms end: trained for the fleet, and trained on with what its diagnoses share."""
RATIOS = {
    **{f"{PUP}{end} / {r}{end}": (PUP + end, r + end) for end in FLEETS for r in RIVALS},
    "prior / trials": (f"{PUP}+prior", PUP),
    "trials / no trials": (PUP, f"{PUP}+fitted"),
    "corrected / fleet, no trials": (f"{PUP}+corrected+fitted", f"{PUP}+fitted"),
    "own / fleet, no trials": (f"{PUP}+own+fitted", f"{PUP}+fitted"),
    "corrected / own, no trials": (f"{PUP}+corrected+fitted", f"{PUP}+own+fitted"),
    "corrected / fleet": (f"{PUP}+corrected", PUP),
    "diagnosed / fleet, no trials": (f"{PUP}+{DIAGNOSED}+fitted", f"{PUP}+fitted"),
    "undiagnosed / fleet, no trials": (f"{PUP}+{UNDIAGNOSED}+fitted", f"{PUP}+fitted"),
    "diagnosed / undiagnosed, no trials": (
        f"{PUP}+{DIAGNOSED}+fitted",
        f"{PUP}+{UNDIAGNOSED}+fitted",
    ),
    "diagnosed / fleet": (f"{PUP}+{DIAGNOSED}", PUP),
    "diagnosed / undiagnosed": (f"{PUP}+{DIAGNOSED}", f"{PUP}+{UNDIAGNOSED}"),
}
"""Means that are compared, over the robots that have both."""
UNCONTROLLED = ", not controlled for training budget"
HOLDS, NOT_SHOWN, FAILS, INCOMPLETE = "holds", "not shown", "fails", "incomplete"
"""What can be said of a bar."""


def of_direction(part: Mapping[str, Any], budgets: Mapping[str, int]) -> dict[str, Any]:
    """Statistics of a direction.

    Args:
      part: its walks by arm and robot, the distances of its searches, and which robots each arm is
        planned for.
      budgets: steps of policies that are trained on, by the end of their arms.

    Returns:
      `arms`, the mean distance (m) and time (s) of each with the deviation of all walks; `above`,
      the share of robots on which PUP comes farther than what was trained where it was; `ratios` of
      means; `needed`, trials until a walk came as far as 95 % of what PUP comes after all trials.
    """
    walks, planned = part["walks"], part["planned"]
    return {
        "arms": {arm: _arm(told) for arm, told in walks.items()},
        "above": {n: told for end in FLEETS for n, told in _above(walks, planned, end).items()},
        "ratios": {
            name: _ratio(walks, planned, pair) | _control(walks, pair, budgets)
            for name, pair in RATIOS.items()
            if _common(planned, pair)
        },
        "needed": {arm: _needed(part, arm) for arm in part["searches"] if PUP in walks},
    }


def walking(walks: Mapping[str, Any]) -> dict[str, float]:
    """How far PUP comes in the mean after all trials, m, on each robot on which it walks.

    Of one that falls back, 95 % of the distance would be a goal that a luckier fall reaches.
    """
    means = {robot: float(np.mean(told["distance"])) for robot, told in walks[PUP].items()}
    return {robot: far for robot, far in means.items() if far > 0}


def _common(told: Mapping[str, Any], arms: Sequence[str]) -> list[str]:
    """Robots of all these arms."""
    first, *others = (told.get(arm, ()) for arm in arms)
    return [robot for robot in first if all(robot in other for other in others)]


def _ratio(
    walks: Mapping[str, Any], planned: Mapping[str, Any], pair: Sequence[str]
) -> dict[str, Any]:
    means = [
        [float(np.mean(walks[arm][robot]["distance"])) for arm in pair]
        for robot in _common(walks, pair)
    ]
    return ratio(means).document() | {"planned": len(_common(planned, pair))}


def _control(
    walks: Mapping[str, Any], pair: Sequence[str], budgets: Mapping[str, int]
) -> dict[str, bool]:
    """Whether more training alone is ruled out, where a policy is held against where it began.

    It is where the same robots walked with one that was trained on as long without a diagnosis.
    """
    way = pair[0].split("+")[1] if "+" in pair[0] else ""
    if way not in CONTROLS or way not in budgets or pair[1] not in (PUP, PUP + FITTED):
        return {}
    control = f"{PUP}+{CONTROLS[way]}{pair[1].removeprefix(PUP)}"
    robots = _common(walks, pair)
    there = bool(robots) and set(robots) <= walks.get(control, {}).keys()
    return {"controlled": there and budgets[CONTROLS[way]] >= budgets[way]}


def _above(walks: Mapping[str, Any], planned: Mapping[str, Any], end: str) -> dict[str, Any]:
    """On which share of the robots PUP comes farther than its rivals, each and two together."""
    rivals = {rival + end: [rival + end] for rival in RIVALS}
    rivals[f"robust and nominal{end}"] = [f"robust{end}", f"nominal{end}"]
    shares = {}
    for name, others in rivals.items():
        arms = [PUP + end, *others]
        if not _common(planned, arms):
            continue
        told = [[walks[arm][robot]["distance"] for arm in arms] for robot in _common(walks, arms)]
        wins = [all(farther(ours, other) for other in rest) for ours, *rest in told]
        shares[name] = share(wins).document() | {"planned": len(_common(planned, arms))}
    return shares


def _arm(told: Mapping[str, Any]) -> dict[str, Any]:
    document: dict[str, Any] = {}
    for name in ("distance", "time"):
        every = np.concatenate([walk[name] for walk in told.values()])
        deviation = float(every.std(ddof=1)) if len(every) > 1 else None
        within = [np.var(walk[name], ddof=1) for walk in told.values() if len(walk[name]) > 1]
        document[name] = mean([float(np.mean(walk[name])) for walk in told.values()]).document() | {
            "std": deviation,
            "std_of_a_robot": float(np.sqrt(np.mean(within))) if within else None,
            "walks": len(every),
        }
    return document


def _needed(part: Mapping[str, Any], arm: str) -> dict[str, Any]:
    """After how many trials the best walk comes as far as PUP's chosen eta does in the mean."""
    far, searches = walking(part["walks"]), part["searches"][arm]
    told = {
        robot: needed(best_so_far(distances), ENOUGH * far[robot])
        for robot, distances in searches.items()
        if robot in far and distances
    }
    counted = [n for n in told.values() if n is not None]
    return {
        "robots": told,
        "not_walking": [r for r in searches if r in part["walks"][PUP] and r not in far],
        "trials": max(map(len, searches.values()), default=0),
        "median": float(np.median(counted)) if counted else None,
        "reached": share([n is not None for n in told.values()]).document(),
    }


def acceptance(directions: Mapping[str, Any], diagnosed: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What was to be shown, and whether it was: a line for each bar that the plan asks for."""
    lines = [line for name, part in directions.items() for line in _bars(name, part["statistics"])]
    named, improvement = diagnosed["actuator_and_contact"], diagnosed["improvement"]
    planned = {"planned": diagnosed["planned"]}
    lines += [
        _line("robots on which actuator and contact effects are named", named | planned, 0.8),
        _line("error held out is lower by (median)", improvement | planned, 0.5),
    ]
    return [line for line in lines if line["planned"]]


def _bars(direction: str, told: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Lines of a direction."""
    above, ratios = told["above"], told["ratios"]
    lines = []
    for end, name in zip(FLEETS, (direction, f"{direction}, diagnosed fleet"), strict=True):
        both = above.get(f"robust and nominal{end}") or above.get(f"robust{end}")
        by = {rival: ratios.get(f"{PUP}{end} / {rival}{end}") for rival in RIVALS}
        lines += [
            _line(f"{name}: robots on which PUP comes farther than its rivals", both, 0.8),
            _line(f"{name}: PUP by Robust", by["robust"], 1.5),
            _line(f"{name}: PUP by Nominal", by["nominal"], 2.0),
        ]
    for words, name, bar in (
        ("few trials with a prior by all", "prior / trials", 0.95),
        ("no trials, corrected simulator by the fleet's", "corrected / fleet, no trials", 1.3),
        ("no trials, corrected simulator by the robot's own", "corrected / own, no trials", 1.3),
        ("no trials, diagnosed fleet by the fleet", "diagnosed / fleet, no trials", 1.3),
        (
            "no trials, diagnosed fleet by one trained on as long without",
            "diagnosed / undiagnosed, no trials",
            1.3,
        ),
    ):
        lines.append(_line(f"{direction}: {words}", ratios.get(name), bar))
    return lines


def _line(name: str, told: Mapping[str, Any] | None, bar: float) -> dict[str, Any]:
    known = told or {"value": None, "ci90": None, "robots": 0, "planned": 0}
    kept = {key: known[key] for key in ("value", "ci90", "robots", "planned")}
    answer = _answer(known, bar)
    return {
        "line": f"{name}{budget(known)}",
        **kept,
        "bar": bar,
        "answer": answer,
        "holds": answer == HOLDS,
        "indicative": known["robots"] < FEW,
    }


def budget(told: Mapping[str, Any]) -> str:
    """What a comparison is labelled with, where one side was trained longer and nothing tells."""
    return "" if told.get("controlled", True) else UNCONTROLLED


def _answer(told: Mapping[str, Any], bar: float) -> str:
    """What the whole interval says of a bar, not the value alone; nothing where robots miss."""
    value, interval = told["value"], told["ci90"]
    if told["robots"] < told["planned"]:
        return INCOMPLETE
    if value is not None and value < bar:
        return FAILS
    low = interval[0] if interval else None
    return HOLDS if low is not None and low >= bar else NOT_SHOWN
