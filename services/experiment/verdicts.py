"""Numbers of an experiment against each other, and against what was to be shown."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from services.experiment.cells import DIAGNOSED
from services.experiment.statistics import (
    best_so_far,
    estimate,
    mean,
    needed,
    ratio,
    share_above,
    share_true,
)

ENOUGH = 0.95
"""Share of the distance after all trials that counts as as far."""
PUP = "pup"
RIVALS = ("robust", "nominal", "up")
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
    "diagnosed / fleet": (f"{PUP}+{DIAGNOSED}", PUP),
}
"""Means that are compared, over the robots that have both."""


def of_direction(part: Mapping[str, Any], seed: int) -> dict[str, Any]:
    """Statistics of a direction.

    Args:
      part: its walks by arm and robot, and the distances of its searches.
      seed: of the bootstrap.

    Returns:
      `arms`, the mean distance (m) and time (s) of each with the deviation of all walks; `above`,
      the share of robots on which PUP comes farther than what was trained where it was; `ratios` of
      means; `needed`, trials until a walk came as far as 95 % of what PUP comes after all trials.
    """
    walks = part["walks"]
    return {
        "arms": {arm: _arm(told, seed) for arm, told in walks.items()},
        "above": {n: share for end in FLEETS for n, share in _above(walks, end, seed).items()},
        "ratios": {
            name: estimate(ratio, _means(walks, pair), seed).document()
            for name, pair in RATIOS.items()
            if all(arm in walks for arm in pair)
        },
        "needed": {arm: _needed(part, arm, seed) for arm in part["searches"] if PUP in walks},
    }


def _means(walks: Mapping[str, Any], arms: Sequence[str]) -> list[list[float]]:
    """Mean distances of arms, a row for each robot that has walked all of them."""
    robots = [r for r in walks[arms[0]] if all(r in walks[arm] for arm in arms)]
    return [[float(np.mean(walks[arm][r]["distance"])) for arm in arms] for r in robots]


def _above(walks: Mapping[str, Any], end: str, seed: int) -> dict[str, Any]:
    """On which share of the robots PUP comes farther than its rivals, each and two together."""
    rivals = {rival + end: [rival + end] for rival in RIVALS if rival + end in walks}
    both = [f"robust{end}", f"nominal{end}"]
    if rivals.keys() >= set(both):
        rivals[f"robust and nominal{end}"] = both
    first = PUP + end
    rows = {n: _means(walks, [first, *r]) if first in walks else [] for n, r in rivals.items()}
    return {name: estimate(share_above, told, seed).document() for name, told in rows.items()}


def _arm(told: Mapping[str, Any], seed: int) -> dict[str, Any]:
    document: dict[str, Any] = {}
    for name in ("distance", "time"):
        rows = [[float(np.mean(walk[name]))] for walk in told.values()]
        every = np.concatenate([walk[name] for walk in told.values()])
        deviation = float(every.std(ddof=1)) if len(every) > 1 else None
        within = [np.var(walk[name], ddof=1) for walk in told.values() if len(walk[name]) > 1]
        document[name] = estimate(mean, rows, seed).document() | {
            "std": deviation,
            "std_of_a_robot": float(np.sqrt(np.mean(within))) if within else None,
            "walks": len(every),
        }
    return document


def _needed(part: Mapping[str, Any], arm: str, seed: int) -> dict[str, Any]:
    """After how many trials the best walk comes as far as PUP's chosen eta does in the mean."""
    goals = {r: ENOUGH * float(np.mean(w["distance"])) for r, w in part["walks"][PUP].items()}
    told = {
        robot: needed(best_so_far(distances), goals[robot])
        for robot, distances in part["searches"][arm].items()
        if robot in goals and distances
    }
    longest = max(map(len, part["searches"][arm].values()), default=0)
    reached = estimate(share_true, [[float(n is not None)] for n in told.values()], seed)
    counted = [n for n in told.values() if n is not None]
    return {
        "robots": told,
        "trials": longest,
        "median": float(np.median(counted)) if counted else None,
        "reached": reached.document(),
    }


def acceptance(directions: Mapping[str, Any], diagnosed: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What was to be shown, and whether it was: a line for each bar."""
    lines = []
    for direction, part in directions.items():
        above, ratios = part["statistics"]["above"], part["statistics"]["ratios"]
        for end, name in zip(FLEETS, (direction, f"{direction}, diagnosed fleet"), strict=True):
            both = above.get(f"robust and nominal{end}") or above.get(f"robust{end}")
            by = {rival: ratios.get(f"{PUP}{end} / {rival}{end}") for rival in RIVALS}
            lines += [
                _line(f"{name}: robots on which PUP comes farther than its rivals", both, 0.8),
                _line(f"{name}: PUP by Robust", by["robust"], 1.5),
                _line(f"{name}: PUP by Nominal", by["nominal"], 2.0),
            ]
        lines += [
            _line(
                f"{direction}: few trials with a prior by all", ratios.get("prior / trials"), 0.95
            ),
            _line(
                f"{direction}: no trials, corrected simulator by the fleet's",
                ratios.get("corrected / fleet, no trials"),
                1.3,
            ),
            _line(
                f"{direction}: no trials, diagnosed fleet by the fleet",
                ratios.get("diagnosed / fleet, no trials"),
                1.3,
            ),
        ]
    lines += [
        _line(
            "robots on which actuator and contact effects are named",
            diagnosed["actuator_and_contact"],
            0.8,
        ),
        _line("error held out is lower by (median)", diagnosed["improvement"], 0.5),
    ]
    return [line for line in lines if line["robots"]]


def _line(name: str, told: Mapping[str, Any] | None, bar: float) -> dict[str, Any]:
    known = told or {"value": None, "ci90": None, "robots": 0}
    value = known["value"]
    # A ratio to nothing has no number, and is above any bar.
    holds = bool(known["robots"]) and (value is None or value >= bar)
    return {"line": name, **known, "bar": bar, "holds": holds}
