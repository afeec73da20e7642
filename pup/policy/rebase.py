"""A policy's weights for other bounds than those it was trained on."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pup.policy.bundle import PolicyCard, Weights
from pup.policy.scale import UnitScale
from pup.policy.shape import PolicyShape

Array = NDArray[np.float64]

CRITIC = "critic.0"


def for_bounds(
    card: PolicyCard,
    weights: Weights,
    names: Sequence[str],
    lower: Array,
    upper: Array,
    course: int,
) -> Weights:
    """Weights that make of mu under other bounds what they made of it under their own.

    Networks see mu on the unit scale of the bounds, centred: the same mu is another number under
    other bounds. What turns the one into the other is a factor and a shift for each parameter; the
    first layers that see mu take them in. A parameter that the policy does not know changes nothing
    at first, and of one that is no longer there it sees the middle. A value function that saw no
    course sees one that changes nothing at first. Under the same bounds all other weights stay the
    same bits.

    Args:
      card: of the policy.
      weights: of it, by the names of ProjectedPolicy.
      names: of the parameters that it shall see.
      lower: their bounds, physical, shape (n_parameters,).
      upper: upper ones.
      course: entries of the course that its value function shall see.
    """
    known = [i for i, name in enumerate(card.parameters) if name in names]
    place = [names.index(card.parameters[i]) for i in known]
    old, new = card.scale, UnitScale(lower, upper)
    width = old.width[known]
    factor = new.width[place] / width
    shift = (2 * (new.lower[place] - old.lower[known]) + (new.width[place] - width)) / width
    told = dict(weights)
    for layer, first in _seeing(card.shape, len(card.parameters)).items():
        if f"{layer}.weight" in told:
            weight, bias = told[f"{layer}.weight"], told[f"{layer}.bias"]
            seen = np.array(weight[:, first:], dtype=np.float64)[:, known]
            sees = np.zeros((len(weight), len(names)))
            sees[:, place] = seen * factor
            parts = [weight[:, :first], sees.astype(weight.dtype)]
            if layer == CRITIC and first == card.shape.proprioception:  # it saw no course
                parts.insert(1, np.zeros((len(weight), course), weight.dtype))
            told[f"{layer}.weight"] = np.hstack(parts)
            told[f"{layer}.bias"] = (bias + seen @ shift).astype(bias.dtype)
    return told


def _seeing(shape: PolicyShape, parameters: int) -> dict[str, int]:
    """The layers that see mu, and the column of each at which it begins."""
    seeing = {CRITIC: shape.proprioception + shape.privileged - parameters}
    if shape.latent:
        return seeing | {"projection.0": 0}
    return seeing | ({"actor.0": shape.proprioception} if shape.parameters else {})
