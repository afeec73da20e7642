"""A torque law that was read off the data, for what no effect of the library explains.

A law is a sum of features of what a servo sees and does, each times a coefficient with a unit of
its own. Every feature is a quantity of the term, so that a law stands in a robot's description as
what it is: `values = { "|u|*sgn(v)" = -0.12 }`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import combinations_with_replacement
from types import MappingProxyType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from pup.physics.terms.base import Flow, Outcome, Quantity, Term, begin

Array = NDArray[np.float64]

SLOW = 0.05
"""Speed below which the sign of a speed fades, rad/s."""
NEAR = 0.003
"""Error below which the sign of an error fades, rad."""
OLDEST = 2.0
"""A command does not grow older than this, s."""
MOST = 1e3
"""Largest coefficient, in typical sizes."""


@dataclass(frozen=True)
class Seen:
    """What a law may depend on, arrays of one shape.

    Attributes:
      position: of the joint, rad.
      velocity: rad/s.
      error: command minus position, rad.
      torque: of the servo, N m.
      time: since the recording's start, s.
      age: since the command last changed, s.
    """

    position: Array
    velocity: Array
    error: Array
    torque: Array
    time: Array | float
    age: Array


@dataclass(frozen=True)
class Factor:
    """One factor of a feature.

    Attributes:
      of: its value.
      powers: of N m, rad and s in its unit.
      typical: its usual size, in that unit.
    """

    of: Callable[[Seen], Array | float]
    powers: tuple[int, int, int]
    typical: float


def _ripple(function: Callable[[Array], Array], turns: int) -> Factor:
    return Factor(lambda s: function(turns * s.position), (0, 0, 0), 1.0)


FACTORS: Mapping[str, Factor] = MappingProxyType(
    {
        "1": Factor(lambda s: np.ones_like(s.position), (0, 0, 0), 1.0),
        "q": Factor(lambda s: s.position, (0, 1, 0), 0.5),
        "v": Factor(lambda s: s.velocity, (0, 1, -1), 1.0),
        "e": Factor(lambda s: s.error, (0, 1, 0), 0.05),
        "u": Factor(lambda s: s.torque, (1, 0, 0), 0.5),
        "|v|": Factor(lambda s: np.abs(s.velocity), (0, 1, -1), 1.0),
        "|e|": Factor(lambda s: np.abs(s.error), (0, 1, 0), 0.05),
        "|u|": Factor(lambda s: np.abs(s.torque), (1, 0, 0), 0.5),
        "sgn(v)": Factor(lambda s: np.tanh(s.velocity / SLOW), (0, 0, 0), 1.0),
        "sgn(e)": Factor(lambda s: np.tanh(s.error / NEAR), (0, 0, 0), 1.0),
        "t": Factor(lambda s: s.time, (0, 0, 1), 5.0),
        "age": Factor(lambda s: np.minimum(s.age, OLDEST), (0, 0, 1), 0.5),
    }
)
RIPPLES: Mapping[str, Factor] = MappingProxyType(
    {
        f"{name}({k}q)" if k > 1 else f"{name}(q)": _ripple(function, k)
        for name, function in (("sin", np.sin), ("cos", np.cos))
        for k in (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48)
    }
)
BRAKES = ("v", "sgn(v)")
"""Factors that turn with the speed: what they brake is taken implicitly."""
SAME = frozenset(
    {("v", "sgn(v)"), ("e", "sgn(e)"), ("sgn(v)", "sgn(v)"), ("sgn(e)", "sgn(e)")}
    | {(f"|{x}|", f"|{x}|") for x in "veu"}
    | {(f"|{x}|", f"sgn({x})") for x in "ve"}
)
"""Products that are another feature."""


def _features() -> dict[str, tuple[str, ...]]:
    names = [name for name in FACTORS if name != "1"]
    single = {name: (name,) for name in (*FACTORS, *RIPPLES)}
    pairs = [p for p in combinations_with_replacement(names, 2) if p not in SAME]
    return single | {"*".join(pair): pair for pair in pairs}


FEATURES: Mapping[str, tuple[str, ...]] = MappingProxyType(_features())
"""All features, with their factors."""


def factor(name: str) -> Factor:
    """A factor by its name."""
    return FACTORS[name] if name in FACTORS else RIPPLES[name]


def value(feature: str, seen: Seen) -> Array:
    """A feature, in the product of its factors' units."""
    parts = [np.asarray(factor(name).of(seen)) for name in FEATURES[feature]]
    return np.asarray(np.prod(np.broadcast_arrays(*parts), axis=0))


def unit(feature: str) -> str:
    """Unit of a feature's coefficient, of which the product is a torque."""
    powers = [1, 0, 0]
    for name in FEATURES[feature]:
        powers = [a - b for a, b in zip(powers, factor(name).powers, strict=True)]
    over = [_power(u, p) for u, p in zip(("N m", "rad", "s"), powers, strict=True) if p > 0]
    under = [_power(u, -p) for u, p in zip(("N m", "rad", "s"), powers, strict=True) if p < 0]
    if not under:
        return " ".join(over) or "1"
    below = " ".join(under)
    return f"{' '.join(over) or '1'}/{f'({below})' if ' ' in below else below}"


def _power(name: str, power: int) -> str:
    if power == 1:
        return name
    return f"{name.replace(' ', '')}{power}"


def typical(feature: str) -> float:
    """Coefficient that makes the feature's usual torque 0.05 N m."""
    return 0.05 / float(np.prod([factor(name).typical for name in FEATURES[feature]]))


class LearnedLaw(Term):
    """A sum of features, each times a coefficient, added to what reaches the link."""

    effect = "learned_law"
    quantities = tuple(
        Quantity(name, unit(name), typical(name), MOST * typical(name), signed=True)
        for name in FEATURES
    )
    source = "regression of a diagnosis"
    state = ("_error", "_torque", "_age", "_target")

    def prepare(self) -> None:
        """See Term."""
        self._features = [name for name in FEATURES if self.values[name].any()]
        self._error = np.zeros_like(self.scene.inertia)
        self._torque = np.zeros_like(self.scene.inertia)
        self._age = np.full_like(self.scene.inertia, OLDEST)
        self._target = np.full_like(self.scene.inertia, np.nan)

    def renew(self, rows: NDArray[np.int64], other: Self) -> None:
        """See Term."""
        super().renew(rows, other)
        known = {*self._features, *other._features}
        self._features = [name for name in FEATURES if name in known]

    def command(self, now: Array, before: Array, share: Array) -> tuple[Array, Array]:
        """See Term: only the commands' age is taken note of."""
        n = len(now)
        begin(self._target[:n], now)
        self._age[:n] += self.scene.timestep
        np.copyto(self._age[:n], 0.0, where=now != self._target[:n])
        self._target[:n] = now
        return now, before

    def settle(self, outcome: Outcome) -> None:
        """See Term."""
        n = len(outcome.error)
        self._error[:n], self._torque[:n] = outcome.error, outcome.torque

    def flow(self, flow: Flow) -> None:
        """See Term."""
        n, velocity = len(flow.torque), flow.velocity
        error, torque, age = self._error[:n], self._torque[:n], self._age[:n]
        seen = Seen(flow.position, velocity, error, torque, flow.time, age)
        for name in self._features:
            told = self.values[name][:n] * value(name, seen)
            if any(part in BRAKES for part in FEATURES[name]):
                moving = np.where(np.abs(velocity) > 1e-6, velocity, 1e-6)
                brake = np.maximum(-told / moving, 0.0)
                flow.damping += brake
                told = told + brake * velocity
            flow.torque += told
