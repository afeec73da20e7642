"""How much of a force a sub-step takes implicitly: half where it is soft, all where it is stiff."""

import numpy as np
from numpy.typing import NDArray

from pup.physics import kernels

Array = NDArray[np.float64]


def implicit_share(damping: Array, inertia: Array, timestep: float | Array) -> Array:
    """Share of a viscous torque to be taken implicitly, for one inertia exact whatever the step.

    Of `inertia * dv/dt = -damping * v` a step that takes the share 1/(1 - exp(-x)) - 1/x, with
    x = damping * timestep / inertia, implicitly and the rest explicitly ends at exp(-x) v: half of
    it where damping is soft (second order), all of it where it is stiff (stable).

    Args:
      damping: viscous coefficients, N m s/rad.
      inertia: what they brake, same shape, kg m².
      timestep: s; one for all, or broadcastable to the rest.
    """
    return np.asarray(kernels.implicit_share(damping, inertia, timestep))
