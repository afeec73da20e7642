"""Free parameters in coordinates of order one.

What is positive is fitted by its logarithm, an effect's magnitudes in their typical sizes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pup.physics.parameters import ParameterSpace
from pup.physics.terms import TERMS, split_column
from pup.physics.terms.scale import Scale

Array = NDArray[np.float64]

SIGNED = 0.01
"""A shape that may be negative, such as an angle, has this share of its limit at coordinate 1."""


@dataclass(frozen=True)
class Coordinate:
    """One free parameter and the coordinate it is fitted in.

    Attributes:
      name: the parameter.
      scale: its size at coordinate 1, in its unit; None where the coordinate is its logarithm.
      lower: smallest coordinate.
      upper: largest coordinate.
    """

    name: str
    scale: float | None
    lower: float
    upper: float

    def value(self, coordinate: float) -> float:
        """The parameter, in its unit."""
        return float(np.exp(coordinate) if self.scale is None else coordinate * self.scale)

    def coordinate(self, value: float) -> float:
        """Where a value lies."""
        told = np.log(max(value, 1e-300)) if self.scale is None else value / self.scale
        return float(np.clip(told, self.lower, self.upper))

    def slope(self, coordinate: float) -> float:
        """The parameter's change per change of the coordinate."""
        return float(np.exp(coordinate)) if self.scale is None else self.scale


@dataclass(frozen=True, eq=False)
class Belief:
    """Where coordinates are believed to lie, before data say anything.

    Attributes:
      at: shape (n_coordinates,).
      precision: inverse variance of each, as chi-squared counts, same shape.
    """

    at: Array
    precision: Array

    def cost(self, at: Array) -> float:
        """What it costs to lie elsewhere, as chi-squared."""
        return float(self.precision @ (at - self.at) ** 2)

    def pull(self, at: Array) -> Array:
        """Half of that cost's slope downhill, shape (n_coordinates,)."""
        return np.asarray(self.precision * (self.at - at))


def nominal_coordinate(space: ParameterSpace, name: str) -> Coordinate:
    """The coordinate of a nominal parameter, which is positive."""
    i = space.names.index(name)
    low = max(space.lower[i], 1e-4 * space.upper[i])
    return Coordinate(name, None, float(np.log(low)), float(np.log(space.upper[i])))


def described_at(coordinates: Sequence[Coordinate], space: ParameterSpace) -> Array:
    """Where the robot as it is described lies, shape (n_coordinates,)."""
    values = (space.nominal[space.names.index(c.name)] for c in coordinates)
    return np.array([c.coordinate(v) for c, v in zip(coordinates, values, strict=True)])


def term_coordinate(name: str, scale: Scale) -> Coordinate:
    """The coordinate of a term's quantity on a robot of some strength."""
    told = split_column(name)
    assert told is not None
    quantity = next(q for q in TERMS[told[0]].quantities if q.name == told[1])
    factor = scale.factor(quantity.unit)
    if quantity.shape and quantity.signed:
        width = SIGNED * quantity.limit
        return Coordinate(name, width * factor, quantity.lower / width, quantity.limit / width)
    if quantity.shape:
        lower, upper = np.log(quantity.lower * factor), np.log(quantity.limit * factor)
        return Coordinate(name, None, float(lower), float(upper))
    return Coordinate(
        name,
        quantity.typical * factor,
        quantity.lower / quantity.typical,
        quantity.limit / quantity.typical,
    )
