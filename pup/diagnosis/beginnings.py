"""Fits brought near by how recordings begin, which is simulated alone.

Errors grow with time where a motion gets out of step, and on the ground with every impact. A fit to
all of a recording at once then settles where its end happens to be least wrong.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.fit import Fit
from pup.diagnosis.fitting import fit_together, start_best
from pup.diagnosis.replays import Replays
from pup.diagnosis.residuals import Noise
from pup.recording import Recording
from pup.recording_rules import MAX_TICK

HORIZONS = (1.0, 2.5)
"""Seconds of each recording that a first fit is made to, then a second one: with all of it at once,
a start whose motion gets out of step settles anywhere."""
LONG = 40
"""Steps that these first fits may take, which cost little."""
SPARE = 0.02
"""Share of the noise that a fit may leave beyond it and count as near."""


def begun(fits: Sequence[Fit], replays: Replays, noise: Noise) -> None:
    """Fits brought near by how the recordings begin."""
    measured = replays.measured
    for horizon in HORIZONS:
        inside = measured.time < horizon
        ready = all(_under_way(r, horizon) for r in measured.recordings)
        if ready and inside.any() and not inside.all():
            part = replays.shortened(horizon)
            moved(fits, part, noise, inside)
            replays.simulated += round(inside.mean() * part.simulated)


def _under_way(recording: Recording, until: float) -> bool:
    """Whether a recording has begun by then: a log may pause after its first rows."""
    elapsed = recording.time - recording.time[0]
    ticks = np.diff(elapsed[elapsed < until])
    return len(ticks) > 0 and float(np.median(ticks)) <= MAX_TICK


def moved(fits: Sequence[Fit], replays: Replays, noise: Noise, part: NDArray[np.bool_]) -> None:
    """Fits that begin where others of theirs have ended, on the part that is replayed."""
    others = [
        Fit(
            fit.coordinates,
            fit.at,
            fixed=fit.fixed,
            slack=fit.slack,
            data=None if (d := fit.data) is None else d[part],
        )
        for fit in fits
    ]
    fit_together(others, replays, noise, LONG)
    for fit, found in zip(fits, others, strict=True):
        fit.at = found.at


def nearer(fits: Sequence[Fit], replays: Replays, noise: Noise) -> None:
    """Begin fits anew where the beginnings of recordings lead, if that is better for all of them.

    Contact ends a fit in many a place: on the ground one with the right effect stops at several
    times the noise, and its rivals nearer. What hangs finds the way, and what is noise alone stays.

    Args:
      fits: changed in place, each with its residual.
      replays: simulates.
      noise: weighs the samples.
    """
    ground = any(r.support == "ground" for r in replays.measured.recordings)
    far = [fit for fit in fits if ground and not noise_like(fit)]
    if not far:
        return
    others = [fit.fresh() for fit in far]
    begun(others, replays, noise)
    before = [fit.chi2 for fit in far]
    start_best(far, [[other.at] for other in others], replays, noise)
    for fit, chi2 in zip(far, before, strict=True):
        if fit.chi2 < chi2:
            fit.jacobian, fit.done, fit.stuck, fit.damping = None, False, 0, Fit.damping


def noise_like(fit: Fit) -> bool:
    """Whether a fit leaves no more than noise: then it has not stopped short by much."""
    assert fit.residual is not None
    return fit.chi2 <= (1 + SPARE) * len(fit.residual)
