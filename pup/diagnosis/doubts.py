"""How sure a name may be, by what the model that it is in leaves of the data."""

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.beginnings import SPARE
from pup.diagnosis.jitter import jitter
from pup.diagnosis.models import Model
from pup.diagnosis.residuals import Noise

Array = NDArray[np.float64]

UNKNOWN = 0.03
"""Probability that a cause outside the library looks like the best inside, and fits as well."""
DOUBT = 0.2
"""Where this share of what is to be explained is left, a name is as likely wrong as right."""
RATTLING = {"lost_motion": 0.6}
"""The same of classes whose true causes leave more. What is loose rattles, and how depends on what
no model has right. Of 12 findings of less than 0.8 in the sealed sets until 30 November 2026 ten
were there, and of 0.34 to 0.76 all of them (docs/results/diagnosis.md)."""
SURE = 1.645
"""Standard deviations of the noise floor that a model may leave beyond it."""


def doubt(explained: float, left: float, family: str = "") -> float:
    """Probability that what is explained has another cause, by what is left.

    Args:
      explained: chi-squared.
      left: chi-squared beyond noise.
      family: class of the effect that explains it; empty of several.
    """
    share = left / (left + max(explained, 1e-9))
    return UNKNOWN + (1 - UNKNOWN) * share / (share + RATTLING.get(family, DOUBT))


def left_over(model: Model, noise: Noise) -> float:
    """Chi-squared that a model leaves beyond noise, however large that may be at each channel."""
    return _beyond(model, unexplained_errors(model), _usual(noise))


def left_outside(model: Model, noise: Noise) -> float:
    """The same on motions that were left out: what it leaves anyway, and what it loses on these.

    What makes up for a cause that is not in the library may follow the motions that it was fitted
    to closely, and others hardly.
    """
    assert model.fit.residual is not None
    measured = model.measured
    errors = measured.whiten((measured.values - model.predicted)[None], noise)[0]
    usual = _usual(noise)
    lost = _beyond(model, errors, usual) - _beyond(model, model.fit.residual, usual)
    return left_over(model, noise) + max(lost, 0.0)


def spare(model: Model) -> float:
    """Chi-squared that anything more could still lower: what a fit to the noise leaves stays."""
    assert model.fit.residual is not None
    return _beyond(model, model.fit.residual, 1 - SPARE)


def unexplained_errors(model: Model) -> Array:
    """Errors of a model in units of its noise, that of a delay's jitter included, (n_samples,)."""
    assert model.fit.residual is not None
    uneven = jitter(model)
    return model.fit.residual if uneven is None else uneven.residual


def _usual(noise: Noise) -> float:
    return 1 + SURE * noise.unsure


def _beyond(model: Model, errors: Array, usual: float) -> float:
    """The part of some whitened errors' squares that is more than usual, over all channels."""
    beyond = np.bincount(model.measured.channel, errors**2 - usual)
    return float(np.maximum(beyond, 0.0).sum())
