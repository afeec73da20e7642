"""Numbers that the report of a diagnosis draws: maps of errors, rankings, masking, what is hidden.

Errors are those of whitened residuals: noise alone has a root mean square of 1.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.evidence import Score, Trace, overlap, scores, unimitated
from pup.diagnosis.fit import Fit
from pup.diagnosis.gains import MATERIAL
from pup.diagnosis.laws import NAMELESS
from pup.diagnosis.models import Model, Round
from pup.diagnosis.regimes import Window, windows
from pup.diagnosis.result import Diagnosis
from pup.diagnosis.selection import KEPT
from pup.diagnosis.verdict import WORTH_SAYING, Finding, probabilities
from pup.physics.terms import Place
from pup.recording import originals

Array = NDArray[np.float64]

FEWEST = 8
"""Samples below which a cell of a map stays empty."""
SAME = 0.99
"""A finalist that explains this share of what the best one does predicts as well."""
ALIKE = 0.8
"""Overlap from which traces are told to be alike."""
POWER = 1.28
"""An effect this many standard deviations above the threshold is found nine times in ten."""
LONGEST = 4.0
"""A window is shown for at most as long, s."""
BETTER = 0.1
"""A window tells of a finding if the correction lowers its error by this share."""
AROUND = 0.4
"""Shown before and after a window, s."""


@dataclass(frozen=True)
class View:
    """One channel of one recording over a stretch of time.

    Attributes:
      window: what is told of.
      channel: which one is shown.
      start: of what is shown, s.
      end: of it.
    """

    window: Window
    channel: int
    start: float
    end: float


@dataclass(frozen=True)
class Rival:
    """A finalist of a round, as compared with the model before it.

    Attributes:
      score: what the score test said of it.
      model: the model refitted.
      inside: drop of chi-squared on what it was fitted to.
      outside: drop on motions left out.
      probability: of it among the finalists.
      holds: whether it might have been added.
    """

    score: Score
    model: Model
    inside: float
    outside: float
    probability: float
    holds: bool


def channels(diagnosis: Diagnosis) -> list[int]:
    """The channels that were read."""
    return [int(c) for c in np.unique(diagnosis.measured.channel)]


def misfit(diagnosis: Diagnosis, fit: Fit, chosen: NDArray[np.bool_]) -> float:
    """Error of some samples in units of the noise; NaN where there are too few of them."""
    assert fit.residual is not None
    if chosen.sum() < FEWEST:
        return float("nan")
    return float(np.sqrt(np.mean(fit.residual[chosen] ** 2)))


def by_regime(diagnosis: Diagnosis, fit: Fit) -> tuple[list[str], Array]:
    """Names of regimes, and errors of shape (n_channels, n_regimes) in units of the noise."""
    of = diagnosis.measured.channel
    everything = np.ones(len(of), dtype=bool)
    columns = [("overall", everything), *((r.name, r.inside) for r in diagnosis.regimes)]
    rows = [
        [
            misfit(diagnosis, fit, (diagnosis.measured.channel == c) & inside)
            for _, inside in columns
        ]
        for c in channels(diagnosis)
    ]
    return [name for name, _ in columns], np.array(rows).reshape(-1, len(columns))


def by_time(diagnosis: Diagnosis, fit: Fit, recording: int, most: int) -> tuple[Array, Array]:
    """Edges of bins, s, and errors of one recording, shape (n_channels, n_bins).

    Args:
      diagnosis: its samples.
      fit: whose errors.
      recording: its number.
      most: bins, at most; fewer where readings are.
    """
    assert fit.residual is not None
    measured = diagnosis.measured
    inside = measured.recording == recording
    readings = int(np.bincount(measured.channel[inside], minlength=1).max())
    bins = int(np.clip(readings // 2, 1, most))
    edges = np.linspace(0.0, float(measured.time[inside].max(initial=0.1)), bins + 1)
    rows = []
    for channel in channels(diagnosis):
        chosen = inside & (measured.channel == channel)
        at, squares = measured.time[chosen], fit.residual[chosen] ** 2
        count = np.histogram(at, edges)[0]
        total = np.histogram(at, edges, weights=squares)[0]
        rows.append(np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan))
    return edges, np.array(rows)


def described(diagnosis: Diagnosis, finding: Finding) -> float:
    """What a finding explains of all that is more than noise without it, as a share."""
    assert diagnosis.model is not None
    excess = diagnosis.model.fit.chi2 + finding.gain - diagnosis.model.samples
    return float(np.clip(finding.gain / max(excess, finding.gain, 1e-300), 0.0, 1.0))


def left_over(diagnosis: Diagnosis, model: Model) -> float:
    """Error of a model on motions left out, in units of the noise."""
    return float(np.sqrt(np.mean(_squares(diagnosis, model))))


def smallest_material(diagnosis: Diagnosis) -> float:
    """An effect that explains a smaller error than this would not have been told of, rad."""
    sigma = joint_noise(diagnosis)
    return sigma * max(MATERIAL, float(np.sqrt(diagnosis.enough / len(diagnosis.measured.values))))


def corrected(diagnosis: Diagnosis) -> bool:
    """Whether anything was added to the nominal model: a cause without a law adds nothing."""
    model, left = diagnosis.model, diagnosis.unexplained
    return model is not None and bool(model.hypotheses or (left is not None and left.terms))


def models(diagnosis: Diagnosis) -> dict[str, Model]:
    """The `nominal` and the `corrected` model, as far as there are such."""
    told: dict[str, Model] = {}
    if diagnosis.model is None:
        return told
    if diagnosis.before is not None:
        told["nominal"] = diagnosis.before
    told["corrected" if corrected(diagnosis) else "nominal"] = diagnosis.model
    return told


def limits(diagnosis: Diagnosis) -> Array:
    """Largest torque of each joint's servo by the nominal fit, N m; NaN where none is known."""
    robot = diagnosis.robot
    known = {p.name: p.nominal for p in robot.parameters} | diagnosis.nominal.fit.values
    return np.array([known.get(f"tau_max/{joint.group}", np.nan) for joint in robot.joints])


