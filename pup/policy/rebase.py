"""A policy's weights for other bounds than those it was trained on."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pup.policy.bundle import PolicyCard, Weights
from pup.policy.scale import UnitScale
from pup.policy.shape import PolicyShape

Array = NDArray[np.float64]


def for_bounds(card: PolicyCard, weights: Weights, lower: Array, upper: Array) -> Weights:
    """Weights that make of mu under other bounds what they made of it under their own.

    Networks see mu on the unit scale of the bounds, centred: the same mu is another number under
    other bounds. What turns the one into the other is a factor and a shift for each parameter; the
    first layers that see mu take them in. Under the same bounds all weights stay the same bits.

    Args:
      card: of the policy.
      weights: of it, by the names of ProjectedPolicy.
      lower: other bounds of `card.parameters`, physical, shape (n_parameters,).
      upper: upper ones.
    """
    old, new = card.scale, UnitScale(lower, upper)
    factor = new.width / old.width
    shift = (2 * (new.lower - old.lower) + (new.width - old.width)) / old.width
    told = dict(weights)
    for layer, first in _seeing(card.shape).items():
        if f"{layer}.weight" in told:
            told |= _moved(told, layer, first, factor, shift)
    return told


def _seeing(shape: PolicyShape) -> dict[str, int]:
    """The layers that see mu, and the column of each at which it begins."""
    seeing = {"critic.0": shape.proprioception} if shape.privileged else {}
    if shape.latent:
        return seeing | {"projection.0": 0}
    return seeing | ({"actor.0": shape.proprioception} if shape.parameters else {})


def _moved(
    weights: Weights, layer: str, first: int, factor: Array, shift: Array
) -> dict[str, NDArray[Any]]:
    weight, bias = weights[f"{layer}.weight"], weights[f"{layer}.bias"]
    exact = np.array(weight, dtype=np.float64)
    seen = exact[:, first:].copy()
    exact[:, first:] *= factor
    return {
        f"{layer}.weight": exact.astype(weight.dtype),
        f"{layer}.bias": (bias + seen @ shift).astype(bias.dtype),
    }
