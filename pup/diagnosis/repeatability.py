"""What does not repeat: a motion done again that differs by more than its readings flutter.

Whatever differs between repeats is taken for noise, and physics of the library repeats itself. A
gear that sticks now and then, or a screw that is loose, would so pass for a noisy encoder. From one
reading to the next they are told apart: there an encoder is as noisy as ever.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.laws import NAMELESS
from pup.diagnosis.locate import BAND
from pup.diagnosis.noise import differences, flutter, quanta, spreads
from pup.diagnosis.regimes import Regime, strongest, windows
from pup.diagnosis.residuals import Measured, Noise
from pup.diagnosis.verdict import Finding, Parameter
from pup.physics.terms import Place

Array = NDArray[np.float64]

APART = 4.0
"""Repeats that differ by so many times what readings flutter by differ by more than noise. Noise
that remembers 0.85 of itself from tick to tick, the most that counts as such, makes 3 of it."""


def unrepeated(
    measured: Measured, errors: Array, noise: Noise, found: Sequence[Regime]
) -> Finding | None:
    """The joint whose repeats differ most, where that is more than its readings' noise.

    On the ground it is not asked for: impacts make motions differ everywhere. What the model
    foretells of it is no such thing: a loop that all but swings differs each time.

    Args:
      measured: the samples.
      errors: measured minus simulated by a model, shape (n_samples,), rad.
      noise: of the channels, by what differs between repeats.
      found: the regimes of motion.
    """
    if noise.source != "repeats" or any(r.support == "ground" for r in measured.recordings):
        return None
    differing = differences(measured, errors)
    left = noise.sigma.copy()
    for channel, told in spreads(differing).items():
        left[channel] = min(left[channel], told.sigma)
    apart = [_apart(measured, errors, float(left[i]), i) for i in range(len(measured.robot.joints))]
    joint = int(np.argmax(apart))
    if apart[joint] < APART:
        return None
    squares, readings = np.zeros(len(errors)), 0
    for difference in differing:
        if difference.channel == joint:
            squares[difference.samples] += difference.errors**2
            readings += len(difference.errors)
    spread, hidden = float(left[joint]), 1 - 1 / apart[joint] ** 2
    flutters = spread / apart[joint]
    reach = BAND / np.sqrt(2 * max(readings, 1))
    return Finding(
        effect=NAMELESS,
        place=Place("joint", measured.robot.joint_names[joint]),
        regime=strongest(found, squares),
        when=tuple(windows(measured, squares)),
        parameters={
            "spread": Parameter(spread, "rad", spread * (1 - reach), spread * (1 + reach)),
            "flutter": Parameter(flutters, "rad", flutters, flutters),
        },
        probability=hidden,
        equivalents=(),
        absorbed_by={},
        law=None,
        gain=hidden * float(np.sum(measured.channel == joint)),
    )


def _apart(measured: Measured, errors: Array, spread: float, channel: int) -> float:
    """What differs between repeats of a joint, in units of its flutter; 0 if unknown."""
    told = flutter(measured, errors, channel)
    if told is None:
        return 0.0
    least = float(quanta(measured)[channel] / np.sqrt(12))
    return spread / max(told, least, 1e-300)