def joint_noise(diagnosis: Diagnosis) -> float:
    """Noise of the joints that were read, root mean square, rad."""
    joints = len(diagnosis.robot.joints)
    return _noise(diagnosis, [c for c in channels(diagnosis) if c < joints])


def tilt_noise(diagnosis: Diagnosis) -> float:
    """Noise of the torso's roll and pitch where they were read, root mean square, rad."""
    joints = len(diagnosis.robot.joints)
    return _noise(diagnosis, [c for c in channels(diagnosis) if c >= joints])


def _noise(diagnosis: Diagnosis, some: Sequence[int]) -> float:
    return float(np.sqrt(np.mean(diagnosis.noise.sigma[some] ** 2))) if some else float("nan")


def first_ranking(diagnosis: Diagnosis) -> Sequence[Score]:
    """What the score test says of the nominal fit's errors, best first."""
    if diagnosis.rounds:
        return diagnosis.rounds[0].ranking
    fit = diagnosis.nominal.fit
    if not diagnosis.found or fit.jacobian is None or fit.residual is None:
        return ()
    return scores(diagnosis.found, unimitated(fit))


def distinct(ranking: Sequence[Score], most: int) -> list[Score]:
    """The best score of each effect and place."""
    best: dict[object, Score] = {}
    for score in ranking:
        best.setdefault(score.trace.hypothesis.key, score)
    return list(best.values())[:most]


def rivals(chosen: Round, diagnosis: Diagnosis) -> list[Rival]:
    """The finalists of a round, best first."""
    if not chosen.finalists:
        return []
    told = {score.trace.hypothesis: score for score in chosen.ranking}
    likely = chosen.finalists[: chosen.holding or None]
    chances = np.zeros(len(chosen.finalists))
    chances[: len(likely)] = probabilities(likely, chosen.before, diagnosis.noise)
    return [
        Rival(
            told[model.hypotheses[-1]],
            model,
            chosen.before.fit.chi2 - model.fit.chi2,
            float((chosen.before.held_out - model.held_out).sum()),
            float(chance),
            number < len(likely),
        )
        for number, (model, chance) in enumerate(zip(chosen.finalists, chances, strict=True))
    ]


def why_behind(rival: Rival, best: Rival) -> str:
    """Why a finalist fell behind the best."""
    same = overlap(rival.score.trace, best.score.trace)
    if rival.outside <= KEPT * rival.inside:
        return "fits these motions but does not predict others"
    if not rival.holds:
        return "explains too little of what is left to be more than a wrong form of the others"
    if rival.probability >= WORTH_SAYING and same >= ALIKE:
        return f"hardly to be told apart: {100 * same:.0f} % the same trace"
    if rival.probability >= WORTH_SAYING:
        return "explains about as much"
    if rival.outside >= SAME * best.outside:
        return "predicts as well, but fits worse or needs more free numbers"
    return f"explains {100 * (1 - rival.outside / best.outside):.0f} % less of motions left out"


def why_rejected(chosen: Round, diagnosis: Diagnosis) -> str:
    """Why even the best finalist of a round was not added."""
    told = rivals(chosen, diagnosis)
    if not told:
        return "refitted, none of them lowers the error by more than chance does"
    if told[0].outside <= KEPT * told[0].inside:
        return "its gain does not carry over to motions left out of the fit"
    return "it is too small to matter"


def imitation(trace: Trace, fit: Fit, sizes: Array) -> tuple[float, Array]:
    """How nominal parameters imitate an effect of some size.

    Args:
      trace: the effect's.
      fit: the nominal fit.
      sizes: the effect's magnitudes, in typical sizes.

    Returns:
      The share of the effect that is hidden so, and the relative change of each parameter.
    """
    whole, left = trace.whole @ sizes, trace.left @ sizes
    moved = np.zeros(len(fit.at))
    moved[fit.movable] = np.linalg.lstsq(fit.slopes, whole, rcond=1e-6)[0]
    hidden = 1 - float(np.linalg.norm(left)) / max(float(np.linalg.norm(whole)), 1e-300)
    return hidden, np.expm1(np.clip(moved, -3.0, 3.0))


