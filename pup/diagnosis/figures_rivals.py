"""The figure of a diagnosis beside its rivals."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.ticker import FixedLocator, NullLocator

from pup.diagnosis.figures import AFTER, BEFORE, name_rows
from pup.sysid.figures import AMBER, INK, PURPLE, WIDTH, as_svg, new_figure
from pup.sysid.html import Drawing

LOOKS = {
    "nominal": (BEFORE, "o"),
    "nn_pd": (PURPLE, "s"),
    "residual_network": (AMBER, "^"),
    "diagnosed": (AFTER, "D"),
}
"""Colour and mark of each model; the nominal and the corrected one as in the other figures."""
BAND = "#f1f3f5"
"""Behind every other row."""
APART = 0.3
"""The first and the last model stand this far above and below their row: equals hide none."""
WIDE = 6.0
"""Where errors differ by a larger factor, the axis is logarithmic."""
TICKS = (1, 2, 3, 5, 7)
"""Round numbers of each decade that such an axis has."""


def rival_dots(
    names: Sequence[str],
    errors: Mapping[str, Sequence[float]],
    labels: Mapping[str, str],
    unit: str,
    noise: float,
) -> Drawing:
    """Errors of some models on motions left out, a row for each type of motion.

    Args:
      names: of the rows.
      errors: by model, one for each row, rad.
      labels: what the models are called.
      unit: of a thousandth of the errors, which is what is drawn.
      noise: the noise level, drawn as a line.
    """
    values = {name: 1000 * np.array(told) for name, told in errors.items()}
    every = np.stack(list(values.values()))
    figure = new_figure(WIDTH, 1.3 + 0.46 * len(names))
    axes = figure.subplots()
    rows = np.arange(len(names))
    for row in rows[::2]:  # bands hold each row's marks together
        axes.axhspan(row - 0.5, row + 0.5, color=BAND, zorder=0, linewidth=0)
    for shift, (name, told) in zip(
        np.linspace(-APART, APART, len(values)), values.items(), strict=True
    ):
        colour, mark = LOOKS[name]
        axes.plot(
            told, rows + shift, mark, color=colour, markersize=6.5, markeredgecolor="white",
            markeredgewidth=0.6, label=labels[name], zorder=3,
        )  # fmt: skip
    shown = [float(every.min()), float(every.max())]
    if np.isfinite(noise):
        axes.axvline(1000 * noise, color=INK, linewidth=1, linestyle="--", label="noise alone")
        shown = [min(shown[0], 1000 * noise), max(shown[1], 1000 * noise)]
    if shown[1] > WIDE * shown[0]:
        _decades(axes, shown)
    else:
        axes.set_xlim(0, 1.06 * shown[1])
    name_rows(axes, names)
    axes.set_xlabel(f"root mean square error on motions left out [{unit}]")
    axes.grid(axis="x")
    figure.legend(loc="outside upper left", ncols=3, fontsize=8)
    return as_svg(figure)


def _decades(axes: Any, ends: Sequence[float]) -> None:
    """A logarithmic axis with a few round numbers."""
    axes.set_xscale("log")
    axes.set_xlim(0.8 * ends[0], 1.25 * ends[1])
    powers = range(int(np.floor(np.log10(ends[0]))) - 1, int(np.ceil(np.log10(ends[1]))) + 1)
    axes.xaxis.set_major_locator(FixedLocator([tick * 10.0**p for p in powers for tick in TICKS]))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter("{x:g}")
