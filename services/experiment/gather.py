"""`experiment.json`: what all cells found, and what the robots say together."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pup.files import read_json, sha256
from pup.policy.bundle import CARD
from pup.policy.shape import Method
from pup.transfer.trial import TOLD, TrialState
from services.experiment.cells import DIAGNOSED, DIAGNOSED_FLEET, FLEET, UNDIAGNOSED, Cell
from services.experiment.diagnosed import diagnoses
from services.experiment.plan import Plan, Walk, meant
from services.experiment.run import Order, digest
from services.experiment.verdicts import FITTED, acceptance, of_direction
from services.provenance import ALSO, engine, now

SCHEMA = 1
FURTHER = ("own", "corrected")
PRIOR = "-prior"


def gather(
    plan: Plan, cells: Mapping[str, Cell], failed: Mapping[str, str], out: Path
) -> dict[str, Any]:
    """The document of an experiment, as far as it is done.

    Args:
      plan: what was to be done.
      cells: of it.
      failed: those that failed or need some that did, and why.
      out: folder of the experiment.

    Returns:
      See docs/experiment.md.
    """
    done = {name: Order(cell, out) for name, cell in cells.items() if name not in failed}
    found = {name: order.result() for name, order in done.items()}
    directions = {str(w.direction): _direction(plan, w, cells, found) for w in plan.walks}
    budgets = _budgets(plan)
    for part in directions.values():
        part["statistics"] = of_direction(part, budgets)
    diagnosed = diagnoses(plan, cells, found)
    return {
        "schema": SCHEMA,
        "robot": plan.robot,
        "plan": plan.document(),
        "acceptance": acceptance(directions, diagnosed),
        "directions": directions,
        "policies": _policies(plan, done, found),
        "bounds": _bounds(plan, found, FLEET, ""),
        "bounds_diagnosed": _bounds(plan, found, DIAGNOSED_FLEET, "-corrected"),
        "diagnosis": diagnosed,
        "recordings": _recordings(plan, found),
        "real": _real(found),
        "failed": dict(sorted(failed.items())),
        "cells": {name: _cell(order) for name, order in done.items()},
        "written_by": engine(ALSO),
        "written": now(),
    }


def _cell(order: Order) -> dict[str, Any]:
    made = order.made()
    return {
        "kind": order.cell.kind,
        "seconds": order.seconds(),
        "digest": digest(order.result()),
        "host": made["host"],
        "ended": made["ended"],
        "source_sha256": made["by"]["source_sha256"],
    }


def _budgets(plan: Plan) -> dict[str, int]:
    """Steps of policies that are trained on, by the end of their arms."""
    words = dict.fromkeys(FURTHER, plan.train.further)
    words |= dict.fromkeys((DIAGNOSED, UNDIAGNOSED), plan.train.diagnosed)
    return {end: int(meant(told, further=True)["steps"]) for end, told in words.items()}


def _policies(
    plan: Plan, done: Mapping[str, Order], found: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """Where each policy is from: given or trained here, for how many steps, on which bounds."""
    policies = {name: o for name, o in done.items() if o.cell.kind == "policy"}
    fleet = sha256(done[FLEET].files / "bounds.json") if FLEET in done else None
    fits = _own_fits(plan, found, "")
    told = {}
    for name, order in policies.items():
        card, result = read_json(order.files / "policy" / CARD), found[name]
        options = card.get("provenance", {}).get("options", {})
        bounds, given = card.get("bounds_sha256"), result["ready"]
        other = given and None not in (bounds, fleet) and bounds != fleet
        told[name] = {
            "given": given,
            "steps": options.get("steps") if result["steps"] is None else result["steps"],
            "bounds_sha256": bounds,
            "other_bounds": other,
            "outside": _outside(card, fits) if other else {},
        }
    return told


def _outside(card: Mapping[str, Any], fits: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """Share of the robots whose own fit lies outside of a policy's bounds, by parameter."""
    names = ("parameters", "parameter_lower", "parameter_upper")
    ranges = zip(*(card[name] for name in names), strict=True)
    bounds = [{"name": name, "lower": low, "upper": high} for name, low, high in ranges]
    return {name: 1 - share for name, share in _inside(bounds, fits).items()}


