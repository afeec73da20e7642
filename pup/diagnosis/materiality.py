"""Whether what was found matters: `none` means that nothing material is missing.

Every robot has a little of everything. What is there by its traces, but small as such things go
and of no use in predicting motions, is left out of a simulator for good reason. So is what hardly
shows: an encoder's offset of any size, where the motions would be the same without.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.held_out import HeldOut
from pup.diagnosis.models import Model
from pup.diagnosis.residuals import TILTS, Noise
from pup.diagnosis.verdict import SLIGHT

Array = NDArray[np.float64]

GAIN, FORESEEN = 0.3, 0.6
"""Shares of a joint's or a tilt's noise by which its error falls, on what was fitted and on motions
left out, where that matters whatever the size is. A nominal fit that makes up for something small
on all motions may be led far astray by some of them, so that more is asked of the others."""
SHOWN, FORETOLD, TRACE = 0.05, 0.1, 0.02
"""The same that an effect of any size shows: on what was fitted, or else on motions left out, of
which a nominal fit to all may hide much; and what those have to gain at least."""

ASTRAY, NOISY = 0.2, 3.0
"""Share of its swing, and times its noise, that a joint's error on motions left out may be where
nothing is missing. A servo that swings by itself does not repeat: its noise alone excuses all."""


def matters(nominal: Model, model: Model, shown: HeldOut, noise: Noise) -> bool:
    """Whether a model with effects is worth having instead of the nominal one.

    Args:
      nominal: the nominal model.
      model: the same with what was found.
      shown: errors of both on motions left out.
      noise: of the joints' readings.
    """
    explained = _explained(nominal, model)
    if improves(model, shown, noise) or explained > GAIN:
        return True
    foretold = max(_gains(model, shown, noise)) if shown.better else 0.0
    shows = explained > SHOWN or foretold > FORETOLD
    return foretold > TRACE and shows and _largest(model) >= SLIGHT


def improves(model: Model, shown: HeldOut, noise: Noise) -> bool:
    """Whether motions of some joint or of the torso are foretold better by much, left out."""
    return max(_gains(model, shown, noise)) > FORESEEN


def astray(model: Model, shown: HeldOut, noise: Noise) -> str:
    """Joints whose motions left out a fit does not foretell, in words; empty where it does.

    What swings by itself may be followed where it was fitted, and nowhere else.
    """
    measured = model.measured
    far = []
    for name, (_, after) in shown.per_joint.items():
        joint = measured.robot.joint_names.index(name)
        sigma = float(noise.sigma[joint])
        swing = max(float(measured.values[measured.channel == joint].std()), sigma)
        if after > max(ASTRAY * swing, NOISY * sigma):
            far.append(f"{name} is off by {after / swing:.0%} of its swing")
    return ", ".join(far)


def little(model: Model, shown: HeldOut) -> str:
    """What was found and does not matter, in words; empty where nothing was."""
    if not model.hypotheses:
        return ""
    found = ", ".join(f"{h.effect} at {h.place}" for h in model.hypotheses)
    why = "hardly changes what is predicted of motions left out"
    if shown.better:
        why = (
            f"is below {SLIGHT:g} of its typical size, or hardly shows, and lowers no "
            f"error by {GAIN:g} of its noise, nor by {FORESEEN:g} on motions left out"
        )
    return f"found, but not material: {found}, which {why}"


def _gains(model: Model, shown: HeldOut, noise: Noise) -> Iterator[float]:
    """By how much errors of joints and tilts on motions left out fall, in their noise."""
    measured = model.measured
    joints = measured.robot.joint_names
    variance = measured.deviation(noise) ** 2
    errors = {joints.index(name): pair for name, pair in shown.per_joint.items()}
    errors |= {len(joints) + TILTS.index(name): pair for name, pair in shown.per_tilt.items()}
    for channel, (before, after) in errors.items():
        own = measured.channel == channel
        yield (before - after) / float(np.sqrt(np.mean(variance[own])))


def _explained(nominal: Model, model: Model) -> float:
    """By how much some joint's error falls at most on what was fitted, in its noise."""
    channel = model.measured.channel
    readings = np.maximum(np.bincount(channel), 1)

    def error(one: Model) -> Array:
        assert one.fit.residual is not None
        return np.asarray(np.sqrt(np.bincount(channel, one.fit.residual**2) / readings))

    return float((error(nominal) - error(model)).max())


def _largest(model: Model) -> float:
    """Size of the effect that is largest, next to what is typical of its kind."""
    return max((model.size(h) for h in model.hypotheses), default=0.0)
