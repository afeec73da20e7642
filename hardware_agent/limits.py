"""What a target may be: within the joints' ranges and speeds, and a number at all."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hardware_agent.config import SafetySettings
from hardware_agent.senses import Trip

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Applied:
    """What became of a target.

    Attributes:
      goal: rad, within the limits.
      limited: by joint, what held it back: "range" or "speed".
    """

    goal: Array
    limited: dict[str, str]


class Limiter:
    """Keeps targets within the joints' ranges and speeds; what is no number, it refuses.

    Args:
      names: of the joints.
      lower: least angles, rad.
      upper: largest angles.
      limits: of the configuration.
    """

    def __init__(
        self, names: Sequence[str], lower: Array, upper: Array, limits: SafetySettings
    ) -> None:
        self._names = tuple(names)
        self._lower, self._upper = lower, upper
        self._speed = limits.speed

    def within(self, pose: Array) -> Array:
        """The pose within all ranges that is nearest to one."""
        return np.clip(pose, self._lower, self._upper)

    def apply(self, target: Array, last: Array, step: float) -> Applied | Trip:
        """A target as it may be sent.

        Args:
          target: wanted, rad.
          last: sent before.
          step: time since, s.

        Returns:
          What may be sent, or the trip of a target that is not finite: it is never mended, for
          whoever made it does not know what it does.
        """
        wrong = np.flatnonzero(~np.isfinite(target))
        if len(wrong) or target.shape != last.shape:
            names = ", ".join(self._names[j] for j in wrong[:3])
            return Trip("bad target", f"the target of {names or 'some joints'} is no number")
        # From beyond its range, where somebody may have turned it, a joint may come back slowly.
        lower, upper = np.minimum(self._lower, last), np.maximum(self._upper, last)
        ranged = np.clip(target, lower, upper)
        goal = np.clip(ranged, last - self._speed * step, last + self._speed * step)
        limited = {self._names[j]: "range" for j in np.flatnonzero(ranged != target)}
        limited |= {self._names[j]: "speed" for j in np.flatnonzero(goal != ranged)}
        return Applied(goal, limited)
