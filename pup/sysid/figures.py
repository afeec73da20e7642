"""The figures of pre-sysID: bounds, convergence, errors, correlation and splits.

Drawn with Matplotlib's objects alone. Text stays text in the SVG, sizes are for the width of a
phone, and colours are Okabe and Ito's, which the colour-blind can tell apart.
"""

import io
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator
from numpy.typing import NDArray

from pup.sysid import wording
from pup.sysid.html import Drawing
from pup.sysid.result import Bounds

Array = NDArray[np.float64]

BLUE, VERMILLION, GREEN, PURPLE, AMBER = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00"
RED, INK, SOFT, PALE = "#C1121F", "#1b1f24", "#6e7781", "#c9ced4"
LABELS = {"nn_pd": "NN-PD", "pd": "PD"}
"""What the actuator models are called where people read."""
_FIXED = {"NN-PD": (BLUE, "-"), "PD": (VERMILLION, "--"), "authors": (GREEN, "-.")}
_SPARE = ((PURPLE, ":"), (AMBER, "-"), (SOFT, "--"))

_PARAMETERS = {
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.labelsize": 9,
    "axes.edgecolor": SOFT,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "grid.color": "#e4e7ea",
    "grid.linewidth": 0.6,
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.frameon": False,
    "text.parse_math": False,  # a dollar in an id is a dollar
    "svg.fonttype": "none",
    "svg.hashsalt": "pup",
}

WIDTH = 4.6  # inches; 442 CSS pixels
ROW = 0.27  # inches per parameter or joint


@contextmanager
def drawing_style() -> Iterator[None]:
    """Matplotlib's settings for our figures, put back afterwards."""
    with matplotlib.rc_context(_PARAMETERS):
        yield


def new_figure(width: float, height: float, *, fixed: bool = False) -> Any:
    """A figure that pyplot does not know of.

    Args:
      width: in inches.
      height: in inches.
      fixed: whether the caller places the axes.
    """
    figure = Figure(figsize=(width, height), layout=None if fixed else "constrained")
    FigureCanvasAgg(figure)
    return figure


def as_png(figure: Any) -> bytes:
    """The figure as PNG, the same bytes every time."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=120, metadata={"Software": None})
    return buffer.getvalue()


def as_svg(figure: Any) -> Drawing:
    """The figure as SVG, the same bytes every time."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    width, height = figure.get_size_inches() * 96
    return Drawing(buffer.getvalue(), round(width), round(height))


def line_style(label: str, labels: Sequence[str]) -> tuple[str, str]:
    """Colour and dash pattern of a replay's label, the same in every figure."""
    if label in _FIXED:
        return _FIXED[label]
    others = [name for name in labels if name not in _FIXED]
    return _SPARE[others.index(label) % len(_SPARE)]


def bounds_bars(bounds: Bounds) -> Drawing:
    """Bounds in the normalised search range with the nominal values in red (the paper's figure)."""
    space, count = bounds.space, len(bounds.space)
    low, high = space.normalise(bounds.lower), space.normalise(bounds.upper)
    nominal, interval = space.normalise(bounds.nominal), space.normalise(bounds.ci90.T).T
    figure = new_figure(WIDTH, 1.1 + ROW * count)
    axes = figure.subplots()
    for known, colour, label in (
        (True, BLUE, "bounds"),
        (False, PALE, "bounds, not identified"),
    ):
        rows = np.flatnonzero(bounds.identified == known)
        if len(rows):
            width = (high - low)[rows]
            axes.barh(rows, width, 0.6, left=low[rows], color=colour, label=label)
    axes.hlines(range(count), *interval.T, color=INK, linewidth=1, label="90 % interval of the fit")
    axes.vlines(
        nominal, np.arange(count) - 0.42, np.arange(count) + 0.42, color=RED, linewidth=2.2,
        label="nominal",
    )  # fmt: skip
    _parameter_rows(axes, bounds)
    axes.set_xlim(-0.01, 1.01)
    axes.set_xlabel("search range (0: lower end, 1: upper end)")
    axes.grid(axis="x")
    figure.legend(loc="outside upper left", ncols=2, fontsize=8)
    return as_svg(figure)


def _parameter_rows(axes: Any, bounds: Bounds) -> None:
    """One row per parameter from the top; those not identified are labelled in grey."""
    count = len(bounds.space)
    axes.set_yticks(range(count), bounds.space.names)
    axes.set_ylim(count - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)
    for label, known in zip(axes.get_yticklabels(), bounds.identified, strict=True):
        label.set_color(INK if known else SOFT)
        label.set_fontstyle("normal" if known else "italic")


