"""Where fits of finalists start: from a model, a score, a rival, or all samples."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.beginnings import begun
from pup.diagnosis.coordinates import described_at, term_coordinate
from pup.diagnosis.evidence import Score
from pup.diagnosis.fit import Fit
from pup.diagnosis.fitting import fit_together
from pup.diagnosis.hypotheses import Hypothesis
from pup.diagnosis.replays import Replays
from pup.diagnosis.residuals import Noise
from pup.physics.terms import TERMS

Array = NDArray[np.float64]
Tried = tuple[tuple[Hypothesis, ...], Fit]
"""A fit under way and the effects it has."""

ROUGHLY, CLOSELY = 1e-3, 1e-4
"""Relative gain of chi-squared at which a finalist's fit may end: at first, and to be compared with
others, which differ by less than what a step in a narrow valley gains."""
LAST = 14
"""Steps of a finalist's fit to its end."""
SHARES = (1.0, 0.4)
"""Shares of its linear size at which a finalist may start."""
DAMPED, FURTHEST = 0.01, 0.5
"""Damping and reach of the step that the other coordinates may take with it."""
PUZZLING, GLARING = 0.5, 30.0
"""A search that leaves this share of what is more than noise has explained little; where the best
of all effects leaves so many times the noise, they are begun elsewhere too: the right one may have
stopped halfway, as a gear's friction that all but holds its joint."""
DRIVEN = 0.2
"""So they are where it leaves this share and parameters were driven so far off that the described
robot is looked at too: beside a torque limit of a quarter an armature explained 63 % of a lag."""
LOUD = 6.0
"""A fit that leaves so many times the noise may have stopped anywhere, or lacks much."""
LIMB = 6
"""Joints up to which that is done."""
UNUSUAL = np.log(3.0)
"""A nominal parameter further than this from the robot's description may have been led astray."""


def started(before: Fit, score: Score) -> Fit:
    """A fit of a model with one effect more, where the score test says it lies."""
    hypothesis = score.trace.hypothesis
    sizes = np.clip(score.sizes, -3, 3) if hypothesis.signed else np.clip(score.sizes, 0.05, 3)
    free = hypothesis.magnitudes + hypothesis.continuous
    coordinates = tuple(term_coordinate(name, hypothesis.scale) for name in free)
    shape = dict(hypothesis.shape)
    start = [*sizes, *(c.coordinate(shape[c.name]) for c in coordinates[len(sizes) :])]
    low, high = ([getattr(c, end) for c in coordinates] for end in ("lower", "upper"))
    fit = Fit(
        before.coordinates + coordinates,
        np.r_[before.at, np.clip(start, low, high)],
        fixed={**before.fixed, **{n: v for n, v in shape.items() if n not in free}},
        thorough=False,
        slack=ROUGHLY,
    )
    if not hypothesis.continuous:  # the traces are the Jacobian's columns
        assert before.jacobian is not None
        fit.jacobian = np.hstack([before.jacobian, score.trace.whole])
        fit.age = 1
    return fit


def options(before: Fit, score: Score, fit: Fit) -> list[Array]:
    """Where a finalist may start: all or some of what slopes promise, with or without the others.

    Many an effect acts from some size on, and then more than its slope says.
    """
    assert before.residual is not None
    n, trace = len(before.at), score.trace.whole
    sizes = fit.at[n : n + trace.shape[1]]
    movable, slopes = before.movable, before.slopes
    normal = slopes.T @ slopes
    normal[np.diag_indices_from(normal)] += 1 + DAMPED * np.diag(normal)
    low, high = ([getattr(c, end) for c in before.coordinates] for end in ("lower", "upper"))
    upper = [c.upper for c in fit.coordinates[n : n + len(sizes)]]
    besides = TERMS[score.trace.hypothesis.effect].starts
    starts = [(share * sizes, share * sizes) for share in SHARES]
    starts += [(np.minimum(np.full(len(sizes), size), upper), sizes) for size in besides]
    places = []
    for size, felt in starts:
        at = fit.at.copy()
        at[n : n + len(sizes)] = size
        left = slopes.T @ (before.residual - trace @ felt)
        step = np.zeros(n)
        step[movable] = np.clip(np.linalg.solve(normal, left), -FURTHEST, FURTHEST)
        places += [at, np.r_[np.clip(before.at + step, low, high), at[n:]]]
    return places


