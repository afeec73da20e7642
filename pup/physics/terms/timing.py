"""When commands arrive and by which clock."""

import numpy as np
from numpy.typing import NDArray

from pup.physics.terms.base import Parts, Quantity, Term

Array = NDArray[np.float64]


class CommandDelay(Term):
    """Commands reach the servo later than their rows say."""

    effect = "command_delay"
    constant = True
    kinds = ("joint", "group", "bus")
    quantities = (Quantity("time", "s", 0.012, 0.08),)
    source = "9.5 ms (PACE, issue 19), 5 to 20 ms (unitree_sim_isaaclab, issue 108)"

    def parts(self) -> Parts:
        """See Term."""
        return (self.values["time"],)

    def lateness(self, time: float | Array, n: int) -> Array:
        """See Term."""
        return self.values["time"][:n]


class ClockSkew(Term):
    """Positions are stamped by another clock than commands; it goes slow by this share."""

    effect = "clock_skew"
    constant = True
    kinds = ("robot",)
    layout = "one"
    quantities = (Quantity("share", "1", 0.002, 0.02, signed=True),)
    source = "estimate: 0.1 to 0.5 %"

    def parts(self) -> Parts:
        """See Term."""
        return (self.values["share"],)

    def lateness(self, time: float | Array, n: int) -> Array:
        """See Term."""
        return -time * self.values["share"][:n]

    def pace(self) -> Array:
        """See Term."""
        return 1 + self.values["share"]
