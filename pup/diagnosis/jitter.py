"""Commands or readings that come late by another time each: errors that no law explains.

A delay that changes from tick to tick leaves errors wherever a delay shows, and leaves others when
the motion is done again. They are noise that grows with the motion, not another missing effect.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from pup.diagnosis.lacks import repeated
from pup.diagnosis.models import Model
from pup.physics.terms import CLASS_OF, split_column

Array = NDArray[np.float64]

EVIDENCE = 10.0
"""Logarithm of odds from which a delay is believed to change."""
REPEATED = 3.0
"""Standard deviations from which errors do the same again, which jitter does not."""
LEAST, MOST = 1e-5, 0.1
"""Jitter that is looked for, s."""


@dataclass(frozen=True, eq=False)
class Jitter:
    """How much a delay changes from tick to tick.

    Attributes:
      spread: standard deviation that the errors ask for, s: that of single ticks or less, as those
        that follow each other make up for some of it.
      lower: end of its 90 % interval.
      upper: the other end.
      residual: the model's errors in units of all noise, the jitter's with it, (n_samples,).
    """

    spread: float
    lower: float
    upper: float
    residual: Array


def jitter(model: Model) -> Jitter | None:
    """The jitter of a model's delay; None without one, or where its errors repeat.

    Args:
      model: fitted, with its Jacobian and residual.
    """
    fit = model.fit
    assert fit.jacobian is not None and fit.residual is not None
    late = [i for i, name in enumerate(fit.names) if _is_delay(name)]
    if not late:
        return None
    shared = repeated(model.measured, fit.residual)
    if not shared or max(one.surprise for one in shared.values()) > REPEATED:
        return None
    slopes = np.array([fit.coordinates[i].slope(float(fit.at[i])) for i in late])
    answer = np.sum((fit.jacobian[:, late] / slopes) ** 2, axis=1)
    squares = fit.residual**2

    def cost(logarithm: float) -> float:
        variance = 1 + np.exp(2 * logarithm) * answer
        return float(np.sum(np.log(variance) + squares / variance)) / 2

    found = minimize_scalar(cost, bounds=(np.log(LEAST), np.log(MOST)), method="bounded")
    if float(squares.sum()) / 2 - found.fun < EVIDENCE:
        return None
    spread = float(np.exp(found.x))
    variance = 1 + spread**2 * answer
    reach = 1.645 / np.sqrt(2 * float(np.sum((1 - 1 / variance) ** 2)))
    return Jitter(
        spread,
        spread * float(np.exp(-reach)),
        spread * float(np.exp(reach)),
        fit.residual / np.sqrt(variance),
    )


def _is_delay(name: str) -> bool:
    told = split_column(name)
    return told is not None and CLASS_OF.get(told[0]) == "delay" and told[1] == "time"
