"""Bounds of a fleet from the fits of its robots, each the subset of Algorithm 1 (section III-B)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.files import read_json, sha256
from pup.physics.parameters import NETWORK_NAMES
from pup.robot import RobotDescription
from pup.sysid.bounds import expanded_range
from pup.sysid.result import Bounds, SubsetFit, read_bounds

Array = NDArray[np.float64]

SHARE = 0.9
"""Of the robots, what `ci90` of a fleet's bounds holds."""


def pooled(files: Sequence[Path], robot: RobotDescription) -> Bounds:
    """Bounds that hold the fits of several robots of one kind.

    What random subsets of one robot's recordings are to that robot, its robots are to a fleet: the
    bounds are the range of their fits, widened as Algorithm 1 widens it. The nominal robot is the
    median one, parameter by parameter.

    Args:
      files: a `bounds.json` of each robot. Their networks must be the same: with weights of its own
        a robot's rho and sigma mean something else.
      robot: what the robots are built after.

    Returns:
      The bounds. `ci90` holds the middle 90 % of the robots, `identified` what the recordings of
      any of them determine, `correlation` is over the robots, `loss` the mean of theirs.

    Raises:
      InputError: there are fewer than two, one is no bounds file of this robot, or their torque
        laws, networks or parameters differ.
    """
    if len(files) < 2:
        raise InputError(f"bounds of a fleet need fits of two robots at least, not {len(files)}")
    fits = [read_bounds(file, robot) for file in files]
    first = fits[0]
    weights = [name for name in first.space.names if name in NETWORK_NAMES]
    network = first.space.select(weights).nominal
    for file, fit in zip(files, fits, strict=True):
        if (fit.actuator, fit.names) != (first.actuator, first.names):
            raise InputError(f"{file}: of another torque law or other parameters than {files[0]}")
        if not np.array_equal(fit.space.select(weights).nominal, network):
            raise InputError(
                f"{file}: another network than in {files[0]}; fit robots with fixed_network"
            )
    values = np.array([fit.space.select(fit.names).nominal for fit in fits])
    space = first.space.select(first.names)
    middle = np.median(values, axis=0)
    lower, upper = expanded_range(values, space)
    documents = [read_json(file) for file in files]
    told = [
        {p["name"]: bool(p.get("identified", True)) for p in d["parameters"]} for d in documents
    ]
    trained = [document["loss"]["train"] for document in documents]
    return Bounds(
        robot=robot.name,
        actuator=first.actuator,
        space=space,
        nominal=middle,
        lower=lower,
        upper=upper,
        ci90=np.quantile(values, ((1 - SHARE) / 2, (1 + SHARE) / 2), axis=0).T,
        identified=np.array([any(one[name] for one in told) for name in space.names]),
        correlation=_correlation(values),
        weights=network,
        train={name: float(np.mean([t[name] for t in trained])) for name in ("loss", "rmse")},
        held_out=None,
        subsets=tuple(map(_subset, documents, values)),
        splits=(),
        histories={},
        omitted=tuple(dict.fromkeys(line for d in documents for line in d["omitted"])),
        provenance={"pooled": [sha256(file) for file in files]},
    )


def _correlation(values: Array) -> Array:
    """Of parameters over robots, shape (n_robots, n_parameters); 0 where no two robots differ."""
    away = values - values.mean(axis=0)
    length = np.linalg.norm(away, axis=0)
    unit = away / np.where(length > 0, length, 1.0)
    found = unit.T @ unit
    np.fill_diagonal(found, 1.0)
    return np.asarray(found)


def _subset(document: dict[str, Any], values: Array) -> SubsetFit:
    """A robot's fit."""
    recordings = {name for subset in document["subsets"] for name in subset["recordings"]}
    recordings |= set(document["provenance"].get("recordings", ()))
    contact = any(subset["contact"] for subset in document["subsets"])
    return SubsetFit(tuple(sorted(recordings)), contact, document["loss"]["train"]["loss"], values)
