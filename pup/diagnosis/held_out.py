"""Errors on motions that were left out of the fits, before and after."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.folds import apart
from pup.diagnosis.models import Model
from pup.diagnosis.residuals import TILTS, Measured

EVEN = 1.001
"""By so much joints' errors may rise where only the torso is predicted better."""


@dataclass(frozen=True)
class HeldOut:
    """Errors on motions that were left out of the fits, before and after.

    Attributes:
      recordings: their ids.
      before: root mean square error of the nominal model, rad.
      after: that of the corrected one, rad.
      interval: 90 % interval of the relative improvement, over motions.
      per_joint: (before, after) by joint, rad.
      per_motion: (before, after) by type of motion, rad.
      per_tilt: (before, after) of the torso's roll and pitch, on the ground, rad; not in the rest.
    """

    recordings: tuple[str, ...]
    before: float
    after: float
    interval: tuple[float, float]
    per_joint: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    per_motion: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    per_tilt: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def better(self) -> bool:
        """Whether the corrected model predicts the joints better, or as well and the torso so.

        Of all motions together or of most of their types: what only one of them shows is guessed
        where it is left out, and that error may be larger than all others.
        """
        if 2 * sum(now < then for then, now in self.per_motion.values()) > len(self.per_motion):
            return True
        before, after = (
            float(np.square([pair[which] for pair in self.per_tilt.values()]).sum())
            for which in (0, 1)
        )
        return self.after < self.before or (self.after <= EVEN * self.before and after < before)


def held_out(measured: Measured, before: Model, after: Model, seed: int) -> HeldOut:
    """Errors of the joints on motions left out, with an interval over motions."""
    joints = measured.channel < len(measured.robot.joints)
    squares = [(measured.values - m.predicted) ** 2 for m in (before, after)]
    numbers = np.unique(measured.recording[joints])
    parts = [part for members in apart(measured) if (part := joints & measured.only(members)).any()]
    sums = np.array([[s[part].sum() for part in parts] for s in squares])
    rng = np.random.default_rng(seed)
    draws = rng.integers(len(parts), size=(2000, len(parts)))
    drawn = sums[:, draws].sum(axis=2)
    improvement = 1 - np.sqrt(drawn[1] / np.maximum(drawn[0], 1e-300))

    def both(chosen: NDArray[np.bool_]) -> tuple[float, float]:
        first, second = (float(np.sqrt(np.mean(s[chosen]))) for s in squares)
        return first, second

    def of(names: Sequence[str], first: int) -> dict[str, tuple[float, float]]:
        own = {name: measured.channel == i for i, name in enumerate(names, start=first)}
        return {name: both(here) for name, here in own.items() if here.any()}

    per_motion = {
        motion: both(joints & measured.only(members))
        for motion, members in measured.motions().items()
        if (joints & measured.only(members)).any()
    }
    low, high = np.quantile(improvement, (0.05, 0.95))
    return HeldOut(
        tuple(measured.recordings[n].id for n in numbers),
        *both(joints),
        (float(low), float(high)),
        of(measured.robot.joint_names, 0),
        per_motion,
        of(TILTS, len(measured.robot.joints)),
    )
