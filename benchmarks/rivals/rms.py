"""The rival that looks at residuals: a joint whose error is larger than its noise, and no name."""

import numpy as np

from benchmarks.rivals.case import Case, Named, Verdict
from pup.diagnosis.laws import NAMELESS
from pup.physics.terms import Place

SURPRISE = 3.0
"""Standard deviations of a mean square of noise."""


def rms(case: Case) -> Verdict:
    """Point at the joint with the largest error after the nominal fit, in units of its noise."""
    robot, measured = case.robot, case.measured
    errors = measured.values - case.replays([case.nominal.fit.row()])[0]
    scaled = errors / measured.deviation(case.noise)
    squares, limits = [], []
    for joint in range(len(robot.joints)):
        own = scaled[measured.channel == joint]
        squares.append(float(np.mean(own**2)) if len(own) else 0.0)
        limits.append(1 + SURPRISE * np.sqrt(2 / max(len(own), 1)))
    worst = int(np.argmax(squares))
    if not squares[worst] <= limits[worst]:  # a simulation that broke down is off too
        place = Place("joint", robot.joint_names[worst])
        return Verdict(True, (Named(NAMELESS, place, 1.0),))
    return Verdict(mismatch=False)