def _direction(
    plan: Plan, walk: Walk, cells: Mapping[str, Cell], found: Mapping[str, Any]
) -> dict[str, Any]:
    """Walks and searches of a direction, by arm and robot, and robots that arms are planned for.

    An arm is a method, whose eta was chosen by trials, with what is different: `+prior` where the
    search began with simulated rollouts, `+own` and `+corrected` where the policy was trained on in
    a simulator of this robot, `+diagnosed` in one of the fleet with what its diagnoses share,
    `+undiagnosed` in one without, `+fitted` where eta is that of the fitted parameters, without
    trials.
    """
    walks: dict[str, Any] = {}
    searches: dict[str, Any] = {}
    planned: dict[str, list[str]] = {}
    for seed in plan.seeds[: walk.robots]:
        start = f"trials-r{seed}-{walk.direction}-"
        named = {str(m): f"{start}{m}" for m in walk.methods}
        named |= {f"{m}+prior": f"{start}{m}{PRIOR}" for m in walk.methods}
        named |= {f"{m}+{DIAGNOSED}": f"{start}{m}-{DIAGNOSED}" for m in walk.methods}
        named |= {f"{Method.PUP}+{way}": f"{start}{way}" for way in FURTHER}
        named[f"{Method.PUP}+{UNDIAGNOSED}"] = f"{start}{Method.PUP}-{UNDIAGNOSED}"
        for arm, name in named.items():
            if name not in cells:
                continue
            robot = f"r{seed}"
            planned.setdefault(arm, []).append(robot)
            if "bounds" in cells[name].needs and not name.endswith(PRIOR):
                planned.setdefault(f"{arm}{FITTED}", []).append(robot)
            if name not in found:
                continue
            result = found[name]
            if result["chosen"]["distance"]:
                walks.setdefault(arm, {})[robot] = result["chosen"]
            fitted = result["fitted"]
            if fitted and fitted["distance"] and not name.endswith(PRIOR):
                walks.setdefault(f"{arm}{FITTED}", {})[robot] = fitted
            if fitted is not None:
                searches.setdefault(arm, {})[robot] = _searched(result["walks"])
    return {"walks": walks, "searches": searches, "planned": planned}


def _searched(walks: list[dict[str, Any]]) -> list[float | None]:
    """Distances of a search's trials, m, in order; None where eta was infeasible."""
    searched = (w for w in walks if w["purpose"] in ("initial", "search") and w["state"] in TOLD)
    return [w["distance"] if w["state"] == TrialState.SUCCEEDED else None for w in searched]


def _bounds(
    plan: Plan, found: Mapping[str, Any], fleet_name: str, own_suffix: str
) -> dict[str, Any] | None:
    """Bounds of the fleet, what each robot's own fit says, and how the fleet's went."""
    if fleet_name not in found:
        return None
    fleet = found[fleet_name]
    robots = _own_fits(plan, found, own_suffix)
    return {
        "parameters": fleet["parameters"],
        "loss": fleet["loss"],
        "histories": fleet["histories"],
        "robots": robots,
        "inside": _inside(fleet["parameters"], robots),
    }


def _own_fits(plan: Plan, found: Mapping[str, Any], suffix: str) -> dict[str, dict[str, float]]:
    """Fitted parameters of each robot, by name."""
    fits = {f"r{seed}": found.get(f"presysid-r{seed}{suffix}") for seed in plan.seeds}
    return {
        robot: {p["name"]: p["nominal"] for p in own["parameters"]}
        for robot, own in fits.items()
        if own is not None
    }


def _inside(
    parameters: list[dict[str, Any]], robots: Mapping[str, Mapping[str, float]]
) -> dict[str, float]:
    """Share of the robots whose own fit lies within the fleet's bounds, by parameter."""
    if not robots:
        return {}
    share = {}
    for p in parameters:
        told = [own[p["name"]] for own in robots.values() if p["name"] in own]
        if told:
            within = [p["lower"] <= value <= p["upper"] for value in told]
            share[p["name"]] = sum(within) / len(within)
    return share


def _recordings(plan: Plan, found: Mapping[str, Any]) -> dict[str, Any]:
    told = {f"r{seed}": found.get(f"record-r{seed}") for seed in plan.seeds}
    return {
        robot: {"count": len(one["recordings"]), "stopped": one["stopped"]}
        for robot, one in told.items()
        if one is not None
    }


def _real(found: Mapping[str, Any]) -> dict[str, Any] | None:
    """A real robot's recordings: losses of both torque laws, and errors on motions left out."""
    fits, verdict = found.get("presysid-real"), found.get("diagnosis-real")
    if fits is None and verdict is None:
        return None
    return {
        "histories": fits["histories"] if fits else None,
        "loss": fits["loss"] if fits else None,
        "diagnosis": verdict,
    }
