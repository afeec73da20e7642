"""What a tick of the control loop knows, and what it says when a rule is broken."""

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from hardware_agent.imu import Orientation

Array = NDArray[np.float64]


class Response(Enum):
    """How the robot is made safe.

    Attributes:
      LIMP: torque off.
      SOFT: it keeps its pose with a small share of its power: who falls should neither break a gear
        nor be thrown about.
    """

    LIMP = "limp"
    SOFT = "soft"


@dataclass(frozen=True)
class Trip:
    """A rule that was broken.

    Attributes:
      rule: its name.
      reason: in words.
      response: see Response.
    """

    rule: str
    reason: str
    response: Response = Response.LIMP

    def __str__(self) -> str:
        return f"{self.rule}: {self.reason}"


@dataclass(frozen=True, eq=False)
class Senses:
    """What a tick knows; arrays in the order of the joints, NaN where nothing is known.

    Attributes:
      time: of the loop, s.
      names: of the joints.
      position: rad.
      velocity: rad/s.
      load: of full scale.
      voltage: V.
      temperature: °C.
      alarms: of the servos, in words, by joint.
      seen: when each servo answered last, s.
      imu: its latest sample.
      imu_seen: when that came, s.
      has_imu: whether there is an IMU at all.
      goal: written last, rad.
      written: when, s.
      walking: whether a rollout is under way.
      alone: whether it is on its own feet: nobody lifts it or puts it down.
    """

    time: float
    names: tuple[str, ...]
    position: Array
    velocity: Array
    load: Array
    voltage: Array
    temperature: Array
    alarms: dict[str, str]
    seen: Array
    imu: Orientation | None
    imu_seen: float
    has_imu: bool
    goal: Array
    written: float
    walking: bool
    alone: bool

    @property
    def supply(self) -> float:
        """Voltage at the servos: the median of what they tell, so that none of them can lie."""
        known = self.voltage[~np.isnan(self.voltage)]
        return float(np.median(known)) if len(known) else math.nan
