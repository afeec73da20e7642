"""The unit scale of bounds, on which policies are told mu. Imports no torch."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class UnitScale:
    """0 is the lower and 1 the upper bound; where these are one, a unit of mu is a unit of it.

    Attributes:
      lower: bounds, physical, shape (n_parameters,).
      upper: not below the lower ones.
    """

    lower: Array
    upper: Array

    @property
    def width(self) -> Array:
        """How much 1 is, physical, shape (n_parameters,)."""
        width = self.upper - self.lower
        return np.where(width > 0, width, 1.0)

    def unit(self, mu: Array) -> Array:
        """Physical values on the unit scale, shape (..., n_parameters)."""
        return np.asarray((mu - self.lower) / self.width)

    def physical(self, unit: Array) -> Array:
        """The inverse of `unit`."""
        return np.asarray(self.lower + unit * self.width)
