"""Made-up results of the cells of an experiment, for tests of what is made of them."""

from typing import Any

import numpy as np

from pup.robot import RobotDescription
from pup.sysid.result import read_bounds
from services.experiment.cells import Cell

DARWIN = RobotDescription.load("darwin_op2")
MEANS = {"pup": 1.2, "up": 1.0, "robust": 0.7, "nominal": 0.4, "corrected": 1.4, "own": 1.25}
"""How far each arm comes in the mean, m."""
FURTHER = 1.1
"""By how much more where it was trained on with what diagnoses share."""


def result(cell: Cell) -> dict[str, Any]:
    """What a cell might find; the same for the same cell."""
    rng = np.random.default_rng(list(cell.name.encode()))
    return dict(MAKERS[cell.kind](cell, rng))


def _record(cell: Cell, rng: np.random.Generator) -> dict[str, Any]:
    stopped = {"r1001_fall_left": "stopped by overload: <b>"} if "1001" in cell.name else {}
    return {"recordings": {"a": "0" * 64, "b": "1" * 64}, "stopped": stopped}


def _presysid(cell: Cell, rng: np.random.Generator) -> dict[str, Any]:
    bounds = read_bounds(DARWIN.identified_path, DARWIN)
    space = bounds.space.select(bounds.names)
    shift = 0.2 * rng.uniform(-1, 1, len(bounds.names)) * (bounds.upper - bounds.lower)
    middle = (bounds.lower + bounds.upper) / 2
    parameters = [
        {
            "name": name,
            "unit": "1",
            "nominal": float(middle[i] + shift[i]),
            "lower": float(bounds.lower[i]),
            "upper": float(bounds.upper[i]),
            "search": [float(space.lower[i]), float(space.upper[i])],
            "identified": name != "sigma/head",
        }
        for i, name in enumerate(bounds.names)
    ]
    fall = np.exp(-np.arange(50) / 12)
    histories = {"nn_pd": (1.5 + 3 * fall).tolist(), "pd": (2.1 + 2 * fall).tolist()}
    loss = {"train": {"loss": 1.5, "rmse": 0.01}, "held_out": None}
    kept = {"parameters": parameters, "actuator": {"kind": "nn_pd", "weights": []}, "splits": []}
    return kept | {"loss": loss, "histories": histories}


def _policy(cell: Cell, rng: np.random.Generator) -> dict[str, Any]:
    return {"weights": "2" * 64, "ready": True, "steps": None}


def _landscape(cell: Cell, rng: np.random.Generator) -> dict[str, Any]:
    return {"simulated": "3" * 64}


def _trials(cell: Cell, rng: np.random.Generator) -> dict[str, Any]:
    arm = next(part for part in reversed(cell.name.split("-")) if part in MEANS)
    far = MEANS[arm] * float(np.exp(rng.normal(0, 0.15)))
    far *= FURTHER if cell.name.endswith("-diagnosed") else 1.0
    searched = "bounds" in cell.needs

    def some(count: int, share: float) -> list[float]:
        return (far * share * np.exp(rng.normal(0, 0.1, count))).tolist()

    trials = some(cell.told["trials"], 0.8)
    walks = [
        {"number": i + 1, "purpose": "search", "eta": [0.1], "state": "succeeded"}
        | {"distance": distance, "time": 9.0, "reason": "fall"}
        for i, distance in enumerate(trials)
    ]

    def walked(share: float) -> dict[str, list[float]]:
        distance = some(cell.told["repeats"], share)
        return {"distance": distance, "time": [8 * d + 2 for d in distance]}

    fitted = walked(0.7) if searched else None
    return {"eta": [0.1], "walks": walks, "chosen": walked(1.0), "fitted": fitted}


def _diagnosis(cell: Cell, rng: np.random.Generator) -> dict[str, Any]:
    effects = ["coulomb_friction", "torque_speed_limit", "backlash", "ground_compliance"]
    named = effects[: int(rng.integers(1, 5))]
    place = {"kind": "group", "names": ["knee"]}
    before = 0.012 * float(np.exp(rng.normal(0, 0.1)))
    motions = {"step": {"before": before, "after": 0.4 * before}}
    models = {
        name: {"rmse": size, "per_motion": {"step": size, "standup": 1.4 * size}}
        for name, size in (("PD", 0.016), ("NN-PD", 0.014), ("network", 0.013), ("found", 0.009))
    }
    return {
        "verdict": "mismatch",
        "converged": True,
        "noise_floor": {"rms": 0.001, "source": "assumed"},
        "findings": [{"effect": e, "place": place, "probability": 0.9} for e in named],
        "held_out": {"rmse_before": before, "rmse_after": 0.45 * before, "per_motion": motions},
        "next_recording": None,
        "rivals": {"models": models} if cell.told["rivals"] else None,
    }


MAKERS = {
    "record": _record,
    "presysid": _presysid,
    "policy": _policy,
    "landscape": _landscape,
    "trials": _trials,
    "pooled": _presysid,
    "diagnosis": _diagnosis,
}
