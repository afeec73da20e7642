"""How a robot stands on its feet."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def sole_of(foot: str) -> str:
    """The site on a foot whose z axis is the sole's upward one, where the body's own is not."""
    return f"{foot}_sole"


def floor_normal(places: Array, axes: Array) -> Array:
    """The direction of the floor's normal as the feet tell it that stand on it, shape (3,).

    Soles tell it by their upward axes. Three feet or more tell it by where they are, and need no
    soles: the feet of a quadruped may be the ends of its shanks, which lean.

    Args:
      places: of the feet, shape (n_feet, 3), m.
      axes: their upward axes, shape (n_feet, 3).
    """
    if len(places) < 3:
        return np.asarray(axes.mean(axis=0))
    normal = np.linalg.svd(places - places.mean(axis=0))[2][2]  # of the plane nearest to them
    return np.asarray(normal if normal[2] > 0 else -normal)