def convergence(histories: Mapping[str, Array]) -> Drawing:
    """Best objective over the generations of each actuator's fit (the paper's figure)."""
    figure = new_figure(WIDTH, 2.7)
    axes = figure.subplots()
    labels = [LABELS.get(name, name) for name in histories]
    for label, history in zip(labels, histories.values(), strict=True):
        colour, dash = line_style(label, labels)
        generation = np.arange(1, len(history) + 1)
        marker = "o" if len(history) == 1 else ""
        axes.plot(generation, history, color=colour, linestyle=dash, label=label, marker=marker)
    values = np.concatenate(list(histories.values()))
    values = values[np.isfinite(values)]
    if len(values) and values.min() > 0 and values.max() > 5 * values.min():
        axes.set_yscale("log")
        axes.yaxis.set_minor_locator(LogLocator(subs=(2, 5)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("{x:g}")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("generation")
    axes.set_ylabel("best loss so far")
    axes.grid()
    axes.legend(loc="upper right")
    return as_svg(figure)


def joint_errors(joints: Sequence[str], errors: Mapping[str, Array], unit: str) -> Drawing:
    """Bars of the RMSE per joint and replay.

    Args:
      joints: their names.
      errors: label to RMSE per joint, shape (n_joints,).
      unit: of a thousandth of them, which is what is drawn.
    """
    count, shown = len(joints), list(errors)
    height = 0.8 / len(shown)
    figure = new_figure(WIDTH, 0.9 + len(joints) * (0.12 + 0.1 * len(shown)))
    axes = figure.subplots()
    for i, (label, values) in enumerate(errors.items()):
        colour, _ = line_style(label, shown)
        at = np.arange(count) - 0.4 + (i + 0.5) * height
        axes.barh(at, 1000 * values, height * 0.92, color=colour, label=label)
    axes.set_yticks(range(count), joints)
    axes.set_ylim(count - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)
    axes.set_xlabel(f"RMSE [{unit}]")
    axes.grid(axis="x")
    figure.legend(loc="outside upper left", ncols=len(shown))
    return as_svg(figure)


def correlation_matrix(bounds: Bounds) -> Drawing:
    """Correlation of the parameters; the rows also tell each one's 90 % interval."""
    count = len(bounds.space)
    figure = new_figure(WIDTH + 0.6, 1.5 + 0.3 * count)
    axes = figure.subplots()
    mesh = axes.pcolormesh(
        np.where(np.eye(count, dtype=bool), np.nan, bounds.correlation),
        cmap="RdBu_r", vmin=-1, vmax=1, edgecolors="white", linewidth=0.5,
    )  # fmt: skip
    middle = np.arange(count) + 0.5
    names = [f"{name}: {wording.interval(bounds, i)}" for i, name in enumerate(bounds.space.names)]
    axes.set_yticks(middle, names, fontsize=8)
    axes.set_xticks(middle, bounds.space.names, fontsize=8, rotation=90)
    axes.invert_yaxis()
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    for labels in (axes.get_yticklabels(), axes.get_xticklabels()):
        for label, known in zip(labels, bounds.identified, strict=True):
            label.set_color(INK if known else SOFT)
            label.set_fontstyle("normal" if known else "italic")
    for i, j in zip(*np.nonzero(np.abs(bounds.correlation) >= 0.5), strict=True):
        if i != j:
            value = float(bounds.correlation[i, j])
            axes.text(
                j + 0.5, i + 0.5, f"{value:.2f}".replace("0.", "."), fontsize=6.5,
                ha="center", va="center", color="white" if abs(value) > 0.65 else INK,
            )  # fmt: skip
    bar = figure.colorbar(
        mesh, ax=axes, orientation="horizontal", aspect=40, pad=0.04, ticks=(-1, -0.5, 0, 0.5, 1)
    )
    bar.set_label("correlation of the estimates")
    bar.outline.set_visible(False)
    return as_svg(figure)


def split_values(bounds: Bounds, splitting: Collection[str]) -> Drawing:
    """Values of the subset fits with and without contact, in the normalised search range.

    Args:
      bounds: their splits.
      splitting: parameters to mark.
    """
    figure = new_figure(WIDTH, 1.1 + ROW * len(bounds.splits) * 1.15)
    axes = figure.subplots()
    for row, split in enumerate(bounds.splits):
        at = bounds.space.names.index(split.name)
        for values, side, colour, marker, label in (
            (split.without, -0.17, BLUE, "o", "subsets without contact"),
            (split.with_contact, 0.17, VERMILLION, "^", "subsets with contact"),
        ):
            low, high = bounds.space.lower[at], bounds.space.upper[at]
            unit = (values - low) / (high - low)
            axes.plot(
                unit, np.full(len(unit), row + side), linestyle="", marker=marker, markersize=4,
                color=colour, alpha=0.5, markeredgewidth=0,
                label=label if row == 0 and len(unit) else None,
            )  # fmt: skip
            if len(unit):
                axes.vlines(unit.mean(), row + side - 0.17, row + side + 0.17, color=colour, lw=1.6)
        if split.name in splitting:
            axes.annotate(
                "split", (1, row), xycoords=("axes fraction", "data"), xytext=(4, 0),
                textcoords="offset points", va="center", color=RED, weight="bold",
            )  # fmt: skip
    axes.set_yticks(range(len(bounds.splits)), [s.name for s in bounds.splits])
    axes.set_ylim(len(bounds.splits) - 0.4, -0.6)
    axes.set_xlim(-0.01, 1.01)
    axes.tick_params(axis="y", length=0)
    axes.set_xlabel("search range (0: lower end, 1: upper end); bars: means")
    axes.grid(axis="x")
    figure.legend(loc="outside upper left", ncols=2)
    return as_svg(figure)
