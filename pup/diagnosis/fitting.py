"""Many least-squares fits at once: each step of all of them is one replay.

A fit moves its own parameters in coordinates of order one: the logarithm of what is positive, and
an effect's magnitudes in their typical sizes. Jacobians by differences are refreshed only where
Broyden's update of them leads no further, as a replay is all the cost there is.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.fit import ALMOST, WIDE, Fit
from pup.diagnosis.probing import changes, probed
from pup.diagnosis.replays import Replays
from pup.diagnosis.residuals import LOST, Noise
from pup.sysid.gauss_newton import updated

Array = NDArray[np.float64]
Rows = list[dict[str, float]]

STEP = 0.0004
"""Finite-difference step, of a coordinate."""
NARROWER = 7.1
"""So many times narrower differences in contact get: impacts make trajectories jump by a hair of
time. Slopes across 2 % lead over the jumps, and narrow ones to the bottom of the hollow that they
lead to."""
DAMPINGS, HEAVIER = (0.1,), (1.0, 10.0, 100.0)
"""Tried at once, relative to the current one: at first, and where that led nowhere."""
CHEAP = 100
"""Simulations that a replay may have beside those it needs, for Jacobians of its trials."""
RELIABLE = 0.5
"""Share of what it promised that a step must gain for its Jacobian to be kept."""
PATIENCE = 2
"""Accepted steps for which an updated Jacobian is trusted."""


def fit_together(fits: Sequence[Fit], replays: Replays, noise: Noise, iterations: int = 12) -> None:
    """Move some fits to their minima, in step.

    Where simulations are so few that a replay costs the same with more, trials are simulated with
    their differences, and every step has a fresh Jacobian.

    Args:
      fits: changed in place. One without a residual is replayed first; one with a Jacobian starts
        with it.
      replays: simulates.
      noise: weighs the samples.
      iterations: at most this many steps of each.
    """
    _begin([fit for fit in fits if fit.residual is None], replays, noise)
    for _ in range(iterations):
        _look_around([fit for fit in fits if not fit.done], replays, noise)
        moving = [fit for fit in fits if not fit.done]
        if not moving:
            break
        trials = [(fit, at) for fit in moving for at in _trials(fit)]
        reached = _reached(trials, replays, noise)
        for fit in moving:
            _take(
                fit,
                replays,
                [told for (owner, _), told in zip(trials, reached, strict=True) if owner is fit],
            )
    for fit in fits:
        _widen(fit)


def start_best(
    fits: Sequence[Fit], options: Sequence[Sequence[Array]], replays: Replays, noise: Noise
) -> None:
    """Let each fit start where it is best.

    Args:
      fits: changed in place.
      options: coordinates that each may start at.
      replays: simulates.
      noise: weighs the samples.
    """
    tried = [(fit, at) for fit, places in zip(fits, options, strict=True) for at in places]
    if not tried:
        return
    simulated = replays([fit.row(at) for fit, at in tried])
    residuals = _residuals([fit for fit, _ in tried], simulated, replays, noise)
    for (fit, at), residual in zip(tried, residuals, strict=True):
        chi2 = fit.cost(residual, at)
        if chi2 < fit.chi2:
            fit.at, fit.residual, fit.chi2 = at, residual, chi2


def _look_around(fits: Sequence[Fit], replays: Replays, noise: Noise) -> None:
    """Give fits the Jacobians they need for a step; those that one promises nothing have ended."""
    complete(fits, replays, noise)
    doubtful = [f for f in fits if f.thorough and f.age > 0 and _ended(f)]
    differentiate(doubtful, replays, noise)
    for fit in doubtful:
        _hope(fit)
    ended = [fit for fit in fits if _ended(fit)]
    for fit in ended:
        _end(fit, replays)
    narrowed = [fit for fit in ended if not fit.done]
    if narrowed:
        _look_around(narrowed, replays, noise)


def _end(fit: Fit, replays: Replays) -> None:
    """End a fit, or let it go on with closer differences: exact ones, narrower ones in contact."""
    if fit.thorough and not fit.exact and not fit.near_noise:
        fit.exact = True
        fit.jacobian = None
        _hope(fit)
    elif fit.narrow and fit.contact > 1 and replays.measured.grounded.any():
        fit.contact = max(fit.contact / NARROWER, 1.0)
        fit.jacobian = None
        _hope(fit)
    else:
        fit.done = True


def _hope(fit: Fit) -> None:
    """Forget how a fit failed with another Jacobian, which says nothing of a new one."""
    fit.stuck, fit.damping = 0, min(fit.damping, Fit.damping)


def _widen(fit: Fit) -> None:
    """Forget narrow differences: how far a fit may move unnoticed, or imitate what, wide ones tell.

    Narrow ones are of jumps.
    """
    if fit.contact < WIDE:
        fit.jacobian, fit.contact = None, WIDE


def _ended(fit: Fit) -> bool:
    """Whether the Jacobian promises no gain that counts.

    A step that is cut at two walls of its box may promise less than one that is damped more.
    """
    return all(fit.promise(at) < fit.least for at in _trials(fit, (*DAMPINGS, *HEAVIER)))


def complete(fits: Sequence[Fit], replays: Replays, noise: Noise) -> None:
    """Give those fits a Jacobian that have none."""
    differentiate([fit for fit in fits if fit.jacobian is None], replays, noise)


def differentiate(fits: Sequence[Fit], replays: Replays, noise: Noise) -> None:
    """Give some fits fresh Jacobians where they stand."""
    if not fits:
        return
    for exact in (False, True):
        some = [fit for fit in fits if fit.exact is exact]
        asked = [_differences(fit, fit.at) for fit in some]
        rows = [(fit.row(), *d[1]) for fit, d in zip(some, asked, strict=True)]
        told = changes(rows, replays, coarse=not exact) if some else []
        for fit, (steps, _), changed in zip(some, asked, told, strict=True):
            fit.jacobian = _jacobian(steps, changed, replays, noise)
            fit.age = 0


def _differences(fit: Fit, at: Array) -> tuple[Array, tuple[Rows, Rows]]:
    """Steps of the coordinates around a point, and the column that each sets.

    Returns:
      The steps, shape (2, n_free), and the columns: in the air, then on the ground.
    """
    widths = fit.width, min(fit.contact * fit.width, 2 * WIDE)
    steps = np.array([[difference(fit, i, at, w) for i in range(len(at))] for w in widths])

    def columns(moved: Array) -> Rows:
        return [{c.name: c.value(x)} for c, x in zip(fit.coordinates, moved, strict=True)]

    return steps, (columns(at + steps[0]), columns(at + steps[1]))


def _jacobian(steps: Array, changed: Array, replays: Replays, noise: Noise) -> Array:
    white = replays.measured.whiten(np.where(np.isnan(changed), 0.0, changed), noise)
    return np.asarray((white / steps[replays.measured.grounded.astype(int)].T).T)


def _reached(
    trials: Sequence[tuple[Fit, Array]], replays: Replays, noise: Noise
) -> list["_Reached"]:
    """What some trials lead to, with Jacobians where those are cheap."""
    fits = [fit for fit, _ in trials]
    rows = [fit.row(at) for fit, at in trials]
    more = sum(len(at) for _, at in trials) * len(replays.measured.recordings)
    if more > CHEAP:
        residuals = _residuals(fits, replays(rows), replays, noise)
        return [_Reached(at, r, None) for (_, at), r in zip(trials, residuals, strict=True)]
    asked = [_differences(fit, at) for fit, at in trials]
    told = probed([(row, *d[1]) for row, d in zip(rows, asked, strict=True)], replays)
    residuals = _residuals(fits, np.stack([base for base, _ in told]), replays, noise)
    return [
        _Reached(at, residual, _jacobian(steps, changed, replays, noise))
        for (_, at), residual, (steps, _), (_, changed) in zip(
            trials, residuals, asked, told, strict=True
        )
    ]


def _begin(fits: Sequence[Fit], replays: Replays, noise: Noise) -> None:
    """Replay some fits where they stand, those without a Jacobian with their differences."""
    if not fits:
        return
    nothing: tuple[Array, tuple[Rows, Rows]] = np.empty((2, 0)), ([], [])
    asked = [_differences(fit, fit.at) if fit.jacobian is None else nothing for fit in fits]
    told = probed([(fit.row(), *d[1]) for fit, d in zip(fits, asked, strict=True)], replays)
    residuals = _residuals(fits, np.stack([base for base, _ in told]), replays, noise)
    for fit, residual, (steps, _), (_, changed) in zip(fits, residuals, asked, told, strict=True):
        fit.residual, fit.chi2 = residual, fit.cost(residual, fit.at)
        if fit.jacobian is None:
            fit.jacobian, fit.age = _jacobian(steps, changed, replays, noise), 0


def _residuals(fits: Sequence[Fit], simulated: Array, replays: Replays, noise: Noise) -> Array:
    """Whitened errors of one row for each fit."""
    measured = replays.measured
    data = np.stack([measured.values if f.data is None else f.data for f in fits])
    errors = data - np.where(np.isnan(simulated), data + LOST, simulated)
    return measured.whiten(errors, noise)


def difference(fit: Fit, i: int, at: Array, width: float) -> float:
    """A step of a coordinate into its range, for a slope; so many times as wide as usual."""
    coordinate = fit.coordinates[i]
    step = width * (STEP if coordinate.scale is None else 5 * STEP)
    return step if at[i] + step <= coordinate.upper else -step


def _trials(fit: Fit, dampings: Sequence[float] = ()) -> list[Array]:
    """Where damped Gauss-Newton steps lead, the least damped first."""
    normal, gradient = fit.normal(), fit.downhill()
    lower = np.array([c.lower for c in fit.coordinates])
    upper = np.array([c.upper for c in fit.coordinates])
    scale = np.maximum(np.diag(normal), 1e-6 * max(float(np.diag(normal).max()), 1e-300))
    points = []
    for factor in dampings or _dampings(fit):
        system = normal + factor * fit.damping * np.diag(scale)
        points.append(_bounded(system, gradient, fit.at, lower, upper))
    return points


def _dampings(fit: Fit) -> tuple[float, ...]:
    return HEAVIER if fit.stuck else DAMPINGS


def _bounded(system: Array, gradient: Array, at: Array, lower: Array, upper: Array) -> Array:
    """A Newton step that stays in its box; what hits a wall stays there."""
    free = np.ones(len(at), dtype=bool)
    step = np.zeros(len(at))
    for _ in range(len(at)):
        step[free] = np.linalg.solve(
            system[np.ix_(free, free)], gradient[free] - system[np.ix_(free, ~free)] @ step[~free]
        )
        out = free & ((at + step < lower - ALMOST) | (at + step > upper + ALMOST))
        if not out.any():
            break
        step[out] = np.clip(at + step, lower, upper)[out] - at[out]
        free &= ~out
        if not free.any():
            break
    return np.clip(at + step, lower, upper)


@dataclass(frozen=True, eq=False)
class _Reached:
    """Where a trial led: its coordinates, its residual and, if it was cheap, its Jacobian."""

    at: Array
    residual: Array
    jacobian: Array | None


def _take(fit: Fit, replays: Replays, reached: Sequence[_Reached]) -> None:
    """Go where a trial is best, or ask for a fresh Jacobian, or stop."""
    costs = [fit.cost(told.residual, told.at) for told in reached]
    best = int(np.argmin(costs))
    gain, fresh = fit.chi2 - costs[best], fit.age == 0
    kept = gain > RELIABLE * fit.promise(reached[best].at)
    if gain > 0:
        _go(fit, reached[best], costs[best])
        fit.damping = float(np.clip(fit.damping * _dampings(fit)[best], 1e-6, 1e6))
        fit.stuck, fit.moved = 0, True
    if gain > fit.least:
        if fit.thorough and fit.age > 0 and (fit.age >= PATIENCE or not kept):
            fit.jacobian = None
    elif gain <= 0 and fit.stuck < 2:
        fit.damping *= 10 if fit.stuck == 0 else 1000
        fit.stuck += 1
    elif fresh or (fit.moved and not fit.thorough):
        _end(fit, replays)
    else:
        fit.jacobian = None
        _hope(fit)


def _go(fit: Fit, to: _Reached, chi2: float) -> None:
    """Stand where a trial led, with its Jacobian or an updated one."""
    assert fit.jacobian is not None and fit.residual is not None
    if to.jacobian is not None:
        fit.jacobian, fit.age = to.jacobian, 0
    else:
        moved = to.at - fit.at
        if moved @ moved > 0:
            fit.jacobian = updated(fit.jacobian, moved, fit.residual - to.residual)
        fit.age += 1
    fit.at, fit.residual, fit.chi2 = to.at, to.residual, chi2
