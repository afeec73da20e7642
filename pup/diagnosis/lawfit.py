"""Laws for a torque that nothing known explains: sparse regression on what the servo sees and does.

The torque itself is not measured, but how the samples answer to it is known. So features are passed
through those answers and compared with the errors themselves, whose noise is known: a torque that
was estimated first would have smoothed away what tells one feature from another.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.coordinates import Coordinate
from pup.diagnosis.evidence import Projector
from pup.diagnosis.fit import Fit
from pup.diagnosis.impulses import Responses
from pup.diagnosis.replays import Replays
from pup.diagnosis.signals import Servo, servos, signals
from pup.physics.terms import Place, column
from pup.physics.terms.learned import FEATURES, MOST, LearnedLaw, Seen, typical, unit, value

Array = NDArray[np.float64]

LONGEST = 3
"""Features of a law, at most."""
LAWS = 3
"""Laws that are told."""
LASTING = 4.0
"""Recordings that are all shorter, s, tell no law of time: it would grow beyond what was seen."""
VISIBLE = 0.05
"""A feature of which less than this share is left beside the parameters says nothing new."""
ALIKE = 0.98
"""Features whose traces overlap by more stand for one another."""


@dataclass(frozen=True)
class Law:
    """A sum of features.

    Attributes:
      features: their names.
      coefficients: N m per unit of each feature.
      gain: drop of chi-squared that it promises, less what its length costs.
      price: what one feature costs.
      traces: whitened changes of the samples by each feature at its typical size, shape
        (n_samples, n_features).
    """

    features: tuple[str, ...]
    coefficients: tuple[float, ...]
    gain: float
    price: float
    traces: Array = field(compare=False, repr=False)

    def __str__(self) -> str:
        parts = [
            f"{c:+.3g} {'' if unit(f) == '1' else unit(f) + ' '}{f}"
            for f, c in zip(self.features, self.coefficients, strict=True)
        ]
        return "tau += " + " ".join(parts).removeprefix("+")

    def columns(self, place: Place) -> tuple[str, ...]:
        """Its columns at a place."""
        return tuple(column(LearnedLaw.effect, name, place) for name in self.features)

    def started(self, fit: Fit, place: Place) -> Fit:
        """A rough fit of a model with the law: the traces are columns of its Jacobian."""
        assert fit.jacobian is not None
        sizes = [typical(name) for name in self.features]
        names = self.columns(place)
        free = tuple(Coordinate(n, s, -MOST, MOST) for n, s in zip(names, sizes, strict=True))
        return Fit(
            fit.coordinates + free,
            np.r_[fit.at, np.array(self.coefficients) / np.array(sizes)],
            fixed=dict(fit.fixed),
            jacobian=np.hstack([fit.jacobian, self.traces]),
            age=1,
            thorough=False,
        )


def laws(
    answers: Responses, fit: Fit, replays: Replays, simulated: Array, joints: Sequence[int]
) -> list[Law]:
    """Laws that explain a fit's errors: the best, best first, then those of one feature.

    Args:
      answers: of the samples to torques.
      fit: the model, with its Jacobian.
      replays: gives the nominal space.
      simulated: the model's samples, shape (n_samples,), rad.
      joints: the joints that the law acts on, all alike.
    """
    assert fit.jacobian is not None and fit.residual is not None
    traces = _traces(answers, simulated, servos(replays, fit.values), joints)
    left = Projector(fit.jacobian)(traces)
    lengths = np.linalg.norm(left, axis=0)
    lasting = max(r.time[-1] - r.time[0] for r in answers.measured.recordings) > LASTING
    names = [
        n
        for n, a, b in zip(FEATURES, lengths, _lengths(traces), strict=True)
        if a > VISIBLE * b and (lasting or "t" not in FEATURES[n])
    ]
    shown = np.array([list(FEATURES).index(n) for n in names])
    if not len(shown):
        return []
    units = left[:, shown] / lengths[shown]
    sizes = np.array([typical(n) for n in names]) / lengths[shown]
    price = float(np.log(len(fit.residual)) + 2 * np.log(len(names)))
    match = units.T @ fit.residual
    gram = units.T @ units
    found: dict[frozenset[str], Law] = {}
    for first in _beginnings(match, gram):
        grown = _grown(first, match, gram, price)
        for count in range(1, len(grown) + 1):
            chosen = grown[:count]
            weights = np.linalg.solve(gram[np.ix_(chosen, chosen)], match[chosen])
            gain = float(weights @ match[chosen]) - price * count
            if gain > 0:
                coefficients = tuple(float(w) for w in weights * sizes[chosen])
                told = tuple(names[i] for i in chosen)
                law = Law(told, coefficients, gain, price, traces[:, shown[chosen]])
                found.setdefault(frozenset(law.features), law)
    ranked = sorted(found.values(), key=lambda law: -law.gain)
    simple = [law for law in ranked if len(law.features) == 1]
    return list(dict.fromkeys(ranked[:LAWS] + simple[:LAWS]))


def _lengths(columns: Array) -> Array:
    return np.asarray(np.maximum(np.linalg.norm(columns, axis=0), 1e-12))


def _beginnings(match: Array, gram: Array) -> list[int]:
    """Features to begin with: the best, and the best of those unlike them."""
    chosen: list[int] = []
    for i in np.argsort(-np.abs(match)):
        if all(abs(gram[i, j]) < ALIKE for j in chosen):
            chosen.append(int(i))
        if len(chosen) == 2 * LAWS:
            break
    return chosen


def _grown(first: int, match: Array, gram: Array, price: float) -> list[int]:
    """Forward selection from a first feature, as long as each next one is worth its price."""
    chosen = [first]
    while len(chosen) < LONGEST:
        inside = gram[np.ix_(chosen, chosen)] + 1e-9 * np.eye(len(chosen))
        across = np.linalg.solve(inside, gram[chosen])
        left = 1 - np.einsum("ij,ij->j", gram[chosen], across)
        score = match - across.T @ match[chosen]
        gains = np.where(left > VISIBLE**2, score**2 / np.maximum(left, 1e-9), 0.0)
        best = int(np.argmax(gains))
        if gains[best] < price:
            break
        chosen.append(best)
    return chosen


def _traces(
    answers: Responses, simulated: Array, laws_of: Sequence[Servo], joints: Sequence[int]
) -> Array:
    """What each feature, at its typical size, changes in the samples, whitened."""
    measured = answers.measured
    out = np.zeros((len(measured.values), len(FEATURES)))
    for part in answers.parts:
        time = answers.knots(part.recording)
        for place, joint in enumerate(part.channels):
            if joint not in joints:
                continue
            law = laws_of[joint]
            told = signals(measured, simulated, law, part.recording, joint, time)
            if told is None:
                continue
            seen = Seen(told.position, told.velocity, told.error, told.torque, time, told.age)
            torque = np.stack([typical(name) * value(name, seen) for name in FEATURES], axis=1)
            out[part.samples] += part.matrix[:, place :: len(part.channels)] @ torque
    return out
