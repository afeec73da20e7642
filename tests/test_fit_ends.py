"""Where fits end: at minima, and not where a slope that is only nearly right leads no further."""

from dataclasses import replace

import numpy as np
from diagnosis_cases import BENCH, recordings
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from pup.diagnosis.coordinates import Coordinate
from pup.diagnosis.fit import Fit
from pup.diagnosis.fitting import _ended, fit_together
from pup.diagnosis.noise import assumed_noise
from pup.diagnosis.replays import Bench, Replays, threads
from pup.diagnosis.residuals import Measured
from pup.physics.parameters import robot_space


def test_a_fit_that_ends_far_from_noise_has_ended() -> None:
    """A servo that is 10 ms late, which no nominal parameter is, from twelve starts far off.

    With slopes that are only nearly right a third of them stop at up to twice what they go on to.
    """
    rng = np.random.default_rng(0)
    told = recordings({"actuator_lag/time@joint:servo": 0.01}, seed=4)
    measured = Measured.of(BENCH, [replace(run, repeat_of=None) for run in told])
    replays = Replays(measured, robot_space(BENCH, "pd"), threads(Bench(measured), 1), 1)
    space, noise = replays.space, assumed_noise(measured)
    middle = np.log(space.nominal)
    free = tuple(
        Coordinate(name, None, m - 1.5, m + 1.5)
        for name, m in zip(space.names, middle, strict=True)
    )
    fits = [Fit(free, middle + rng.uniform(-1, 1, len(free))) for _ in range(12)]
    fit_together(fits, replays, noise, iterations=120)
    ended = [fit for fit in fits if fit.done]
    again = [fit.fresh() for fit in ended]
    for fit in again:
        fit.exact = True
    fit_together(again, replays, noise, iterations=40)
    gone_on = [fit.chi2 > 1.01 * on.chi2 for fit, on in zip(ended, again, strict=True)]
    assert len(ended) >= 10
    assert sum(gone_on) <= 1


@given(st.integers(0, 2**32 - 1), st.integers(3, 5))
def test_a_step_that_two_walls_cut_ends_no_fit(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    left, right = (np.linalg.qr(rng.normal(size=(m, n)))[0] for m in (60, n))
    jacobian = left @ np.diag(10 ** rng.uniform(-1, 3, n)) @ right.T
    lower, upper = -rng.uniform(0, 1, n), rng.uniform(0, 1, n)
    residual = jacobian @ rng.normal(size=n) + rng.normal(size=60)
    box = tuple(Coordinate(f"c{i}", 1.0, lower[i], upper[i]) for i in range(n))
    chi2 = float(residual @ residual)
    fit = Fit(box, np.zeros(n), residual=residual, jacobian=jacobian, chi2=chi2)
    best = lsq_linear(jacobian, residual, (lower, upper)).x
    assert not (_ended(fit) and fit.promise(best) > 10 * fit.least)
