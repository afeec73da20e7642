"""Folds of pre-sysID: what its fits get wrong on recordings that they have not seen."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.recording import Recording, originals
from pup.robot import Actuator
from pup.sysid.fit import FitResult
from pup.sysid.loss import ReplayLoss, Terms
from pup.sysid.problem import Problem

Array = NDArray[np.float64]


def check_folds(recordings: Sequence[Recording], count: int) -> None:
    """Refuse a number of folds that recordings cannot be put into.

    Raises:
      InputError: it is one, or more than there are recordings that repeat no other.
    """
    apart = len(set(_originals(recordings)))
    if count == 1 or count > apart:
        raise InputError(
            f"{count} folds for {apart} recordings that repeat no other; use 2 to "
            "their number, for each fold leaves some out and keeps some, or 0 for none"
        )


def kept_in_folds(recordings: Sequence[Recording], count: int) -> list[tuple[int, ...]]:
    """Recordings kept in each fold.

    Whole motion types are left out where there are enough of them; else recordings, spread over the
    types, a repeat always together with what it repeats.
    """
    motions = [(r.motion,) for r in recordings]
    unit = motions if len(set(motions)) >= count else _originals(recordings)
    rank = {u: at for at, u in enumerate(sorted(set(unit)))}
    return [tuple(i for i, u in enumerate(unit) if rank[u] % count != k) for k in range(count)]


def held_out(
    recordings: tuple[Recording, ...],
    folds: Sequence[Sequence[int]],
    fits: Mapping[tuple[Actuator, int], tuple[Problem, FitResult]],
    main: Actuator,
) -> dict[str, float]:
    """Equation 1 and root mean square error of all recordings, each by the fit that left it out.

    Each term of equation 1 is a mean over the recordings that have it. A mean of the folds' own
    losses would be another: a fold may leave out none that tilts.

    Args:
      recordings: all of them.
      folds: those that each fold kept.
      fits: of each torque law and fold.
      main: the torque law whose measures bear no name.
    """
    left_out = [tuple(r for i, r in enumerate(recordings) if i not in kept) for kept in folds]
    robot = next(iter(fits.values()))[0].robot
    whole = ReplayLoss(robot, [recording for left in left_out for recording in left])
    measures: dict[str, float] = {}
    for actuator in dict.fromkeys(actuator for actuator, _ in fits):
        errors, terms = [], []
        for k, left in enumerate(left_out):
            problem, result = fits[actuator, k]
            problem = replace(problem, recordings=left)
            replayed = problem.replay(result.best[None])
            errors.append(problem.loss.rmse(replayed)[0])
            terms.append(problem.loss.terms(replayed))
        suffix = "" if actuator == main else f"_{actuator}"
        measures["loss" + suffix] = float(whole.total(Terms.joined(terms, axis=1))[0])
        measures["rmse" + suffix] = pooled_rmse(np.concatenate(errors))
    return measures | {"folds": len(folds)}


def pooled_rmse(errors: Array) -> float:
    """Root mean square over recordings and joints of per-joint errors, each with equal weight."""
    return float(np.sqrt(np.nanmean(errors**2)))


def _originals(recordings: Sequence[Recording]) -> list[tuple[str, ...]]:
    """Of each recording, what it is or repeats."""
    return list(zip([r.motion for r in recordings], originals(recordings), strict=True))
