"""By what an episode ends before its time."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pup.locomotion.simulations import Motion
from pup.physics.rotations import roll_pitch
from pup.robot import Gait

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Falls:
    """What counts as a fall, a flag per simulation.

    Attributes:
      broken: the simulation broke down.
      touching: the robot touches itself, or the floor with what may not.
      tilted: it leans too far.
      astray: it is off its line.
      off_height: it is off its height.
    """

    broken: Flags
    touching: Flags
    tilted: Flags
    astray: Flags
    off_height: Flags

    @classmethod
    def of(cls, motion: Motion, height: Array, aside: Array, gait: Gait) -> "Falls":
        """After a control step.

        Args:
          motion: what the step left.
          height: of the torso above its start, shape (n,), m.
          aside: way off the line, m; 0 where it does not matter.
          gait: says what is too far.
        """
        return cls(
            broken=motion.lost,
            touching=motion.touching,
            tilted=np.abs(roll_pitch(motion.root[:, 3:])).max(axis=1) > gait.tilt_limit,
            astray=aside > gait.drift_limit,
            off_height=np.abs(height) > gait.drift_limit,
        )

    def any(self) -> Flags:
        """Where an episode ends."""
        return np.asarray(self.broken | self.touching | self.tilted | self.astray | self.off_height)
