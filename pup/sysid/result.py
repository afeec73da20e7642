"""The outcome of pre-sysID and its file, `bounds.json` (docs/presysid.md)."""

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.files import read_json, write_json
from pup.physics.parameters import NETWORK_NAMES, ParameterSpace, robot_space
from pup.robot import Actuator, RobotDescription
from pup.sysid.bounds import Split
from pup.sysid.imu import imu_names, with_imu

Array = NDArray[np.float64]
SCHEMA = 1
AT_END = 0.01
"""Share of a search range from an end of which on a value stands there: the best may lie beyond."""


@dataclass(frozen=True)
class SubsetFit:
    """One subset's fit.

    Attributes:
      recordings: ids of the subset.
      contact: whether any of them is on the ground.
      loss: equation 1 over the subset, without the regulariser.
      values: fitted bounded parameters, physical, shape (n_parameters,); NaN for those that the
        subset's recordings cannot see.
    """

    recordings: tuple[str, ...]
    contact: bool
    loss: float
    values: Array


@dataclass(frozen=True)
class Bounds:
    """What pre-sysID found.

    Attributes:
      robot: name of the robot.
      actuator: torque law of the fit, `nn_pd` or `pd`.
      space: the bounded parameters (14 for the Darwin OP2).
      nominal: their nominal fit, physical, shape (n_parameters,).
      lower: lower bounds of Algorithm 1.
      upper: upper bounds.
      ci90: 90 % intervals of the nominal fit, shape (n_parameters, 2). Values that were kept are
        taken as known: both ends are the value.
      identified: whether the recordings determine each parameter, shape (n_parameters,).
      correlation: of the bounded parameters, shape (n_parameters, n_parameters).
      weights: the network's weights, shape (27,); empty for `pd`.
      imu: what was fitted of how the IMU sits and how late it tells, with its values as the nominal
        ones; empty where it was taken to be as described.
      train: measures of the nominal fit on the recordings it saw: `loss`, `rmse`.
      held_out: the same on recordings left out, or None.
      subsets: the subset fits.
      splits: parameters tested for a split between subsets with and without contact.
      histories: best equation 1 so far, per generation of each actuator's nominal fit.
      omitted: what of equation 1, and of the range of the subset fits, the recordings could not
        give, in words.
      provenance: how it came about.
    """

    robot: str
    actuator: Actuator
    space: ParameterSpace
    nominal: Array
    lower: Array
    upper: Array
    ci90: Array
    identified: NDArray[np.bool_]
    correlation: Array
    weights: Array
    imu: ParameterSpace
    train: dict[str, float]
    held_out: dict[str, float] | None
    subsets: tuple[SubsetFit, ...]
    splits: tuple[Split, ...]
    histories: dict[str, Array]
    omitted: tuple[str, ...]
    provenance: dict[str, Any] = field(default_factory=dict)

    @property
    def at_end(self) -> NDArray[np.bool_]:
        """Whether each nominal value stands at an end of its search range, to 1 % of it."""
        unit = self.space.normalise(self.nominal)
        return np.asarray((unit < AT_END) | (unit > 1 - AT_END))

    def as_before(self, file: Path) -> "Bounds":
        """The same with the seconds that a file tells, where it tells the same but for these.

        Trainings and studies know bounds by the SHA-256 of their file: what is made again from its
        checkpoints must be the same to the last byte.
        """
        try:
            before = read_json(file)
            provenance = self.provenance | {"seconds": before["provenance"]["seconds"]}
        except (InputError, LookupError, TypeError):  # there is none, or it is something else
            return self
        again = replace(self, provenance=provenance)
        return again if json.loads(json.dumps(again.document())) == before else self

    def write(self, path: Path) -> None:
        """Write `bounds.json`."""
        write_json(path, self.document())

    def document(self) -> dict[str, Any]:
        """The JSON document."""
        return {
            "schema": SCHEMA,
            "robot": self.robot,
            "parameters": [self._parameter(i) for i in range(len(self.space))],
            "actuator": {"kind": self.actuator, "weights": self.weights.tolist()},
            "imu": [
                {"name": name, "unit": unit, "nominal": float(value)}
                for name, unit, value in zip(
                    self.imu.names, self.imu.units, self.imu.nominal, strict=True
                )
            ],
            "loss": {"train": self.train, "held_out": self.held_out},
            "subsets": [
                {
                    "recordings": list(s.recordings),
                    "contact": s.contact,
                    "loss": s.loss,
                    "parameters": self._named(s.values),
                }
                for s in self.subsets
            ],
            "correlation": self.correlation.tolist(),
            "splits": [_split(s) for s in self.splits],
            "histories": {name: values.tolist() for name, values in self.histories.items()},
            "omitted": list(self.omitted),
            "provenance": self.provenance,
        }

    def _named(self, values: Array) -> dict[str, float]:
        named = zip(self.space.names, map(float, values), strict=True)
        return {name: value for name, value in named if not np.isnan(value)}

    def _parameter(self, i: int) -> dict[str, Any]:
        return {
            "name": self.space.names[i],
            "unit": self.space.units[i],
            "nominal": float(self.nominal[i]),
            "lower": float(self.lower[i]),
            "upper": float(self.upper[i]),
            "search": [float(self.space.lower[i]), float(self.space.upper[i])],
            "ci90": [float(v) for v in self.ci90[i]],
            "identified": bool(self.identified[i]),
            "at_end": bool(self.at_end[i]),
        }


