"""How much of what is wrong at a joint an effect explains, and whether that matters."""

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.fit import Fit
from pup.diagnosis.hypotheses import Hypothesis
from pup.diagnosis.residuals import Measured
from pup.physics.terms import Place
from pup.robot import RobotDescription

Array = NDArray[np.float64]

REST = 0.1
"""Share of what is more than noise at a joint that an effect explains. Many small effects make
up for what the library does not know, and for a wrong form of what was found; a true one explains
more. What explains little of what is left is doubted besides (`verdict.doubt`)."""
SHOWN = 0.1
"""Joints count that an effect gains this share of where it gains most."""
ALIKE = 0.03
"""The same share where the effect is known from another place: like servos do alike."""
MATERIAL = 0.3
"""An effect is material if it explains an error of this share of some joint's noise, ..."""
SIZABLE = 0.25
"""... or is of at least this share of its typical size."""


def explains(newest: Hypothesis, before: Fit, after: Fit, measured: Measured, known: bool) -> bool:
    """Whether an effect explains much of what is more than noise at one joint at least.

    Others of its group may have troubles of their own besides.

    Args:
      newest: the effect.
      before: the fit without it.
      after: the fit with it.
      measured: the samples.
      known: whether it has been found at another place.
    """
    own = _joints(newest.place, measured.robot)
    then, now = (_excess(fit, measured.channel, len(own))[own] for fit in (before, after))
    gain = then - now
    shown = gain >= SHOWN * gain.max()
    return bool((gain > (ALIKE if known else REST) * then)[shown].any())


def material(newest: Hypothesis, before: Fit, after: Fit, measured: Measured) -> bool:
    """Whether an effect matters: by its size, or by the error it explains of some joint.

    Args:
      newest: the effect.
      before: the fit without it.
      after: the fit with it.
      measured: the samples.
    """
    at = dict(zip(after.names, after.at, strict=True))
    if any(abs(at[name]) >= SIZABLE for name in newest.magnitudes):
        return True
    assert before.residual is not None and after.residual is not None
    channel = measured.channel
    explained = np.bincount(channel, before.residual**2 - after.residual**2)
    return bool((explained > MATERIAL**2 * np.bincount(channel)).any())


def _excess(fit: Fit, channel: NDArray[np.int64], channels: int) -> Array:
    """What of each channel's chi-squared is more than noise."""
    assert fit.residual is not None
    return np.asarray(np.bincount(channel, fit.residual**2 - 1, minlength=channels), dtype=float)


def _joints(place: Place, robot: RobotDescription) -> NDArray[np.bool_]:
    """The channels of the joints at a place; all channels where it is none of some joints."""
    chosen = np.zeros(len(robot.joints) + 2, dtype=bool)
    joints = place.joints(robot)
    chosen[joints if place.kind in ("joint", "group") else slice(None)] = True
    return chosen
