"""What a policy is conditioned on before any trial has told better."""

import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.physics.terms import split_column
from pup.policy.bundle import NumpyPolicy
from pup.sysid.result import FittedBounds


def fitted_eta(policy: NumpyPolicy, bounds: FittedBounds) -> NDArray[np.float64]:
    """The projection of the fitted parameters, shape (n_eta,).

    An effect that the fitted model has not is one of size zero. Parameters beyond the bounds that
    the policy was trained within are taken at the nearest end: no training has seen what the
    projection makes of others, and robots fell by it (docs/results/experiment.md).

    Raises:
      InputError: the policy knows parameters that the fitted model does not have.
    """
    card = policy.card
    told = {name: 0.0 for name in card.parameters if split_column(name) is not None}
    told |= dict(zip(bounds.space.names, map(float, bounds.space.nominal), strict=True))
    if unknown := [name for name in card.parameters if name not in told]:
        raise InputError(f"the policy is of a model with {unknown[0]!r}, which the fitted has not")
    mu = np.array([told[name] for name in card.parameters])
    known = np.clip(mu, card.parameter_lower, card.parameter_upper)
    return policy.project(card.scale.unit(known))
