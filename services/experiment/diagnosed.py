"""What diagnoses of concealed robots named, and by how much they lower the error held out."""

from collections.abc import Container, Mapping
from typing import Any

from pup.physics.terms import CLASS_OF
from services.experiment.plan import Plan
from services.experiment.statistics import median, share

CONCEALED = {
    "actuator": (
        *("dry_friction", "load_friction", "speed_loss", "lost_motion"),
        *("delay", "supply", "drift"),
    ),
    "contact": ("ground_compliance", "ground_slope"),
    "body": ("bias", "inertia"),
    "sensor": ("imu",),
}
"""Classes of effects (docs/physics.md) that every virtual robot has, by its parts."""


def diagnoses(plan: Plan, cells: Container[str], found: Mapping[str, Any]) -> dict[str, Any]:
    """Verdicts by robot, and what they come to.

    Args:
      plan: of the experiment.
      cells: names of its cells, those included that failed.
      found: results of its cells by name.

    Returns:
      `robots` with verdict, classes named and errors held out, of `planned`; `undetermined`, on how
      many of them nothing could be told; `named`, the share of robots on which an effect of each
      part was named; `classes`, that of each class; `improvement`, the median share by which the
      corrected simulator lowers the error held out.
    """
    names = {f"r{seed}": f"diagnosis-r{seed}" for seed in plan.seeds}
    robots = {r: _of_robot(found[name]) for r, name in names.items() if name in found}
    rows = list(robots.values())
    known = [row["improvement"] for row in rows if row["improvement"] is not None]
    classes = sorted({name for row in rows for name in row["classes"]})
    return {
        "concealed": {part: list(names) for part, names in CONCEALED.items()},
        "planned": sum(name in cells for name in names.values()),
        "undetermined": sum(row["verdict"] == "undetermined" for row in rows),
        "robots": robots,
        "named": {part: _share([row["named"][part] for row in rows]) for part in CONCEALED},
        "actuator_and_contact": _share(
            [row["named"]["actuator"] and row["named"]["contact"] for row in rows]
        ),
        "classes": {name: _share([name in row["classes"] for row in rows]) for name in classes},
        "improvement": median(known).document(),
    }


def _of_robot(told: Mapping[str, Any]) -> dict[str, Any]:
    classes = sorted({CLASS_OF.get(f["effect"], "unknown") for f in told["findings"]})
    held = told["held_out"]
    before, after = (held["rmse_before"], held["rmse_after"]) if held else (None, None)
    return {
        "verdict": told["verdict"],
        "classes": classes,
        "named": {part: any(c in names for c in classes) for part, names in CONCEALED.items()},
        "rmse_before": before,
        "rmse_after": after,
        "improvement": _improvement(told["verdict"], before, after),
    }


def _improvement(verdict: str, before: float | None, after: float | None) -> float | None:
    """Share by which the error held out is lower; None where nothing was held out."""
    if verdict != "mismatch":
        return 0.0  # nothing was corrected, so this robot's simulator is as bad as before
    return 1 - after / before if before and after is not None else None


def _share(told: list[bool]) -> dict[str, Any]:
    return share(told).document()
