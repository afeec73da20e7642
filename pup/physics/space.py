"""Parameters by name: spaces with units and ranges, and arrays of candidates."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ParameterSpace:
    """Named parameters with their units, nominal values and search ranges.

    Attributes:
      names: one name per parameter.
      units: their units.
      nominal: nominal values, shape (n_parameters,), in those units.
      lower: lower ends of the search ranges, shape (n_parameters,).
      upper: upper ends, shape (n_parameters,).
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    nominal: Array
    lower: Array
    upper: Array

    def __len__(self) -> int:
        return len(self.names)

    def normalise(self, values: Array) -> Array:
        """Physical values (..., n_parameters) to the unit cube of the search ranges."""
        return (values - self.lower) / (self.upper - self.lower)

    def denormalise(self, unit: Array) -> Array:
        """Unit cube (..., n_parameters) to physical values, none beyond its end by a last bit."""
        values = self.lower + unit * (self.upper - self.lower)
        return np.where(unit <= 1.0, np.minimum(values, self.upper), values)

    def select(self, names: Sequence[str]) -> "ParameterSpace":
        """The space of some of the parameters, in the order given."""
        missing = [name for name in names if name not in self.names]
        if missing:
            raise InputError(f"parameter {missing[0]!r} is unknown; known: {', '.join(self.names)}")
        index = [self.names.index(name) for name in names]
        return ParameterSpace(
            tuple(names),
            tuple(self.units[i] for i in index),
            self.nominal[index],
            self.lower[index],
            self.upper[index],
        )

    def at(self, values: Mapping[str, float]) -> "ParameterSpace":
        """The same space with other nominal values; names it lacks are ignored."""
        nominal = np.array(
            [values.get(n, v) for n, v in zip(self.names, self.nominal, strict=True)]
        )
        return ParameterSpace(self.names, self.units, nominal, self.lower, self.upper)

    def plus(self, other: "ParameterSpace") -> "ParameterSpace":
        """Both spaces' parameters, those of the other behind these."""
        return ParameterSpace(
            self.names + other.names,
            self.units + other.units,
            np.append(self.nominal, other.nominal),
            np.append(self.lower, other.lower),
            np.append(self.upper, other.upper),
        )

    def candidates(self, values: Array | None = None) -> "Candidates":
        """Candidates (n_candidates, n_parameters); the nominal one when none is given."""
        rows = self.nominal[None] if values is None else np.atleast_2d(values)
        return Candidates(self, np.ascontiguousarray(rows, dtype=np.float64))


@dataclass(frozen=True)
class Candidates:
    """Candidate parameter sets of one space.

    Attributes:
      space: the parameters.
      values: shape (n_candidates, n_parameters), in the units of the space.
      index: column of each name.
    """

    space: ParameterSpace
    values: Array
    index: dict[str, int] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or self.values.shape[1] != len(self.space):
            raise ValueError(f"candidates of shape {self.values.shape} for {len(self.space)} names")
        object.__setattr__(self, "index", {n: i for i, n in enumerate(self.space.names)})

    def __len__(self) -> int:
        return len(self.values)

    def __contains__(self, name: str) -> bool:
        return name in self.index

    def __getitem__(self, name: str) -> Array:
        """One parameter's values, shape (n_candidates,)."""
        return self.values[:, self.index[name]]

    def columns(self, names: Sequence[str]) -> Array:
        """Several parameters' values, shape (n_candidates, len(names))."""
        return self.values[:, [self.index[name] for name in names]]

    def rows(self, which: slice) -> "Candidates":
        """Some of the candidates."""
        return Candidates(self.space, self.values[which])

    def named(self, row: int = 0) -> dict[str, float]:
        """One candidate as a dictionary."""
        return {n: float(v) for n, v in zip(self.space.names, self.values[row], strict=True)}
