"""The figures of a diagnosis, in the look of pre-sysID's."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from numpy.typing import NDArray

from pup.sysid.figures import (
    AMBER,
    BLUE,
    INK,
    PALE,
    ROW,
    SOFT,
    VERMILLION,
    WIDTH,
    as_svg,
    new_figure,
)
from pup.sysid.html import Drawing
from pup.sysid.overlays import DOTTED, LINE_WIDTH

Array = NDArray[np.float64]

BEFORE, AFTER = VERMILLION, BLUE
COLOURS = {"nominal": BEFORE, "corrected": AFTER}
"""Colours of the nominal and of the corrected model, in every figure."""
MAP = matplotlib.colormaps["YlOrBr"]
SHARES = matplotlib.colormaps["Blues"]
CHANGES = matplotlib.colormaps["PuOr_r"]
MISFIT = "error in units of the noise (1: noise alone)"
CROWD = 12
"""Rows beyond which they stand closer."""
SHARP = 200
"""Resolution of pictures inside figures, dots per inch."""


def misfit_bar(figure: Any, axes: Any, norm: Any, height: float) -> None:
    """The key of a map of misfits, beneath axes of some height in inches."""
    bar = figure.colorbar(
        ScalarMappable(norm, MAP), ax=axes, orientation="horizontal", aspect=30, pad=0.12 / height,
        fraction=0.11 / (height + 0.11),
    )  # fmt: skip
    ticks = [t for t in (1, 2, 5, 10, 20, 50, 100, 200, 500) if t <= norm.vmax]
    bar.set_ticks(ticks, labels=[f"{t}" for t in ticks], minor=False)
    bar.set_ticks([], minor=True)
    bar.ax.tick_params(labelsize=8)
    bar.set_label(MISFIT, fontsize=8)
    bar.outline.set_visible(False)


def misfit_norm(values: Array) -> LogNorm:
    """Colours from noise alone to the largest error."""
    known = values[np.isfinite(values)]
    return LogNorm(1.0, max(5.0, float(known.max(initial=1.0))))


def error_bars(
    names: Sequence[str], pairs: Sequence[tuple[float, ...]], unit: str, noise: float
) -> Drawing:
    """Bars of held-out errors, before and after.

    Args:
      names: what they are of.
      pairs: errors of the nominal model, and of the corrected one where there is one.
      unit: of a thousandth of them, which is what is drawn.
      noise: the noise level, drawn as a line.
    """
    shown = ("nominal model", "corrected model")[: len(pairs[0])]
    thick = 0.8 / len(shown)
    crowd = 0.75 if len(names) > CROWD else 1.0
    figure = new_figure(WIDTH, 0.95 + crowd * (0.14 + 0.13 * len(shown)) * len(names))
    axes = figure.subplots()
    for i, (label, colour) in enumerate(zip(shown, (BEFORE, AFTER), strict=False)):
        at = np.arange(len(names)) - 0.4 + (i + 0.5) * thick
        values = [1000 * pair[i] for pair in pairs]
        axes.barh(at, values, 0.9 * thick, color=colour, label=label)
    if np.isfinite(noise):
        axes.axvline(1000 * noise, color=INK, linewidth=1, linestyle="--", label="noise alone")
    name_rows(axes, names)
    axes.set_xlim(0, 1.06 * max(1000 * max(max(p) for p in pairs), 1000 * np.nan_to_num(noise)))
    axes.set_xlabel(f"root mean square error on motions left out [{unit}]")
    axes.grid(axis="x")
    figure.legend(loc="outside upper left", ncols=3, fontsize=8)
    return as_svg(figure)


@dataclass(frozen=True)
class Traced:
    """One window, ready to be drawn; angles in the unit of the axis.

    Attributes:
      time: of the readings, s.
      measured: same shape.
      models: label and colour to what the model predicts.
      command: times and values, for a joint.
      noise: standard deviation, in the unit of the errors.
      span: the stretch that is told of, s.
      unit: of the axis.
      small: of the errors.
      factor: from the axis' unit to that of the errors.
    """

    time: Array
    measured: Array
    models: dict[tuple[str, str], Array]
    command: tuple[Array, Array] | None
    noise: float
    span: tuple[float, float]
    unit: str
    small: str
    factor: float


def window(traced: Traced) -> Drawing:
    """Command, measurement and models over a window, and the errors beneath."""
    figure = new_figure(3.3, 3.1)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    for axes in (above, below):
        axes.axvspan(*traced.span, color="#f1f3f5", zorder=0)
        axes.grid()
    few = len(traced.time) <= DOTTED
    dots = {"marker": "." if few else "", "linestyle": "" if few else "-", "markersize": 4}
    above.plot(traced.time, traced.measured, color=INK, linewidth=LINE_WIDTH, zorder=4, **dots)
    if traced.command is not None:
        above.plot(*traced.command, color=SOFT, linewidth=0.8, drawstyle="steps-post")
    for (label, colour), values in traced.models.items():
        dash = "--" if colour == BEFORE else "-"
        above.plot(traced.time, values, color=colour, linestyle=dash, linewidth=LINE_WIDTH)
        error = traced.factor * (traced.measured - values)
        below.plot(
            traced.time, error, color=colour, linestyle=dash, linewidth=LINE_WIDTH, label=label
        )
    below.axhspan(-traced.noise, traced.noise, color=PALE, alpha=0.55, zorder=1, linewidth=0)
    above.set_ylim(*_limits([traced.measured, *(traced.command[1:] if traced.command else ())]))
    errors = [traced.factor * (traced.measured - v) for v in traced.models.values()]
    reach = max(1.15 * _largest(errors), 2.5 * traced.noise)
    below.set_ylim(-reach, reach)
    below.set_xlim(traced.time[0], traced.time[-1])
    above.set_ylabel(f"position [{traced.unit}]")
    below.set_ylabel(f"error [{traced.small}]")
    below.set_xlabel("time [s]")
    figure.align_ylabels()
    return as_svg(figure)


def _limits(shown: Sequence[Array]) -> tuple[float, float]:
    """Around what was measured and commanded: a model that broke down may leave the picture."""
    values = np.concatenate(shown)
    values = values[np.isfinite(values)]
    margin = 0.12 * max(float(np.ptp(values)), 1e-3)
    return float(values.min()) - margin, float(values.max()) + margin


def _largest(errors: Sequence[Array]) -> float:
    return max(float(np.quantile(np.abs(e), 0.98)) for e in errors)


def misfit_map(
    rows: Sequence[str], columns: Sequence[str], values: Array, norm: LogNorm
) -> Drawing:
    """Errors of joints in regimes, in units of the noise."""
    height = 0.24 * len(rows)
    figure = new_figure(WIDTH, 1.9 + height)
    axes = figure.subplots()
    _cells(axes, rows, columns, np.maximum(values, 1.0), MAP, norm, _short(values))
    misfit_bar(figure, axes, norm, height)
    return as_svg(figure)


def misfit_time(rows: Sequence[str], edges: Array, values: Array, norm: LogNorm) -> Drawing:
    """Errors over the time of a recording, in units of the noise; a row without data is white."""
    figure = new_figure(3.3, 0.55 + 0.155 * max(len(rows), 2))
    figure.set_dpi(SHARP)
    axes = figure.subplots()
    axes.imshow(
        np.maximum(values, 1.0), cmap=MAP, norm=norm, aspect="auto", interpolation="nearest",
        extent=(float(edges[0]), float(edges[-1]), len(rows) - 0.5, -0.5),
    )  # fmt: skip
    name_rows(axes, rows, fontsize=7)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_xlabel("time [s]", fontsize=8)
    axes.tick_params(axis="x", labelsize=8)
    axes.spines[:].set_visible(False)
    return as_svg(figure)


def ranking_bars(
    names: Sequence[str], surprise: Array, threshold: float, chosen: Sequence[bool]
) -> Drawing:
    """Surprise of the best hypotheses, with the line that chance does not reach."""
    figure = new_figure(WIDTH, 1.0 + 0.22 * len(names))
    axes = figure.subplots()
    colours = [BLUE if c else AMBER if s > threshold else PALE
               for c, s in zip(chosen, surprise, strict=True)]  # fmt: skip
    axes.barh(range(len(names)), surprise, 0.72, color=colours)
    axes.axvline(threshold, color=INK, linewidth=1.2, linestyle="--")
    beyond = threshold > float(surprise.max())
    axes.annotate(
        "chance stays left of here", (threshold, 1), xycoords=("data", "axes fraction"),
        xytext=(0 if beyond else 3, 3), textcoords="offset points", fontsize=7.5,
        ha="right" if beyond else "left",
    )  # fmt: skip
    axes.set_xscale("log")
    axes.set_xlim(
        0.5 * min(float(surprise.min()), threshold), 1.6 * max(float(surprise.max()), threshold)
    )
    axes.xaxis.set_major_formatter("{x:,.0f}")
    name_rows(axes, names)
    axes.set_xlabel("surprise: promised drop of chi-squared")
    axes.grid(axis="x")
    return as_svg(figure)


def gains(names: Sequence[str], inside: Array, outside: Array) -> Drawing:
    """What finalists explain of motions they were fitted to, and of motions left out."""
    figure = new_figure(WIDTH, 0.95 + ROW * len(names))
    axes = figure.subplots()
    at = np.arange(len(names))
    axes.hlines(at, outside, inside, color=PALE, linewidth=2.5, zorder=1)
    axes.plot(inside, at, "o", color=AMBER, label="on what it was fitted to")
    axes.plot(outside, at, "D", color=BLUE, markersize=5, label="on motions left out")
    axes.axvline(0, color=SOFT, linewidth=0.8)
    name_rows(axes, names)
    largest = max(float(inside.max()), float(outside.max()), 1e-9)
    least = max(float(outside.min()), -largest)
    axes.set_xlim(min(least, 0.0) - 0.04 * largest, 1.06 * largest)
    axes.locator_params(axis="x", nbins=5)
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.set_xlabel("chi-squared explained")
    axes.grid(axis="x")
    figure.legend(loc="outside upper left", ncols=2, fontsize=8)
    return as_svg(figure)


def masking(
    names: Sequence[str], hidden: Array, parameters: Sequence[str], changes: Array
) -> Drawing:
    """Hidden share of some effects, and by which nominal parameters.

    Args:
      names: of the effects.
      hidden: shares, shape (n_effects,).
      parameters: their names.
      changes: relative, shape (n_effects, n_parameters).
    """
    figure = new_figure(WIDTH + 0.3, 1.75 + 0.3 * len(names))
    left, right = figure.subplots(
        1, 2, sharey=True, width_ratios=(1, max(1.0, 0.28 * len(parameters)))
    )
    at = np.arange(len(names)) + 0.5
    left.barh(at, 100 * hidden, 0.62, color=SOFT)
    for y, share in zip(at, hidden, strict=True):
        full = share > 0.6
        left.text(
            100 * share + (-3 if full else 3), y, f"{100 * share:.0f} %", va="center",
            ha="right" if full else "left", color="white" if full else INK, fontsize=7.5,
        )  # fmt: skip
    left.set_xlim(0, 100)
    left.set_xlabel("hidden [%]")
    left.tick_params(axis="y", length=0)
    bound = max(0.1, float(np.abs(changes).max(initial=0.0)))
    labels = np.array([[f"{100 * c:+.0f}" if abs(c) >= 0.005 else "" for c in row]
                       for row in changes])  # fmt: skip
    norm = Normalize(-min(bound, 1.0), min(bound, 1.0))
    _cells(right, names, parameters, changes, CHANGES, norm, labels)
    right.tick_params(axis="y", labelleft=False)
    left.set_yticks(at, names, fontsize=8)
    right.set_title("shift [%]", fontsize=8, loc="left")
    return as_svg(figure)


def likeness(names: Sequence[str], overlaps: Array) -> Drawing:
    """How alike the traces of some hypotheses are."""
    figure = new_figure(WIDTH, 1.5 + 0.26 * len(names))
    axes = figure.subplots()
    labels = np.array([[f"{100 * v:.0f}" for v in row] for row in overlaps])
    numbered = [f"{name} ({i})" for i, name in enumerate(names, start=1)]
    columns = [f"({i})" for i in range(1, len(names) + 1)]
    _cells(axes, numbered, columns, overlaps, SHARES, Normalize(0, 1), labels, upright=True)
    axes.set_xlabel("overlap of the traces [%]", fontsize=8)
    return as_svg(figure)


def _cells(
    axes: Any,
    rows: Sequence[str],
    columns: Sequence[str],
    values: Array,
    colours: Any,
    norm: Normalize,
    labels: NDArray[np.str_],
    upright: bool = False,
) -> None:
    """A heat map with a number in each cell."""
    axes.pcolormesh(values, cmap=colours, norm=norm, edgecolors="white", linewidth=0.8)
    for i, j in np.ndindex(*values.shape):
        if np.isfinite(values[i, j]):
            red, green, blue, _ = colours(norm(values[i, j]))
            dark = 0.299 * red + 0.587 * green + 0.114 * blue < 0.5
            axes.text(
                j + 0.5, i + 0.5, labels[i, j], ha="center", va="center", fontsize=6.5,
                color="white" if dark else INK,
            )  # fmt: skip
    axes.set_yticks(np.arange(len(rows)) + 0.5, rows, fontsize=8)
    axes.set_xticks(np.arange(len(columns)) + 0.5, columns, fontsize=8,
                    rotation=0 if upright else 90)  # fmt: skip
    axes.set_ylim(len(rows), 0)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)


def _short(values: Array) -> NDArray[np.str_]:
    """Numbers of a few characters."""
    return np.array([[f"{v:.1f}" if v < 9.95 else f"{v:.0f}" for v in row] for row in values])


def name_rows(axes: Any, names: Sequence[str], fontsize: float = 8.5) -> None:
    """One row for each name, the first on top."""
    axes.set_yticks(range(len(names)), names, fontsize=fontsize)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)
