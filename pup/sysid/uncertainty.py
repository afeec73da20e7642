"""What the recordings say about each parameter around a fitted point."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pup.physics.parameters import ParameterSpace
from pup.recording import originals
from pup.sysid.gauss_newton import Confidence, confidence, step_within
from pup.sysid.problem import Problem
from pup.sysid.ripples import Shares, Surface, replays, surface
from pup.sysid.slopes import Slopes, slopes, told_at

Array = NDArray[np.float64]

UNIFORM = 12.0
"""Information of a uniform prior on the unit cube: one over its variance."""
ROUNDING = 1e-6
"""Relative change of the loss that is rounding: a fixed torso's mass reaches solver tolerances."""
RISE = 0.03
"""Share by which equation 1 rises on average where a surface is fitted to it."""
FARTHEST = 2.0
"""Standard deviations of a surface's draws that its minimum may lie away."""
KNOWN = 1e-3
"""Share of a variance that is estimated, below which it is as good as known."""
UNSEEN = 0.9
"""Share of the prior's spread left, above which the interval is the whole search range."""


def observable(problem: Problem, unit: Array) -> tuple[str, ...]:
    """The free parameters whose change changes the loss at all.

    A suspended robot has no ground friction: such a parameter would drift freely in a fit and
    come out as a precise number that means nothing.

    Args:
      problem: what is fitted.
      unit: a point on the unit cube, shape (n_free,).
    """
    probes = np.tile(unit, (2, len(unit), 1))
    for side, end in enumerate(
        (0.0, 1.0)
    ):  # a limit that does not bite at one end may at the other
        np.fill_diagonal(probes[side], end)
    losses = problem.losses(np.vstack([unit, *probes]))
    moved = np.abs(losses[1:] - losses[0]).reshape(2, -1).max(axis=0) > ROUNDING * losses[0]
    return tuple(n for n, seen in zip(problem.free, moved, strict=True) if seen)


@dataclass(frozen=True, eq=False)
class Spread:
    """Where the truth may be, on the unit cube.

    Attributes:
      space: the parameters.
      centre: shape (n_parameters,).
      covariance: shape (n_parameters, n_parameters).
      freedom: degrees of freedom that each variance was estimated with, shape (n_parameters,).
    """

    space: ParameterSpace
    centre: Array
    covariance: Array
    freedom: Array

    def confidence(self, level: float) -> Confidence:
        """Intervals that hold each parameter so often; what is not seen gets its whole range."""
        told = confidence(self.space, self.centre, self.covariance, self.freedom, level)
        return replace(
            told,
            lower=np.where(self.unseen, self.space.lower, told.lower),
            upper=np.where(self.unseen, self.space.upper, told.upper),
        )

    @property
    def unseen(self) -> NDArray[np.bool_]:
        """Which parameters the recordings tell next to nothing of, shape (n_parameters,)."""
        return np.asarray(np.sqrt(UNIFORM * np.diag(self.covariance)) > UNSEEN)

    def together(self, level: float) -> Confidence:
        """Intervals that hold all parameters at once so often (Bonferroni)."""
        return self.confidence(1 - (1 - level) / len(self.space))

    def among(self, space: ParameterSpace) -> "Spread":
        """What it says of another space's parameters; those it has not were taken as known there.

        Args:
          space: the parameters, with what was taken as known at its nominal values.
        """
        mine = [i for i, name in enumerate(self.space.names) if name in space.names]
        at = [space.names.index(self.space.names[i]) for i in mine]
        centre = space.normalise(space.nominal)
        covariance = np.zeros((len(space), len(space)))
        freedom = np.full(len(space), np.inf)
        centre[at], freedom[at] = self.centre[mine], self.freedom[mine]
        covariance[np.ix_(at, at)] = self.covariance[np.ix_(mine, mine)]
        return Spread(space, centre, covariance, freedom)