def puzzling(before: Fit, tried: Sequence[Tried], share: float = PUZZLING) -> bool:
    """Whether the best of some effects leaves too much of what a fit has beyond noise.

    Args:
      before: the fit.
      tried: fits with an effect more each.
      share: of it that is too much.
    """
    assert before.residual is not None
    noise = len(before.residual)
    left = min((fit.chi2 for _, fit in tried), default=before.chi2) - noise
    return left > min(share * (before.chi2 - noise), GLARING * noise)


def glaring(left: float, samples: int) -> bool:
    """Whether what a fit leaves of chi-squared is many times the noise."""
    return left - samples > GLARING * samples


def distinct(tried: Sequence[Tried]) -> list[Tried]:
    """The best fit of each newest effect at each place, of each of its choices."""
    best: dict[object, Tried] = {}
    for one in sorted(tried, key=lambda one: one[1].chi2):
        best.setdefault(one[0][-1].variant, one)
    return list(best.values())


def described(nominal: Fit, replays: Replays, noise: Noise) -> Fit | None:
    """The robot as it is described, with its Jacobian, where its nominal fit ends far from that.

    What is missing may have driven gains to where no robot has them, and there nothing looks like
    it: an integral part, for one, hides in a proportional one seven times too large. On the ground
    it is not asked for, where gains that are far off make a robot fall.
    """
    if any(r.support == "ground" for r in replays.measured.recordings):
        return None
    at = described_at(nominal.coordinates, replays.space)
    if np.abs(at - nominal.at).max() < UNUSUAL:
        return None
    fit = Fit(nominal.coordinates, at)
    fit_together([fit], replays, noise, iterations=0)
    return fit


def less(fit: Fit, hypothesis: Hypothesis) -> Fit:
    """A fit that is to do without one of its effects."""
    gone = {*hypothesis.magnitudes, *(name for name, _ in hypothesis.shape)}
    kept = [i for i, c in enumerate(fit.coordinates) if c.name not in gone]
    return Fit(
        tuple(fit.coordinates[i] for i in kept),
        fit.at[kept].copy(),
        fixed={n: v for n, v in fit.fixed.items() if n not in gone},
        thorough=False,
    )


def joined(fit: Fit, rival: Fit, own: Hypothesis) -> Fit:
    """A fit with an effect of another one, as that found it."""
    names = {*own.magnitudes, *(name for name, _ in own.shape)}
    kept = [i for i, c in enumerate(rival.coordinates) if c.name in names]
    return Fit(
        fit.coordinates + tuple(rival.coordinates[i] for i in kept),
        np.r_[fit.at, rival.at[kept]],
        fixed={**fit.fixed, **{n: v for n, v in rival.fixed.items() if n in names}},
        thorough=False,
        slack=ROUGHLY,
    )


def begun_anew(fits: Sequence[Fit], replays: Replays, noise: Noise) -> None:
    """Fits that leave many times the noise, begun where beginnings of recordings lead if better.

    What swings gets out of step, and a fit to all of it stops anywhere: of two forms of a class the
    right one may so be the worse. Not of whole robots, which it would take minutes of, and which
    `beginnings.nearer` looks after where they stand.
    """
    if len(replays.measured.robot.joints) > LIMB:
        return
    far = [fit for fit in fits if fit.chi2 > LOUD * len(replays.measured.values)]
    others = [fit.fresh() for fit in far]
    begun(others, replays, noise)
    closely(others, replays, noise)
    for fit, other in zip(far, others, strict=True):
        if other.chi2 < fit.chi2:
            vars(fit).update(vars(other))


def closely(fits: Sequence[Fit], replays: Replays, noise: Noise) -> None:
    """Bring fits to their ends, with Jacobians of their own, to be compared with others."""
    for fit in fits:
        fit.thorough, fit.done, fit.jacobian, fit.slack = True, False, None, CLOSELY
        fit.damping, fit.stuck, fit.narrow = Fit.damping, 0, True
    fit_together(fits, replays, noise, iterations=LAST)
