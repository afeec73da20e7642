"""Whether a robot's sub-steps are short enough for what its recordings in contact show.

A simulation in sub-steps that are too long is off by itself, most of all in contact and where light
rotors are damped strongly. A fit cannot make up for that: it looks like physics that is missing.
Without contact it is off by less than what matters, but for the fastest motions.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.nominal import Nominal
from pup.diagnosis.replays import Replays
from pup.diagnosis.residuals import Measured
from pup.robot import RobotDescription

Array = NDArray[np.float64]

SHORTEST = 0.001
"""Sub-steps are not made shorter than this, s: each halving costs as much again as all before."""
SEEN = 0.09
"""Mean square of what shorter sub-steps change in a channel, in that of its noise, that matters."""
ELSEWHERE = 100.0
"""The same of a recording that they lead elsewhere: it falls or swings, and tells nothing."""


def shorter_stepped(
    nominal: Nominal, replays: Replays, replays_of: Callable[[Measured], Replays]
) -> RobotDescription | None:
    """The robot in sub-steps of half the length, where its own are too long in contact; else None.

    Args:
      nominal: the nominal fit.
      replays: simulates with the robot's own.
      replays_of: what simulates other samples.
    """
    measured, robot = replays.measured, replays.measured.robot
    if robot.timestep / 2 < SHORTEST or not measured.grounded.any():
        return None
    finer = replace(robot, timestep=robot.timestep / 2)
    row = nominal.fit.row()
    change = replays_of(replace(measured, robot=finer))([row])[0] - replays([row])[0]
    squares = (change / measured.deviation(nominal.noise)) ** 2
    runs = measured.recording * measured.channels + measured.channel
    alike = measured.grounded & (_means(squares, runs) < ELSEWHERE)[runs]
    told = _means(squares[alike], measured.channel[alike])
    return finer if told.max(initial=0.0) > SEEN else None


def _means(values: Array, of: NDArray[np.int64]) -> Array:
    """The means of values by the number of what each is of."""
    return np.asarray(np.bincount(of, values) / np.maximum(np.bincount(of), 1))
