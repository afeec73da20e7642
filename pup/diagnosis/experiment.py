"""What to record next: the motion under which rival explanations would differ most.

Each rival, with the parameters it was fitted with, is simulated under everything the robot could be
asked to do. What one rival's parameters could still change to look like another, given all that was
recorded so far, is taken out; what is left, in units of the noise, is the evidence to be expected.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.coordinates import term_coordinate
from pup.diagnosis.fit import Fit
from pup.diagnosis.fitting import complete, difference, fit_together
from pup.diagnosis.laws import WORDS, contract_name
from pup.diagnosis.menu import CHANGED, SCRIPTS, Option, options
from pup.diagnosis.models import Round
from pup.diagnosis.replays import Replays, Row
from pup.diagnosis.residuals import Measured, Noise
from pup.diagnosis.selection import Selector
from pup.diagnosis.verdict import Finding
from pup.physics.terms import Place, split_column
from pup.robot import RobotDescription

Array = NDArray[np.float64]

SPLITS = 10.0
"""Expected difference of chi-squared that tells two rivals apart."""
AMPLE = 30.0
"""A difference of so much is of half the use of any larger one."""
EFFORT = 0.9
"""An option that asks for a change beside the motion is worth this share of one that does not."""
MOST = 5
"""Rivals that are looked at."""
FLOOR_KINDS = ("ground", "foot")


@dataclass(frozen=True, eq=False)
class Rival:
    """One explanation among several.

    Attributes:
      effect: its effect.
      place: where.
      probability: its probability.
      fit: the model with it, fitted, with its Jacobian.
    """

    effect: str
    place: Place
    probability: float
    fit: Fit

    def __str__(self) -> str:
        where = f" at {self.place.name}" if self.place.name else ""
        return f"{WORDS.get(self.effect, self.effect)}{where}"


@dataclass(frozen=True)
class Pair:
    """Two rivals and the difference of chi-squared to be expected between them."""

    first: str
    second: str
    expected: float


@dataclass(frozen=True)
class NextRecording:
    """The recording that would tell most.

    Attributes:
      motion: type of the motion.
      words: what to do.
      support: of the robot.
      setup: knobs that are to differ from their defaults.
      other_floor: whether it is to be done on another floor.
      reason: why, in words.
      splits: effects that it would tell apart.
    """

    motion: str
    words: str
    support: str
    setup: Mapping[str, float]
    other_floor: bool
    reason: str
    splits: tuple[Pair, ...]

    def document(self) -> dict[str, Any]:
        """As in docs/diagnosis.md."""
        named = [(contract_name(pair.first), contract_name(pair.second)) for pair in self.splits]
        pairs = dict.fromkeys(named)
        return {
            "motion": self.motion,
            "reason": self.reason,
            "splits": [list(pair) for pair in pairs],
        }


def rivals_of(finding: Finding, chosen: Round, selector: Selector) -> list[Rival]:
    """A finding and its equivalents, each fitted.

    Args:
      finding: from the round.
      chosen: the round that found it.
      selector: knows the replays and the noise.
    """
    known = {(e.effect, e.place): e.probability for e in finding.equivalents}
    known[finding.effect, finding.place] = finding.probability
    found: dict[tuple[str, Place], Rival] = {}
    for model in chosen.finalists:
        key = model.hypotheses[-1].key
        if key in known:
            found.setdefault(key, Rival(*key, known[key], model.fit))
    for other in finding.equivalents:
        if (other.effect, other.place) not in found:
            fit = _refitted(other.effect, other.place, chosen, selector)
            if fit is not None:
                key = other.effect, other.place
                found[key] = Rival(*key, other.probability, fit)
    return sorted(found.values(), key=lambda rival: -rival.probability)[:MOST]


def _refitted(effect: str, place: Place, chosen: Round, selector: Selector) -> Fit | None:
    """A fit of an effect that leaves the same trace as one that was refitted."""
    before = chosen.before.fit
    for score in chosen.ranking:
        hypothesis = score.trace.hypothesis
        if hypothesis.key != (effect, place):
            continue
        free = tuple(term_coordinate(name, hypothesis.scale) for name in hypothesis.magnitudes)
        low, high = ([getattr(c, end) for c in free] for end in ("lower", "upper"))
        at = np.r_[before.at, np.clip(score.sizes, low, high)]
        fixed = {**before.fixed, **dict(hypothesis.shape)}
        fit = Fit(before.coordinates + free, at, fixed=fixed)
        fit_together([fit], selector.replays, selector.noise, iterations=4)
        complete([fit], selector.replays, selector.noise)
        return fit
    return None


def next_recording(
    robot: RobotDescription,
    rivals: Sequence[Rival],
    noise: Noise,
    factory: Callable[[Measured], Replays],
    seed: int = 0,
) -> NextRecording | None:
    """Choose what would tell rivals apart; None where nothing would, or there are none.

    Args:
      robot: the robot.
      rivals: explanations of what was recorded, fitted to it, with their Jacobians.
      noise: of the channels, as found so far.
      factory: replays of other recordings.
      seed: of the motions.
    """
    if len(rivals) < 2:
        return None
    menu = options(robot, seed)
    on_floor = any(rival.place.kind in FLOOR_KINDS for rival in rivals)
    best: tuple[float, Option, list[Pair]] | None = None
    for other_floor in (False, True) if on_floor else (False,):
        offered = [option for option in menu if option.other_floor == other_floor]
        if not offered:
            continue
        measured = Measured.of(robot, [option.recording for option in offered])
        answers = _answers(rivals, noise, factory(measured), other_floor)
        for number, option in enumerate(offered):
            pairs = _pairs(rivals, answers, measured.recording == number)
            worth = sum(
                a.probability * b.probability * pair.expected / (pair.expected + AMPLE)
                for (a, b), pair in zip(combinations(rivals, 2), pairs, strict=True)
            )
            worth *= 1.0 if option.plain else EFFORT
            if best is None or worth > best[0]:
                best = worth, option, pairs
    if best is None:
        return None
    _, option, expected = best
    splits = tuple(pair for pair in expected if pair.expected > SPLITS)
    return _told(option, rivals, splits, expected) if splits else None


def recorded_again(measured: Measured, cure: str) -> NextRecording:
    """The same motions once more, where these recordings of them can show nothing.

    Args:
      measured: what was recorded.
      cure: what to do about it.
    """
    first = measured.recordings[0]
    words = f"the same motions again, {cure}"
    return NextRecording(first.motion, words, first.support, {}, False, words, ())


def recorded_besides(measured: Measured, seed: int = 0) -> NextRecording:
    """A motion of another type, where those recorded do not tell; the least effort there is.

    Args:
      measured: what was recorded.
      seed: of the motion.
    """
    menu = [o for o in options(measured.robot, seed) if o.plain]
    well = {SCRIPTS[kind] for kind in CHANGED}  # the smallest steps hardly move a joint
    menu.sort(key=lambda option: option.words not in well)
    known = measured.motions()
    option = next((o for o in menu if o.recording.motion not in known), menu[0])
    reason = f"{option.words}, beside what was recorded, would move the joints in another way"
    return NextRecording(
        option.recording.motion, option.words, option.recording.support, {}, False, reason, ()
    )


def _told(
    option: Option, rivals: Sequence[Rival], splits: Sequence[Pair], expected: Sequence[Pair]
) -> NextRecording:
    names = list(combinations(rivals, 2))
    parts = [
        f"{a} from {b} (chi-squared would differ by {pair.expected:.0f})"
        for (a, b), pair in zip(names, expected, strict=True)
        if pair.expected > SPLITS
    ]
    return NextRecording(
        option.recording.motion,
        option.words,
        option.recording.support,
        dict(option.setup),
        option.other_floor,
        f"{option.words} would tell {'; '.join(parts)}",
        tuple(splits),
    )


def _pairs(
    rivals: Sequence[Rival], answers: Sequence["_Answer"], inside: NDArray[np.bool_]
) -> list[Pair]:
    """What some samples would tell of each pair of rivals, whichever of the two is right."""
    told = []
    for (a, one), (b, other) in combinations(zip(rivals, answers, strict=True), 2):
        ways = _separation(one, other, b.fit, inside), _separation(other, one, a.fit, inside)
        told.append(Pair(a.effect, b.effect, min(ways)))
    return told


def _separation(truth: "_Answer", other: "_Answer", fit: Fit, inside: NDArray[np.bool_]) -> float:
    """Chi-squared that is left when another rival is fitted to what one would do.

    Args:
      truth: what would be measured.
      other: what the other rival says, and how that changes with its parameters.
      fit: the other's, to all that was recorded so far.
      inside: the samples of the new recording.
    """
    apart = (truth.samples - other.samples)[inside]
    jacobian = other.jacobian[inside]
    if not (np.isfinite(apart).all() and np.isfinite(jacobian).all()):
        return 0.0
    known = np.linalg.inv(fit.covariance())
    match = jacobian.T @ apart
    taken = match @ np.linalg.solve(known + jacobian.T @ jacobian, match)
    return max(float(apart @ apart - taken), 0.0)


@dataclass(frozen=True, eq=False)
class _Answer:
    """What a rival says of the new recordings, whitened.

    Attributes:
      samples: shape (n_samples,).
      jacobian: by the coordinates of its fit, shape (n_samples, n_free).
    """

    samples: Array
    jacobian: Array


def _answers(
    rivals: Sequence[Rival], noise: Noise, replays: Replays, other_floor: bool
) -> list[_Answer]:
    """All rivals, in one replay; what nominal parameters do is the same for all."""
    rows: list[Row] = [_on(rival.fit.row(), other_floor) for rival in rivals]
    moves: dict[tuple[str, int], tuple[int, float]] = {}
    for number, rival in enumerate(rivals):
        for i, coordinate in enumerate(rival.fit.coordinates):
            owner = number if "@" in coordinate.name else 0
            if (coordinate.name, owner) in moves:
                continue
            at = rival.fit.at.copy()
            at[i] += difference(rival.fit, i, at, rival.fit.width)
            moves[coordinate.name, owner] = len(rows), at[i] - rival.fit.at[i]
            rows.append(_on(rival.fit.row(at), other_floor))
    white = replays.measured.whiten(replays(rows), noise)
    told = []
    for number, rival in enumerate(rivals):
        columns = []
        for name in rival.fit.names:
            owner = number if "@" in name else 0
            row, step = moves[name, owner]
            columns.append((white[row] - white[owner]) / step)
        told.append(_Answer(white[number], np.stack(columns, axis=1)))
    return told


def _on(row: Row, other_floor: bool) -> Row:
    """A candidate on the floor of the recordings, or on another, which lacks that one's ways."""
    if not other_floor:
        return row
    told = {name: split_column(name) for name in row}
    return {n: v for n, v in row.items() if (t := told[n]) is None or t[2].kind not in FLOOR_KINDS}
