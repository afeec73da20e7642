"""What the minimum of a sum of norms tells of its parameters, against many draws of the noise."""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from pup.sysid.uncertainty import Told, information

Array = NDArray[np.float64]
TICKS = (slice(0, 60), slice(60, 100))
BLOCKS = np.concatenate([np.arange(0, 300, 3), np.arange(300, 500, 2)])
"""A hundred ticks of three joints, then as many of two angles."""
WEIGHT = np.repeat([1.0, 10.0], [300, 200])
SPREAD = np.repeat([0.01, 0.004], [300, 200])


def told(error: Array, jacobian: Array) -> Told:
    return Told(WEIGHT * error, WEIGHT[:, None] * jacobian, BLOCKS, TICKS, 1.0)


def minimum(measured: Array, jacobian: Array) -> Array:
    """Of the sum of weighted norms, for a model that is linear in two parameters."""

    def loss(x: Array) -> float:
        error = WEIGHT * (measured - jacobian @ x)
        return float(np.sqrt(np.add.reduceat(error**2, BLOCKS)).sum())

    return np.asarray(minimize(loss, np.zeros(2), method="Nelder-Mead").x)


def test_intervals_are_as_wide_as_the_estimates_scatter() -> None:
    """Tilt, weighed by ten, spoils an estimate that the joints know well: the interval says so."""
    rng = np.random.default_rng(0)
    jacobian = rng.normal(size=(500, 2))
    jacobian[300:] *= 0.1
    found = np.array([minimum(SPREAD * rng.normal(size=500), jacobian) for _ in range(150)])
    error = SPREAD * rng.normal(size=500)
    expected = np.sqrt(np.diag(np.linalg.inv(information(told(error, jacobian), []))))
    np.testing.assert_allclose(found.std(axis=0), expected, rtol=0.2)


def test_a_start_that_is_read_with_noise_widens_them() -> None:
    """A reading moves all of its own recording's errors at once, and no other's."""
    rng = np.random.default_rng(1)
    jacobian = np.ones((500, 1))
    error = SPREAD * rng.normal(size=500)
    first = np.repeat(np.isin(np.arange(100), np.arange(60)), 3)
    start = 0.02 * np.concatenate([first, np.zeros(200)])
    alone, together = (
        1 / float(information(told(error, jacobian), given)[0, 0]) for given in ([], [start])
    )
    # A norm of d numbers of spread s pulls with its weight times E|e| / (d s^2).
    pull = WEIGHT / SPREAD * np.repeat([np.sqrt(8 / np.pi) / 3, np.sqrt(np.pi / 2) / 2], [300, 200])
    share = float((pull[:300] * first).sum() / pull.sum())
    np.testing.assert_allclose(together - alone, (0.02 * share) ** 2, rtol=0.25)
