"""Walks of a concealed robot: trials through gateway, agent and bus, and what they tell."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pup.locomotion.conditioning import fitted_eta
from pup.policy.bundle import NumpyPolicy, read_bundle, write_bundle
from pup.robot import RobotDescription
from pup.sysid.result import read_bounds
from services.experiment.cells import SEARCHED
from services.laboratory import Laboratory
from services.transfer import read_simulated
from services.trials import Budget, follow

STUDY = "run"
NOTHING = "nothing"
"""What a policy without eta is told in a study, which needs something to tell."""
KEPT = ("number", "purpose", "eta", "state", "distance", "time", "reason")
"""What is told of a walk; the same however often it was interrupted."""


def walk(
    robot: RobotDescription,
    told: Mapping[str, Any],
    policy: Path,
    bounds: Path | None,
    fitted_on: RobotDescription,
    landscape: Path | None,
    out: Path,
) -> dict[str, Any]:
    """Take a concealed robot through a study; what was interrupted goes on with the same walks.

    Args:
      robot: the robot, of which the concealed one is built.
      told: `character`, `trials`, `repeats`, `horizon` and `seed`.
      policy: bundle.
      bounds: of this robot, whose fitted parameters give the eta that needs no trials; None for a
        policy without eta.
      fitted_on: the description that these bounds are of.
      landscape: simulated rollouts to begin with, or None.
      out: folder for the study, the stores, recordings and logs.

    Returns:
      All walks; distances (m) and times (s) of those of the `chosen` eta and, where there are
      bounds, of the `fitted` one.
    """
    asked = ("trials", "repeats", "seed", "horizon")
    budget = Budget(**{name: told[name] for name in asked})
    compare = []
    if bounds is not None:
        eta = fitted_eta(NumpyPolicy.load(policy, robot), read_bounds(bounds, fitted_on))
        compare = [eta.tolist()]
    walked = conditioned(policy, out / "policy", robot)
    simulated = read_simulated(landscape) if landscape else None
    with Laboratory(out, robot, walked, told["character"]) as laboratory:
        study = follow(laboratory, STUDY, budget, compare, out, lambda _: None, simulated)
    walks = [{name: trial[name] for name in KEPT} for trial in study["trials"]]
    for one in walks:
        one["time"] = one["time"] and round(one["time"], 6)
    return {
        "eta": study["eta"],
        "walks": walks,
        "chosen": _walked(walks, "repeat"),
        "fitted": _walked(walks, "compare") if compare else None,
    }


def conditioned(policy: Path, folder: Path, robot: RobotDescription) -> Path:
    """A bundle that a study can walk: one without eta is given a number that it ignores."""
    card, weights = read_bundle(policy, robot)
    if card.method in SEARCHED:
        return policy
    shape = replace(card.shape, parameters=1)
    seen = {name: value for name, value in weights.items() if not name.startswith("critic.")}
    first = np.asarray(seen["actor.0.weight"])
    seen["actor.0.weight"] = np.concatenate([first, np.zeros_like(first[:, :1])], axis=1)
    card = replace(card, shape=shape, eta_lower=(-1.0,), eta_upper=(1.0,))
    card = replace(card, parameters=(NOTHING,), parameter_lower=(0.0,), parameter_upper=(1.0,))
    write_bundle(folder, card, seen)
    return folder


def _walked(walks: list[dict[str, Any]], purpose: str) -> dict[str, list[float]]:
    told = [w for w in walks if (w["purpose"], w["state"]) == (purpose, "succeeded")]
    return {name: [w[name] for w in told] for name in ("distance", "time")}
