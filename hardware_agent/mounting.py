"""How a joint's servo is mounted: what its ticks say of the joint's angle, and the reverse."""

import math
from dataclasses import dataclass

TICK = 2 * math.pi / 4096  # rad
CENTRE = 2048  # ticks in the middle of a servo
LAST = 4095  # tick that a goal in joint mode may be


@dataclass(frozen=True)
class Mounting:
    """Of one joint; the attributes are keys of `[bus.joints.<joint>]`.

    Attributes:
      sign: 1 where the joint's angle grows with the servo's ticks, -1 where it shrinks.
      zero: ticks at which the joint's angle is 0.
    """

    sign: int = 1
    zero: int = CENTRE

    def angle(self, ticks: int) -> float:
        """The joint's angle, rad."""
        return self.sign * (ticks - self.zero) * TICK

    def ticks(self, angle: float) -> int:
        """The goal nearest to an angle in rad, as far as the servo reaches."""
        return min(LAST, max(0, self.zero + self.sign * round(angle / TICK)))

    @property
    def reach(self) -> tuple[float, float]:
        """Least and largest angle that the servo can be told, rad."""
        return self.span(0, LAST)

    def span(self, least: int, largest: int) -> tuple[float, float]:
        """Least and largest angle between two ticks, rad."""
        ends = sorted((self.angle(least), self.angle(largest)))
        return ends[0], ends[1]
