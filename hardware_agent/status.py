"""What the control loop tells other threads: its status, and what it does not do."""

from dataclasses import dataclass

from hardware_agent.metronome import Timing
from hardware_agent.senses import Senses
from pup.wire import AgentState

LONGEST = 300
"""Characters of a reason."""


@dataclass(frozen=True)
class MotionStatus:
    """What the loop tells of itself; published as a whole.

    Attributes:
      state: of the robot.
      reason: why it is stopped or at fault; empty otherwise.
      tick: when this was, s of CLOCK_MONOTONIC.
      bus: whether the bus works.
      senses: of the latest tick.
      timing: of the loop.
      repeated: questions to servos that had to be repeated, so far.
      lost: answers that did not come in spite of it.
      limited: what held the latest target back, by joint.
      heat: of the hottest winding (I²t), as a share of what is allowed.
      doubted: joints whose servos have long not told that their torque is off, though it should be.
      limp: whether every servo has told that its torque is off since it was to be.
    """

    state: AgentState
    reason: str
    tick: float
    bus: bool
    senses: Senses | None
    timing: Timing
    repeated: int
    lost: int
    limited: dict[str, str]
    heat: float
    doubted: tuple[str, ...] = ()
    limp: bool = False


def brief(text: str) -> str:
    """A text that fits into every message and journal: one line, not too long, sound Unicode."""
    sound = text.encode("utf-8", "replace").decode("utf-8")
    told = " ".join("".join(c if c.isprintable() else " " for c in sound).split())
    return told if len(told) <= LONGEST else f"{told[: LONGEST - 1]}…"


@dataclass(frozen=True)
class Refused:
    """A request that the robot's state does not allow.

    Attributes:
      reason: in words.
    """

    reason: str
