"""The section of the report on parameters that differ between halves of the data."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from pup.diagnosis import summary
from pup.diagnosis.figures_missing import FURTHEST, Interval, ratio_dots
from pup.diagnosis.result import Diagnosis
from pup.diagnosis.splits import Ratio, Split
from pup.diagnosis.wording import Speech, digits, parameter_words, percent, spoken
from pup.sysid.html import Html, figure, tag
from pup.sysid.wording import counted

LEVEL = 0.01
"""Chance that a right model shows any split at all."""
SURE = 3.0
"""A parameter that differs by fewer standard deviations is not told of, ..."""
WORTH = 0.05
"""... nor one that differs by a smaller share."""
CLOSED = 0.25
"""A difference is gone if less than this share of it is left, as a logarithm."""
ROWS = 16
"""Differences that are drawn, at most."""
TOLD = 4
"""Differences told in sentences."""
TWICE = 1.5
"""A larger ratio is told as a multiple, a smaller one in per cent."""
_HALVES = {
    "on the ground": ("ground / air", "on the ground", "in the air"),
    "fast": ("fast / slow", "in fast motion", "in slow"),
    "slow": ("slow / fast", "in slow motion", "in fast"),
    "in the air": ("air / ground", "in the air", "on the ground"),
    "loaded": ("high / low torque", "in recordings of high torque", "in those of low torque"),
    "unloaded": ("low / high torque", "in recordings of low torque", "in those of high torque"),
    "late": ("late / early", "late in a recording", "early in it"),
    "early": ("early / late", "early in a recording", "late in it"),
}
"""By the half that comes first: both in a label, and each in a sentence."""


@dataclass(frozen=True)
class Gap:
    """A parameter that differs between two halves of the data.

    Attributes:
      group: of the joints.
      first: one half.
      second: the other.
      before: ratio by the nominal model.
      after: by the model with what was found; None where nothing was added to it.
    """

    group: str
    first: str
    second: str
    before: Ratio
    after: Ratio | None

    @property
    def closed(self) -> bool:
        """Whether what was found explains the difference."""
        if self.after is None:
            return False
        left = abs(np.log(self.after.value)) <= CLOSED * abs(np.log(self.before.value))
        return bool(left or self.after.lower <= 1 <= self.after.upper)


def found_gaps(before: Sequence[Split], after: Sequence[Split]) -> list[Gap]:
    """Parameters that differ by the nominal model, the surest first.

    A split counts if chance makes none as large among all that were looked at, and if simulations
    with two sets of parameters bear it out.

    Args:
      before: splits by the nominal model.
      after: the same by the corrected one; empty where there is none.
    """
    level = LEVEL / max(len(before), 1)
    closing = {split.key: split for split in after}
    told = []
    for split in before:
        enough = float(stats.chi2.isf(level, len(split.ratios)))
        if split.chance > level or split.gained is None or split.gained < enough:
            continue
        other = closing.get(split.key)
        afterwards = {r.parameter: r for r in other.ratios} if other else {}
        told += [
            Gap(split.group, split.first, split.second, r, afterwards.get(r.parameter))
            for r in split.ratios
            if abs(r.surprise) > SURE and abs(np.log(r.value)) > WORTH
        ]
    return sorted(told, key=lambda gap: -abs(gap.before.surprise))


def gaps(diagnosis: Diagnosis, speech: Speech) -> Iterator[Html]:
    """Parameters that differ, before and after what was found was added."""
    before, after = diagnosis.splits
    if not before:
        return
    yield tag(
        "p",
        "Under a right model a servo's gains and its torque limit are the same on the ground and "
        "in the air, fast and slow, loaded and not. Where halves of the data ask for different "
        "values, a mechanism is missing; with it in the model, the values come together.",
    )
    told = found_gaps(before, after if summary.corrected(diagnosis) else ())
    if not told:
        yield tag(
            "p",
            f"None of {counted(len(before), 'comparison')} of halves shows a difference that is "
            "more than chance: if the simulator lacks something, it acts alike in all of them.",
        )
        return
    takeaway = _takeaway(told)
    yield tag("p", takeaway)
    shown = told[:ROWS]
    few = f" The {ROWS} surest of {len(told)}." if len(told) > ROWS else ""
    if any(_outside(gap.before) or (gap.after and _outside(gap.after)) for gap in shown):
        few += f" Dots beyond {FURTHEST:g} to 1 are outside the picture."
    yield figure(
        ratio_dots(
            [_label(gap) for gap in shown],
            [_interval(gap.before) for gap in shown],
            [_interval(gap.after) if gap.after else None for gap in shown],
        ),
        f"Ratios of parameters between halves of the data. {takeaway}",
        f"Each dot with its 90 % interval; on the line, the halves agree.{few}",
    )
    yield tag("ul", *(tag("li", sentence(gap)) for gap in told[:TOLD]))


def sentence(gap: Gap) -> str:
    """A difference in words, told so that the ratio is above 1."""
    before, after = gap.before, gap.after
    first, second = gap.first, gap.second
    if before.value < 1:
        first, second = second, first
        before, after = _inverse(before), _inverse(after) if after else None
    _, here, there = _words(first, second)
    name = f"The {parameter_words(f'{before.parameter}/{gap.group}')}"
    more = (
        f"{digits(before.value, 3)} times as large {here} as {there}"
        if before.value > TWICE
        else f"{percent(before.value - 1)} larger {here} than {there}"
    )
    text = f"{name} is {more} (90 % interval of the ratio {_range(before)})"
    if after is None:
        return f"{text}."
    return f"{text}; with what was found, the ratio is {_told(after.value)} ({_range(after)})."


def _takeaway(told: Sequence[Gap]) -> str:
    """How many differences there are, and how many what was found has closed."""
    found = f"{counted(len(told), 'difference')} between halves of the data"
    if all(gap.after is None for gap in told):
        return f"{found}."
    still = sum(not gap.closed for gap in told)
    left = f"{still or 'none'} {'are' if still > 1 else 'is'} left"
    return f"{found}; with what was found in the model, {left}."


def _words(first: str, second: str) -> tuple[str, str, str]:
    return _HALVES.get(first, (f"{first} / {second}", first, second))


def _label(gap: Gap) -> str:
    halves, _, _ = _words(gap.first, gap.second)
    return f"{spoken(gap.group)} {gap.before.parameter}, {halves}"


def _interval(ratio: Ratio) -> Interval:
    return ratio.value, ratio.lower, ratio.upper


def _outside(ratio: Ratio) -> bool:
    return not 1 / FURTHEST <= ratio.value <= FURTHEST


def _range(ratio: Ratio) -> str:
    return f"{_told(ratio.lower)} to {_told(ratio.upper)}"


def _told(value: float) -> str:
    return f"{value:.2f}" if value < 10 else f"{value:,.0f}"


def _inverse(ratio: Ratio) -> Ratio:
    """The second half over the first."""
    return Ratio(
        ratio.parameter, 1 / ratio.value, 1 / ratio.upper, 1 / ratio.lower, -ratio.surprise
    )
