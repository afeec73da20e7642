"""Where a robot falls over: what follows tells nothing of the model.

A robot that topples leaves the path of its twin exponentially, and where it lands a hair of a
difference decides how it comes to lie. A fit to that has an end wherever it looks.
"""

import numpy as np

from pup.recording import Recording
from pup.recording_cuts import beginning

DOWN = 1.0
"""A torso that leans by more has fallen, rad."""
TOPPLES = 0.5
"""Lean from which a robot that falls is past help, rad."""


def standing(recording: Recording) -> Recording:
    """A recording up to where the robot topples.

    All of it where it does not fall, has no tilts, or lies from the beginning.

    Args:
      recording: on the ground, or any other.
    """
    told = (recording.extras.get(name) for name in ("imu/roll", "imu/pitch"))
    tilts = [tilt for tilt in told if tilt is not None and not np.isnan(tilt).all()]
    if recording.support != "ground" or not tilts:
        return recording
    angles = np.stack(tilts)
    away = np.abs(np.arctan2(np.sin(angles), np.cos(angles)))  # turns aside
    lean = away.max(axis=0)  # NaN where one is not told, which is neither upright nor down
    fallen = np.flatnonzero(lean > DOWN)
    upright = np.flatnonzero(lean[: fallen[0]] < TOPPLES) if len(fallen) else fallen
    if not len(upright):
        return recording
    leaning = np.flatnonzero(lean >= TOPPLES)
    topples = int(leaning[leaning > upright[-1]][0])
    return beginning(recording, float(recording.time[topples] - recording.time[0]))
