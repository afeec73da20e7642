"""Figures of what a model lacks: torques over time, their ranking, parameters of two halves."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.ticker import FixedLocator, MaxNLocator, NullLocator
from numpy.typing import NDArray

from pup.diagnosis.figures import AFTER, BEFORE, name_rows
from pup.sysid.figures import AMBER, GREEN, INK, PALE, ROW, SOFT, WIDTH, as_svg, new_figure
from pup.sysid.html import Drawing
from pup.sysid.overlays import DOTTED, LINE_WIDTH

Array = NDArray[np.float64]
Interval = tuple[float, float, float]
"""A value with the ends of its interval."""

TORQUE = GREEN
"""Colour of a missing torque, in every figure."""
FURTHEST = 8.0
"""Ratios farther from 1 leave the picture."""
NEAREST = 1.1
"""The picture of ratios reaches at least so far from 1."""
WIDE = 2.5
"""Even steps are no good for an axis whose ends differ by a larger factor; ..."""
TICKS = (0.15, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0, 7.0)
"""... it has these."""


@dataclass(frozen=True)
class Pushed:
    """A missing torque over a window, ready to be drawn.

    Attributes:
      time: of the knots, s.
      mean: most probable torque.
      reach: half of its 90 % band.
      unit: of the torque.
      readings: times and positions of the joint; None for the torso.
      command: times and goals of the joint; None for the torso.
      position: unit of the positions.
    """

    time: Array
    mean: Array
    reach: Array
    unit: str
    readings: tuple[Array, Array] | None
    command: tuple[Array, Array] | None
    position: str


def torque_window(pushed: Pushed) -> Drawing:
    """A missing torque with its band, beneath the motion of its joint."""
    both = pushed.readings is not None
    figure = new_figure(3.3, 2.9 if both else 1.9)
    rows = figure.subplots(1 + both, 1, sharex=True, squeeze=False)[:, 0]
    for axes in rows:
        axes.grid()
    below = rows[-1]
    below.axhline(0, color=SOFT, linewidth=0.8)
    low, high = pushed.mean - pushed.reach, pushed.mean + pushed.reach
    below.fill_between(pushed.time, low, high, color=TORQUE, alpha=0.22, linewidth=0)
    below.plot(pushed.time, pushed.mean, color=TORQUE, linewidth=LINE_WIDTH)
    below.set_xlim(pushed.time[0], pushed.time[-1])
    below.set_xlabel("time [s]")
    below.set_ylabel(f"missing [{pushed.unit}]")
    if both:
        _motion(rows[0], pushed)
        figure.align_ylabels()
    return as_svg(figure)


def _motion(axes: Any, pushed: Pushed) -> None:
    assert pushed.readings is not None and pushed.command is not None
    few = len(pushed.readings[0]) <= DOTTED
    dots = {"marker": "." if few else "", "linestyle": "" if few else "-", "markersize": 4}
    axes.plot(*pushed.command, color=SOFT, linewidth=0.8, drawstyle="steps-post")
    axes.plot(*pushed.readings, color=INK, linewidth=LINE_WIDTH, **dots)
    axes.set_ylabel(f"position [{pushed.position}]")


def torque_ranking(
    names: Sequence[str],
    evidence: Array,
    strength: Array,
    labels: Sequence[str],
    unit: str,
    enough: float,
) -> Drawing:
    """Evidence for a torque at each joint, and how strong it is.

    Args:
      names: of the joints.
      evidence: natural logarithm of odds.
      strength: of the torques.
      labels: what stands beside each strength.
      unit: of the strengths.
      enough: evidence that is beyond doubt.
    """
    figure = new_figure(WIDTH + 0.3, 0.75 + 0.24 * max(len(names), 2))
    left, right = figure.subplots(1, 2, sharey=True)
    colours = [AMBER if e > enough else PALE for e in evidence]
    left.barh(range(len(names)), evidence, 0.7, color=colours)
    left.axvline(enough, color=INK, linewidth=1.2, linestyle="--")
    left.set_xscale("log")
    left.set_xlim(0.5 * min(float(evidence.min()), enough), 1.5 * max(evidence.max(), enough))
    left.xaxis.set_major_formatter("{x:,.0f}")
    left.set_xlabel("evidence (right of the line: sure)")
    right.barh(range(len(names)), strength, 0.7, color=TORQUE)
    for y, (value, label) in enumerate(zip(strength, labels, strict=True)):
        right.annotate(
            label, (value, y), xytext=(3, 0), textcoords="offset points", va="center", fontsize=7.5
        )
    right.set_xlim(0, 1.6 * float(strength.max()))
    right.locator_params(axis="x", nbins=4)
    right.set_xlabel(f"typical strength [{unit}]")
    for axes in (left, right):
        axes.grid(axis="x")
    name_rows(left, names)
    right.tick_params(axis="y", length=0, labelleft=False)
    return as_svg(figure)


def ratio_dots(
    names: Sequence[str], before: Sequence[Interval], after: Sequence[Interval | None]
) -> Drawing:
    """Parameters of one half of the data over those of the other, with their intervals.

    Args:
      names: of parameters and halves.
      before: ratios by the nominal model.
      after: ratios by the corrected one; None where there is none.
    """
    figure = new_figure(WIDTH + 0.3, 1.05 + 1.1 * ROW * len(names))
    axes = figure.subplots()
    axes.axvline(1, color=INK, linewidth=1)
    drawn = [("nominal model", BEFORE, "o", list(enumerate(before)))]
    known = [(i, told) for i, told in enumerate(after) if told is not None]
    if known:
        drawn.append(("with what was found", AFTER, "D", known))
    for shift, (label, colour, marker, told) in zip((-0.16, 0.16), drawn, strict=False):
        at = np.array([i for i, _ in told]) + (shift if len(drawn) > 1 else 0.0)
        value, low, high = np.array([interval for _, interval in told]).T
        axes.hlines(at, low, high, color=colour, linewidth=1.8)
        axes.plot(value, at, marker, color=colour, markersize=5, label=label)
    _ratio_axis(axes, [*before, *(told for _, told in known)])
    name_rows(axes, names)
    figure.legend(loc="outside upper left", ncols=2, fontsize=8)
    return as_svg(figure)


def _ratio_axis(axes: Any, drawn: Sequence[Interval]) -> None:
    """A logarithmic axis, so that twice and half are as far from 1."""
    ends = np.array(drawn)[:, 1:]
    low = max(min(float(ends.min()), 1 / NEAREST), 1 / FURTHEST)
    high = min(max(float(ends.max()), NEAREST), FURTHEST)
    axes.set_xscale("log")
    axes.set_xlim(low / 1.05, high * 1.05)
    wide = high / low > WIDE
    even = MaxNLocator(6, steps=(1, 2, 5, 10))
    axes.xaxis.set_major_locator(FixedLocator(TICKS) if wide else even)
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set_xlabel("ratio of the two halves (1: no difference)")
    axes.grid(axis="x")
