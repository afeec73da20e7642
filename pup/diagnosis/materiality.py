"""Whether what was found matters: `none` means that nothing material is missing.

Every robot has a little of everything. What is there by its traces, but small as such things go
and of no use in predicting motions, is left out of a simulator for good reason.
"""

from pup.diagnosis.residuals import Noise
from pup.diagnosis.selection import Model
from pup.diagnosis.verdict import HeldOut
from pup.robot import RobotDescription

SMALL = 0.1
"""Share of its typical size below which an effect is small."""
GAIN = 0.3
"""Share of a joint's noise by which its error on motions left out falls where that matters."""


def matters(model: Model, shown: HeldOut, noise: Noise) -> bool:
    """Whether a model with effects is worth having instead of the nominal one.

    Args:
      model: the nominal model with what was found.
      shown: errors of both on motions left out.
      noise: of the joints' readings.
    """
    if shown.after >= shown.before:
        return False
    return largest(model) >= SMALL or improves(shown, noise, model.measured.robot)


def largest(model: Model) -> float:
    """Size of the effect that is largest, next to what is typical of its kind."""
    at = dict(zip(model.fit.names, model.fit.at, strict=True))
    return max((abs(at[n]) for h in model.hypotheses for n in h.magnitudes), default=0.0)


def improves(shown: HeldOut, noise: Noise, robot: RobotDescription) -> bool:
    """Whether some joint's motions are predicted better by a share of its noise."""
    return any(
        before - after > GAIN * noise.sigma[robot.joint_names.index(name)]
        for name, (before, after) in shown.per_joint.items()
    )
