"""The arithmetic of a servo's millisecond, compiled.

A virtual robot in lock-step spends its time on some forty calls of NumPy for twenty numbers each,
a thousand times a simulated second. Arrays have a row for each robot and a column for each joint;
those of supplies have one column.
"""

import math
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FILTER = 0.5
"""Share of a new sample in the speed that the D gain sees."""
BUILT_UP = 20_000.0
"""The most that the integral part counts for, ticks x P."""
FREE = 1e12
"""A torque that is no limit, N m."""


def _compiled(function: Callable[..., None]) -> Any:
    """Compile for arrays of any strides, and keep it where some folder can be written."""
    count = function.__code__.co_argcount
    signature = numba.void(*[numba.float64[:, :]] * (count - 1), numba.float64)
    try:
        return numba.njit(signature, error_model="numpy", cache=True)(function)
    except (RuntimeError, OSError, EOFError):  # there is none, it is full, or was cut short
        return numba.njit(signature, error_model="numpy")(function)


@_compiled
def command(
    duty: Array,
    seen: Array,
    trend: Array,
    built: Array,
    ticks: Array,
    goal: Array,
    p: Array,
    ki: Array,
    d: Array,
    gain: Array,
    most: Array,
    power: Array,
    step: float,
) -> None:
    """The firmware's loop: from ticks to duty.

    Args:
      duty: -1 to 1; set.
      seen: ticks in the last loop; set.
      trend: their filtered change per loop; moved on.
      built: of the integral part, ticks x P; moved on.
      ticks: that the encoder says.
      goal: ticks.
      p: duty per tick.
      ki: P per s.
      d: duty per tick and loop.
      gain: duty per tick and P.
      most: largest duty.
      power: 1 where torque is on, else 0.
      step: s.
    """
    for i in range(duty.shape[0]):
        for j in range(duty.shape[1]):
            error = goal[i, j] - ticks[i, j]
            trend[i, j] += FILTER * (ticks[i, j] - seen[i, j] - trend[i, j])
            seen[i, j] = ticks[i, j]
            told = p[i, j] * error - d[i, j] * trend[i, j]
            if ki[i, j] != 0.0:
                built[i, j] += step * ki[i, j] * error * power[i, j]
                built[i, j] = min(max(built[i, j], -BUILT_UP), BUILT_UP)
                told += gain[i, j] * built[i, j]
            duty[i, j] = min(max(told, -most[i, j]), most[i, j]) * power[i, j]


@_compiled
def gear(
    drive: Array,
    torque: Array,
    rotor: Array,
    lash: Array,
    bristle: Array,
    drawn: Array,
    duty: Array,
    volts: Array,
    speed: Array,
    strength: Array,
    brake: Array,
    kinetic: Array,
    static: Array,
    stribeck: Array,
    loaded: Array,
    viscous: Array,
    grip: Array,
    kick: Array,
    play: Array,
    amperes: Array,
    step: float,
) -> None:
    """Motor, dry friction with a presliding range, and play: from duty to the torque on the link.

    A rotor ahead of its link by the whole play can only push it forward, one behind only backward;
    in between it runs free.

    Args:
      drive: torque of the motor before the gear, N m; set.
      torque: on the link, N m; moved on.
      rotor: speed of the rotor at the joint, rad/s; moved on.
      lash: by which the rotor is ahead of the link, rad; moved on.
      bristle: dry friction, N m; moved on.
      drawn: of the supply, A, one column; set.
      duty: -1 to 1.
      volts: of the supply, one column.
      speed: of the link, rad/s.
      strength: of the motor, N m/V.
      brake: by back-EMF, N m s/rad.
      kinetic: friction of a fast rotor, N m.
      static: that one which stands has more, N m.
      stribeck: how it falls with the speed, s/rad, negative.
      loaded: friction by the torque that is passed on, 1.
      viscous: N m s/rad.
      grip: by which bristles stiffen in a step, N m s/rad.
      kick: a step over the rotor's inertia, s/(kg m2).
      play: half of it, rad.
      amperes: current by torque, A/(N m).
      step: s.
    """
    for i in range(drive.shape[0]):
        drawn[i, 0] = 0.0
        for j in range(drive.shape[1]):
            turning = rotor[i, j]
            drive[i, j] = strength[i, j] * duty[i, j] * volts[i, 0] - brake[i, j] * turning
            level = math.exp(abs(turning) * stribeck[i, j]) * static[i, j] + kinetic[i, j]
            level += loaded[i, j] * abs(torque[i, j])
            held = bristle[i, j] + grip[i, j] * turning
            bristle[i, j] = min(max(held, -level), level)
            net = drive[i, j] - bristle[i, j] - viscous[i, j] * turning
            most = FREE if lash[i, j] >= play[i, j] else 0.0
            least = -FREE if lash[i, j] <= -play[i, j] else 0.0
            passed = max(min(net, most), least)
            torque[i, j] = passed
            rotor[i, j] = turning + net * kick[i, j] if passed == 0.0 else speed[i, j]
            ahead = lash[i, j] + step * (rotor[i, j] - speed[i, j])
            lash[i, j] = min(max(ahead, -play[i, j]), play[i, j])
            drawn[i, 0] += duty[i, j] * drive[i, j] * amperes[i, j]
