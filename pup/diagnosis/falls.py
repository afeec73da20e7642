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
    tilts = [t for n in ("imu/roll", "imu/pitch") if (t := recording.extras.get(n)) is not None]
    if recording.support != "ground" or not tilts:
        return recording
    angles = np.nan_to_num(np.stack(tilts))
    lean = np.abs(np.arctan2(np.sin(angles), np.cos(angles))).max(axis=0)  # turns aside
    fallen = np.flatnonzero(lean > DOWN)
    upright = np.flatnonzero(lean[: fallen[0]] < TOPPLES) if len(fallen) else fallen
    if not len(upright):
        return recording
    topples = min(int(upright[-1]) + 1, len(lean) - 1)
    return beginning(recording, float(recording.time[topples] - recording.time[0]))
