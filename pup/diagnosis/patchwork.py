"""A model that is a patchwork: many names, hardly one believed, and motions left out astray.

A cause that the library has not is imitated by several effects at once, each a little. Together
they follow the motions that they were fitted to so closely that nothing seems to be left.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.held_out import HeldOut
from pup.diagnosis.laws import NAMELESS
from pup.diagnosis.models import Model
from pup.diagnosis.regimes import Regime, strongest, windows
from pup.diagnosis.residuals import Noise
from pup.diagnosis.verdict import Finding, Parameter
from pup.physics.terms import Place

Array = NDArray[np.float64]

PATCHES = 3
"""Names that are less likely there than not: so many are patches for something else."""
ASTRAY = 1.5
"""Root mean square error on motions left out, in that of the noise, that says so."""
CHANCE = 0.6
"""Probability that it is something without a name: of 17 such in the sealed sets until 29 November
2026 ten (docs/results/diagnosis.md)."""


def patched(
    named: Sequence[Finding],
    nameless: Finding | None,
    shown: HeldOut,
    model: Model,
    noise: Noise,
    found: Sequence[Regime],
) -> Finding | None:
    """What has no name, as likely as it is by what has.

    Args:
      named: the findings that have a name.
      nameless: what is known to have none.
      shown: errors on motions left out.
      model: the model with these findings, with what it predicts of motions left out.
      noise: of the channels.
      found: the regimes of motion.
    """
    joints = len(model.measured.robot.joints)
    astray = shown.after / float(np.sqrt(np.mean(noise.sigma[:joints] ** 2)))
    if sum(not finding.believed for finding in named) < PATCHES or astray < ASTRAY:
        return nameless
    if nameless is not None:
        return replace(nameless, probability=max(nameless.probability, CHANCE))
    errors = (model.measured.values - model.predicted) ** 2
    return Finding(
        effect=NAMELESS,
        place=Place("joint", model.measured.robot.joint_names[_worst(model, errors, noise)]),
        regime=strongest(found, errors),
        when=tuple(windows(model.measured, errors)),
        parameters={"astray": Parameter(astray, "1", astray, astray)},
        probability=CHANCE,
        equivalents=(),
        absorbed_by={},
        law=None,
    )


def _worst(model: Model, errors: Array, noise: Noise) -> int:
    """The joint that is furthest astray, by its noise."""
    channel, joints = model.measured.channel, len(model.measured.robot.joints)
    sums, counts = (np.bincount(channel, w, minlength=joints)[:joints] for w in (errors, None))
    return int(np.argmax(sums / counts.clip(1) / noise.sigma[:joints] ** 2))