def spread_at(
    problem: Problem, unit: Array, progress: Callable[[float], None] = lambda _: None
) -> Spread:
    """What the recordings tell around a fitted point of equation 1.

    Where the robot hangs, from the slopes at the point. With contact those are a ripple's, and a
    surface through replays around the point tells instead (see `ripples`). Values of parameters
    that are not free are taken as known.

    Args:
      problem: what was fitted.
      unit: the fitted point on the unit cube, shape (n_free,).
      progress: told the share of the replays that is done.
    """
    if not problem.free:
        return Spread(problem.free_space, unit, np.empty((0, 0)), np.empty(0))
    on_ground = np.array([r.support == "ground" for r in problem.recordings])
    with threadpool_limits(limits=1):  # the sums of BLAS depend on its threads
        told, starts = told_at(problem, unit)
        information = slopes(told, starts).information
        covariance = np.asarray(np.linalg.inv(information + UNIFORM * np.eye(len(unit))))
        if not on_ground.any():
            return Spread(problem.free_space, unit, covariance, np.full(len(unit), np.inf))
        hanging = slopes(told.of(~on_ground), starts)
        rise = RISE * float(problem.losses(unit[None])[0])
        shares = _shares(problem, on_ground, progress)
        ground = surface(shares, unit, covariance, hanging.curvature, rise)
        noise = slopes(told.of(on_ground), starts).scatter
        return over_ripples(problem.free_space, unit, hanging, ground, noise)


def _shares(
    problem: Problem, chosen: NDArray[np.bool_], progress: Callable[[float], None]
) -> Shares:
    """What each motion of some recordings, with repeats, adds to equation 1 over all of them."""
    part, done = problem.of(np.flatnonzero(chosen).tolist()), 0
    whole, motions = replays(len(problem.free)), originals(part.recordings)

    def shares(units: Array) -> Array:
        nonlocal done
        progress(done / whole)
        done += len(units)
        terms = part.terms(units)
        # The mean of positions is over all recordings, those of tilt and feet over these anyway.
        told = part.loss.shares(terms) + (chosen.mean() - 1) * terms.position
        return by_motion(told, motions)

    return shares


def by_motion(shares: Array, motions: Sequence[str]) -> Array:
    """Shares of a loss by what was done, whose mean stays that of the recordings' shares.

    A motion done again strays from the model as it did before: repeats say no more of how another
    motion would have told than the first one does.

    Args:
      shares: of each recording, shape (n_candidates, n_recordings).
      motions: what each recording is or repeats, `pup.recording.originals`.

    Returns:
      Shape (n_candidates, n_motions), in the order of their first recordings.
    """
    names = tuple(dict.fromkeys(motions))
    member = np.array([[motion == name for name in names] for motion in motions])
    return np.asarray(shares @ member * (len(names) / len(motions)))


def over_ripples(
    space: ParameterSpace, unit: Array, hanging: Slopes, ground: Surface, noise: Array
) -> Spread:
    """Where the minimum of equation 1 is, and how it would scatter with other recordings.

    Args:
      space: the parameters.
      unit: where the slopes and the surface were taken, on the unit cube, shape (k,).
      hanging: of the recordings in the air.
      ground: of those with contact.
      noise: covariance of the slopes of those by their readings, shape (k, k). It stands in where
        there is a single motion, which cannot tell how another would differ.
    """
    count = len(ground.slopes)  # of motions: repeats are none of their own
    mean = ground.slopes.mean(axis=0)
    off = (ground.slopes - mean) / np.sqrt(count * max(count - 1, 1))
    both = Slopes(
        hanging.gradient + mean,
        hanging.curvature + ground.curvature,
        hanging.scatter + ground.slope_error + (off.T @ off if count > 1 else noise),
    )
    system = hanging.curvature + ground.at_least
    inverse = np.linalg.inv(system)
    # A gradient that pushes against a wall leads nowhere, and says nothing of the others.
    step = step_within(system, both.gradient, unit) - unit
    far = float(np.sqrt(step @ np.linalg.solve(ground.draws, step)))
    variance = np.diag(inverse @ both.scatter @ inverse)
    return Spread(
        space,
        unit + step * min(1.0, FARTHEST / max(far, 1e-300)),
        np.asarray(np.linalg.inv(both.information + UNIFORM * np.eye(len(unit)))),
        _freedom((off @ inverse) ** 2, variance),
    )


def _freedom(squares: Array, variance: Array) -> Array:
    """Degrees of freedom of variances, after Welch and Satterthwaite.

    Only the scatter over motions is an estimate, and a normal variable's fourth moment is three
    times its variance's square.

    Args:
      squares: what each motion adds to the variances, shape (n_motions, k).
      variance: with all that is known, shape (k,).
    """
    estimated = squares.sum(axis=0)
    speaking = 3 * estimated**2 / np.maximum((squares**2).sum(axis=0), 1e-300) - 1
    speaking = np.clip(speaking, 1.0, max(len(squares) - 1, 1))
    return np.asarray(speaking / np.maximum(estimated / variance, KNOWN) ** 2)