def _split(split: Split) -> dict[str, Any]:
    return {
        "parameter": split.name,
        "with_contact": split.with_contact.tolist(),
        "without_contact": split.without.tolist(),
        "separation": _number(split.separation),
        "p_value": _number(split.p_value),
        "two_cluster_p_value": split.two_clusters,
        "split": split.split,
    }


def _number(value: float) -> float | None:
    """JSON has no NaN: a test that could not be made is null."""
    return None if np.isnan(value) else value


def read_fitted(path: Path, robot: RobotDescription) -> tuple[Actuator, ParameterSpace]:
    """Read a `bounds.json` or `identified.json` as a fitted point.

    Args:
      path: the file.
      robot: the robot it should be of.

    Returns:
      The torque law and the robot's space for it with the fitted values as the nominal ones; with
      the parameters of an IMU that was fitted beside.

    Raises:
      InputError: the file is not a bounds file, or not of this robot.
    """
    document = read_json(path)
    try:
        if document["schema"] != SCHEMA:
            raise InputError(f"{path}: schema {document['schema']!r}; this pup reads {SCHEMA}")
        if document["robot"] != robot.name:
            raise InputError(f"{path}: bounds of robot {document['robot']!r}, not {robot.name!r}")
        kind = document["actuator"]["kind"]
        values = {p["name"]: float(p["nominal"]) for p in document["parameters"]}
        names = [p["name"] for p in document["parameters"]]
        weights = [float(weight) for weight in document["actuator"]["weights"]]
        imu = {p["name"]: float(p["nominal"]) for p in document.get("imu", [])}
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        told = f"it has no {error}" if isinstance(error, KeyError) else str(error)
        raise InputError(f"{path}: not a bounds file of pup presysid: {told}") from error
    try:
        space = robot_space(robot, kind)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    unknown = [name for name in values if name not in space.names]
    if unknown:
        raise InputError(f"{path}: parameter {unknown[0]!r} is not one of robot {robot.name!r}")
    if twice := [name for name in values if names.count(name) > 1]:
        raise InputError(f"{path}: parameter {twice[0]!r} stands there more than once")
    if kind == "nn_pd" and len(weights) != len(NETWORK_NAMES):
        raise InputError(f"{path}: {len(weights)} network weights, {len(NETWORK_NAMES)} expected")
    values |= dict(zip(NETWORK_NAMES, weights, strict=False))
    for name, value in (values | imu).items():
        if not np.isfinite(value):
            raise InputError(f"{path}: parameter {name!r} is {value}; expected a finite number")
    if imu:
        space = with_imu(space)
        if strange := [name for name in imu if name not in imu_names(space)]:
            raise InputError(f"{path}: parameter {strange[0]!r} is not one of an IMU")
    return kind, space.at(values | imu)


def fitted_to(path: Path) -> frozenset[str] | None:
    """Digests of the recordings that a bounds file was fitted to; None where it does not tell.

    A fit that began at another's values may have kept some of them, and names its own recordings
    alone.

    Raises:
      InputError: the file is not JSON.
    """
    try:
        told = read_json(path)["provenance"]
        began = "start" in told.get("options", ())
        return None if began else frozenset(map(str, told["recordings"].values()))
    except (LookupError, TypeError, AttributeError):
        return None


@dataclass(frozen=True)
class FittedBounds:
    """Bounds to draw parameters from.

    Attributes:
      actuator: torque law, `nn_pd` or `pd`.
      space: all of the robot's parameters for it, with the fitted values as the nominal ones.
      names: the bounded parameters.
      lower: their lower bounds, physical, shape (n_bounded,).
      upper: upper bounds, not below the lower ones.
    """

    actuator: Actuator
    space: ParameterSpace
    names: tuple[str, ...]
    lower: Array
    upper: Array


def read_bounds(path: Path, robot: RobotDescription) -> FittedBounds:
    """Read a `bounds.json` or `identified.json` as a box around a fitted point.

    Raises:
      InputError: as `read_fitted`; bounds that are absent, not finite or the wrong way round; and
        bounds or a fitted value outside the search range, where there is nothing to simulate.
    """
    actuator, space = read_fitted(path, robot)
    names, lower, upper = [], [], []
    for entry in read_json(path)["parameters"]:
        name = entry["name"]
        try:
            low, high = float(entry["lower"]), float(entry["upper"])
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise InputError(f"{path}: parameter {name!r} has no bounds lower and upper") from error
        if not -np.inf < low <= high < np.inf:
            raise InputError(f"{path}: parameter {name!r}: [{low:g}, {high:g}] are no bounds")
        _check_range(path, space.select((name,)), low, high)
        names.append(name)
        lower.append(low)
        upper.append(high)
    if not names:
        raise InputError(f"{path}: no bounded parameter in it")
    return FittedBounds(actuator, space, tuple(names), np.array(lower), np.array(upper))


def _check_range(path: Path, space: ParameterSpace, low: float, high: float) -> None:
    """Refuse bounds that do not reach into the search range of their parameter, or a value beyond.

    Args:
      path: of the bounds.
      space: the parameter, with the fitted value as the nominal one.
      low: lower bound.
      high: upper bound.
    """
    ((name, least, most, value),) = zip(
        space.names, space.lower, space.upper, space.nominal, strict=True
    )
    rounding = 1e-9 * (most - least)  # of what was put back from the unit cube
    if not (low <= most + rounding and high >= least - rounding):
        what = f"bounds [{low:g}, {high:g}]"
    elif not least - rounding <= value <= most + rounding:
        what = f"nominal {value:g}"
    else:
        return
    raise InputError(
        f"{path}: parameter {name!r}: {what} outside its search range {least:g} to {most:g} in the "
        "robot's description; give bounds that were found with this description"
    )