def overlaps(ranking: Sequence[Score]) -> Array:
    """How alike the traces are, shape (n, n), 0 to 1."""
    return np.array([[overlap(a.trace, b.trace) for b in ranking] for a in ranking])


def smallest_seen(trace: Trace, enough: float) -> float:
    """The size of an effect that would be found nine times in ten, in typical sizes."""
    lengths = np.linalg.norm(trace.left, axis=0)
    return float((np.sqrt(enough) + POWER) / max(float(lengths.max()), 1e-12))


def hardest(diagnosis: Diagnosis) -> list[tuple[Trace, float]]:
    """Of each effect, the place where it could hide best, and up to which size; worst first."""
    worst: dict[str, tuple[Trace, float]] = {}
    best: dict[object, tuple[Trace, float]] = {}
    for trace in diagnosis.found:
        size = smallest_seen(trace, diagnosis.enough)
        key = trace.hypothesis.key
        if key not in best or size < best[key][1]:
            best[key] = trace, size
    for trace, size in best.values():
        effect = trace.hypothesis.effect
        if effect not in worst or size > worst[effect][1]:
            worst[effect] = trace, size
    return sorted(worst.values(), key=lambda pair: -pair[1])


def telling(diagnosis: Diagnosis, finding: Finding, most: int) -> list[View]:
    """The windows that show a finding best."""
    both = models(diagnosis)
    allowed = _members(diagnosis, finding.place)
    nowhere = finding.effect == NAMELESS and finding.law is None
    if len(both) < 2 or nowhere:  # what stands in no model leaves only its errors to be shown
        errors = _squares(diagnosis, list(both.values())[-1])
        return _views(diagnosis, finding.when, errors, allowed)[:most]
    gain = _squares(diagnosis, both["nominal"]) - _squares(diagnosis, both["corrected"])
    views = _views(diagnosis, finding.when, gain, allowed)
    recordings = diagnosis.measured.recordings
    first = dict(zip([r.id for r in recordings], originals(recordings), strict=True))
    better: dict[object, View] = {}
    for view in views:
        if _drop(diagnosis, view) > BETTER:  # of repeats, one will do
            better.setdefault((first[view.window.recording], view.start), view)
    return (list(better.values()) or views[:1])[:most]


def _members(diagnosis: Diagnosis, place: Place) -> list[int]:
    """The joints of a place, or all channels where it has none of its own."""
    kinds = {"joint": "name", "group": "group"}
    if place.kind not in kinds:
        return channels(diagnosis)
    of = [getattr(joint, kinds[place.kind]) for joint in diagnosis.robot.joints]
    return [i for i, name in enumerate(of) if name == place.name]


def _drop(diagnosis: Diagnosis, view: View) -> float:
    """By which share the corrected model's error in a view is smaller."""
    measured, both = diagnosis.measured, models(diagnosis)
    inside = (measured.time >= view.start) & (measured.time <= view.end)
    inside &= measured.channel == view.channel
    inside &= np.array([r.id == view.window.recording for r in measured.recordings])[
        measured.recording
    ]
    before, after = (
        float(np.linalg.norm((measured.values - both[name].predicted)[inside]))
        for name in ("nominal", "corrected")
    )
    return 1 - after / max(before, 1e-300)


def worst(diagnosis: Diagnosis, most: int) -> list[View]:
    """The windows with the largest errors of the model."""
    assert diagnosis.model is not None
    errors = _squares(diagnosis, diagnosis.model)
    found = windows(diagnosis.measured, errors, most)
    return _views(diagnosis, found, errors, channels(diagnosis))


def _squares(diagnosis: Diagnosis, model: Model) -> Array:
    """Squared errors on motions left out, in units of the noise's variance."""
    measured = diagnosis.measured
    errors = (measured.values - model.predicted) / measured.deviation(diagnosis.noise)
    return np.asarray(errors**2)


def _views(
    diagnosis: Diagnosis, found: Sequence[Window], weight: Array, allowed: Sequence[int]
) -> list[View]:
    """Each window in the channel where most of a weight falls."""
    measured = diagnosis.measured
    names = [r.id for r in measured.recordings]
    views = []
    for window in found:
        inside = measured.recording == names.index(window.recording)
        inside &= (measured.time >= window.start) & (measured.time <= window.end)
        sums = [float(weight[inside & (measured.channel == c)].sum()) for c in allowed]
        start = max(window.start - AROUND, 0.0)
        end = min(window.end, window.start + LONGEST) + AROUND
        views.append(View(window, allowed[int(np.argmax(sums))], start, end))
    return views
