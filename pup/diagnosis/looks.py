"""First looks: what is missing in some of the recordings, where a fit to all tells little.

A motion that the nominal model loses track of, such as a limb that swings freely after the torque
went off, says nothing by its slopes: errors of a radian are not small. It would also drag the
nominal parameters with it. What is missing is then looked for in the other motions first, and the
search goes on with all of them from what was found there.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.noise import assumed_noise
from pup.diagnosis.nominal import Nominal, certified, fit_nominal
from pup.diagnosis.replays import Replays
from pup.diagnosis.residuals import Measured
from pup.diagnosis.search import Search, looked_at, search
from pup.diagnosis.starts import LOUD, puzzling
from pup.physics.terms.scale import Scale

Array = NDArray[np.float64]

ASTRAY, FAR = 0.5, 0.2
"""A motion is lost where a joint or the torso is off by this share of what it moves, and by so
much, rad."""
LEFT = 1 / 3
"""Share of all recordings that must be left for a first look."""
WELL = 4.0
"""A recording is followed well whose mean squared error is so many times that of the best third at
most."""
QUIET = 1.5
"""A model that leaves less than so many times the noise may be of all that is missing."""
DRAGGED = 2.0
"""A model of all recordings follows some worse than one of these alone does, where what it leaves
beyond the noise is so many times as much, or so many times the noise."""


@dataclass(frozen=True, eq=False)
class FirstLook:
    """What some of the recordings show.

    Attributes:
      nominal: the nominal model fitted to them.
      search: what is missing there.
    """

    nominal: Nominal
    search: Search


def first_look(
    kept: Sequence[int],
    replays: Replays,
    rng: np.random.Generator,
    progress: Callable[[str, float], None],
    effects: int,
) -> FirstLook | None:
    """Look for what is missing in some of the recordings.

    None where there are none of these, or their nominal fit does not converge either.

    Args:
      kept: which recordings, by number.
      replays: simulates all of them.
      rng: draws starts and noise.
      progress: told the stage and the share of all that is done.
      effects: that are looked for at most.
    """
    if not kept:
        return None
    some = replays.narrowed(kept)
    fitted = certified(fit_nominal(some, assumed_noise(some.measured), rng), some, rng)
    holds = fitted.certificate.holds
    found = search(some, fitted, rng, progress, most=effects) if holds else None
    replays.simulated += some.simulated
    return None if found is None else FirstLook(fitted, found)


def nowhere(done: Search, nominal: Nominal) -> bool:
    """Whether a search has led nowhere: what it leaves is many times the noise, or half of all."""
    model = done.model
    loudness = model.fit.chi2 / model.samples
    little = puzzling(nominal.fit, [(model.hypotheses, model.fit)])
    return loudness > LOUD or (little and loudness > QUIET)


def drags(first: Search, done: Search) -> bool:
    """Whether some recordings keep a model of all from following what a first look's model follows.

    What is missing there is not what was found, and makes up for it in all the others.
    """
    residual = done.model.fit.residual
    assert residual is not None
    inside = residual[looked_at(first, done.model.measured)]
    own = max(first.model.fit.chi2 - first.model.samples, first.model.samples)
    return bool(first.model.hypotheses) and float(np.sum(inside**2 - 1)) > DRAGGED * own


def followed(nominal: Nominal, replays: Replays) -> list[int]:
    """The recordings that the nominal model does not lose track of.

    Empty where it loses none, or where too few are left for a first look.
    """
    measured = replays.measured
    errors = replays.errors(nominal.fit.row())
    errors = np.where(np.isnan(errors), np.inf, errors)
    every = range(len(measured.recordings))
    kept = [i for i in every if not _lost(measured, errors, measured.only([i]))]
    return kept if _worth_a_look(measured, kept) else []


def followed_well(nominal: Nominal, replays: Replays) -> list[int]:
    """The recordings that the nominal model is least off in, next to their noise.

    Empty where it is off as much in nearly all, or where too few are left for a first look.
    """
    residual, measured = nominal.fit.residual, replays.measured
    assert residual is not None
    count = len(measured.recordings)
    own = [residual[measured.only([i])] ** 2 for i in range(count)]
    off = [float(squares.mean()) if len(squares) else np.inf for squares in own]
    best = sorted(off)[int(np.ceil(LEFT * count)) - 1]
    kept = [i for i in range(count) if off[i] <= WELL * max(best, 1.0)]
    return kept if _worth_a_look(measured, kept) else []


def in_the_air(measured: Measured) -> list[int]:
    """The recordings without contact, which makes a fit end in many a place.

    Empty where there is no contact, or where too few are left for a first look.
    """
    kept = [i for i, r in enumerate(measured.recordings) if r.support != "ground"]
    return kept if _worth_a_look(measured, kept) else []


def _worth_a_look(measured: Measured, kept: Sequence[int]) -> bool:
    """Whether these are some recordings, not all: a third of them, and two types of motion."""
    types = {measured.recordings[i].motion for i in kept}
    count = len(measured.recordings)
    return LEFT * count <= len(kept) < count and len(types) > 1


def _lost(measured: Measured, errors: Array, own: NDArray[np.bool_]) -> bool:
    joints = len(measured.robot.joints)
    for channel in range(measured.channels):
        far = FAR * Scale.of(measured.robot).angle if channel < joints else FAR
        here = own & (measured.channel == channel)
        if here.any():
            off = float(np.sqrt(np.mean(errors[here] ** 2)))
            if off > max(far, ASTRAY * float(np.std(measured.values[here]))):
                return True
    return False
