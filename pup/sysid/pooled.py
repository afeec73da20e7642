"""Bounds of a fleet from the fits of its robots, each the subset of Algorithm 1 (section III-B)."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.files import read_json, sha256
from pup.physics.parameters import NETWORK_NAMES, ParameterSpace, robot_space
from pup.physics.terms import TERMS, described
from pup.robot import RobotDescription, TermSpec
from pup.robot_parts import PlaceKind
from pup.sysid.bounds import expanded_range
from pup.sysid.result import Bounds, SubsetFit, read_bounds

Array = NDArray[np.float64]

SHARE = 0.9
"""Of the robots, what `ci90` of a fleet's bounds holds."""
COMMON = ("robot", "bus", "group", "ground")
"""Kinds of places at which an effect may be a fleet's; at a single joint it is that robot's own."""


def shared_terms(
    corrected: Sequence[RobotDescription], robot: RobotDescription
) -> tuple[TermSpec, ...]:
    """What was missing in most of the corrected robots of a fleet, in the median of them.

    A law that was learned for one robot is that robot's alone.

    Args:
      corrected: the robots.
      robot: what they are built after; its own terms are not missing.
    """
    found: dict[tuple[str, PlaceKind, str], list[Array]] = {}
    for term in (term for one in corrected for term in one.terms):
        if term.effect in TERMS and term.kind in COMMON and term not in robot.terms:
            place = term.effect, term.kind, term.name
            found.setdefault(place, []).append(described(term).nominal)
    shared = []
    for (effect, kind, name), told in found.items():
        if 2 * len(told) > len(corrected):
            quantities = (quantity.name for quantity in TERMS[effect].quantities)
            values = map(float, np.median(told, axis=0))
            shared.append(TermSpec(effect, kind, name, dict(zip(quantities, values, strict=True))))
    return tuple(shared)


def pooled(
    files: Sequence[Path],
    robot: RobotDescription,
    corrected: Sequence[RobotDescription] = (),
    shared: Sequence[TermSpec] = (),
) -> Bounds:
    """Bounds that hold the fits of several robots of one kind.

    What random subsets of one robot's recordings are to that robot, its robots are to a fleet: the
    bounds are the range of their fits, widened as Algorithm 1 widens it. The nominal robot is the
    median one, parameter by parameter.

    Args:
      files: a `bounds.json` of each robot. Their networks must be the same: with weights of its own
        a robot's rho and sigma mean something else.
      robot: what the robots are built after.
      corrected: the robot that each file is of, where a diagnosis has corrected them one by one.
      shared: terms whose sizes are bounded too; a robot without one has it in size zero.

    Returns:
      The bounds. `ci90` holds the middle 90 % of the robots, `identified` what the recordings of
      any of them determine, `correlation` is over the robots, `loss` the mean of theirs.

    Raises:
      InputError: there are fewer than two, one is no bounds file of this robot, or their torque
        laws, networks or parameters differ.
    """
    if len(files) < 2:
        raise InputError(f"bounds of a fleet need fits of two robots at least, not {len(files)}")
    robots = corrected or [robot] * len(files)
    fits = [read_bounds(file, one) for file, one in zip(files, robots, strict=True)]
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
    space = _sized(robot_space(robot, first.actuator).select(first.names), shared)
    values = np.array([_told(fit.space, space) for fit in fits])
    space = replace(
        space,
        lower=np.minimum(space.lower, values.min(axis=0)),
        upper=np.maximum(space.upper, values.max(axis=0)),
    )
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
        identified=np.array([any(one.get(name, True) for one in told) for name in space.names]),
        correlation=_correlation(values),
        weights=network,
        imu=space.select(()),
        train={name: float(np.mean([t[name] for t in trained])) for name in ("loss", "rmse")},
        held_out=None,
        subsets=tuple(map(_subset, documents, values)),
        splits=(),
        histories={},
        omitted=tuple(dict.fromkeys(line for d in documents for line in d["omitted"])),
        provenance={"pooled": [sha256(file) for file in files]},
    )


def _sized(space: ParameterSpace, terms: Sequence[TermSpec]) -> ParameterSpace:
    """A robot's parameters with the sizes of terms; their shapes stay what they are."""
    for term in terms:
        more, known = described(term), TERMS[term.effect].quantities
        sizes = [n for n, q in zip(more.names, known, strict=True) if not q.shape]
        space = space.plus(more.select(sizes))
    return space


def _told(fitted: ParameterSpace, space: ParameterSpace) -> Array:
    """The fitted values of a robot, zero for what it has not, shape (n_parameters,)."""
    told = dict(zip(fitted.names, fitted.nominal, strict=True))
    return np.array([told.get(name, 0.0) for name in space.names])


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
