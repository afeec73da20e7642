"""Figures of an experiment: those of the paper, for many robots, and ours.

All are drawn from the document of `experiment.json`; dots are robots, bars their means.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator

from pup.sysid.figures import (
    AMBER,
    BLUE,
    GREEN,
    INK,
    PALE,
    PURPLE,
    RED,
    ROW,
    SOFT,
    VERMILLION,
    WIDTH,
    as_svg,
    new_figure,
)
from pup.sysid.html import Drawing
from services.experiment.statistics import best_so_far
from services.experiment.verdicts import ENOUGH, FLEETS, walking

COLOURS = {"pup": VERMILLION, "up": AMBER, "robust": BLUE, "nominal": SOFT}
NAMES = {
    "pup": "PUP + BO",
    "up": "UP + BO",
    "robust": "Robust",
    "nominal": "Nominal",
    "pup+prior": "PUP + BO, prior",
    "up+prior": "UP + BO, prior",
    "pup+fitted": "PUP, no trials",
    "up+fitted": "UP, no trials",
    "pup+own": "PUP trained on + BO, own simulator",
    "pup+corrected": "PUP trained on + BO, corrected",
    "pup+own+fitted": "PUP trained on, own simulator, no trials",
    "pup+corrected+fitted": "PUP trained on, corrected, no trials",
    "pup+undiagnosed": "PUP trained on + BO, undiagnosed fleet",
    "pup+undiagnosed+fitted": "PUP trained on, undiagnosed fleet, no trials",
    "pup+diagnosed": "PUP + BO, diagnosed fleet",
    "up+diagnosed": "UP + BO, diagnosed fleet",
    "robust+diagnosed": "Robust, diagnosed fleet",
    "nominal+diagnosed": "Nominal, diagnosed fleet",
    "pup+diagnosed+fitted": "PUP, diagnosed fleet, no trials",
    "up+diagnosed+fitted": "UP, diagnosed fleet, no trials",
}
"""What arms are called where people read."""
METHODS = tuple(COLOURS)
FURTHER = {"own": PURPLE, "corrected": GREEN, "undiagnosed": SOFT}
"""Colours of policies that were trained on."""
DASHES = {"prior": "--", "diagnosed": ":"}
MODELS = {
    "nominal": "PD",
    "nn_pd": "NN-PD",
    "residual_network": "PD and a residual network",
    "diagnosed": "diagnosed",
}
QUANTITIES = {"distance": "distance, m", "time": "time before the fall, s"}


def walked(directions: Mapping[str, Any], quantity: str) -> Drawing:
    """Distance or time of each direction and method, with the deviation of all walks (the paper's).

    Where policies were trained on with what diagnoses share, theirs stand beside.

    Args:
      directions: of the document.
      quantity: `distance` or `time`.
    """
    figure = new_figure(WIDTH + 0.9, 3.0)
    axes = figure.subplots()
    wide, groups = 0.8 / len(METHODS), _groups(directions)
    for i, (part, end) in enumerate(groups.values()):
        arms = part["statistics"]["arms"]
        there = [method for method in METHODS if method + end in arms]
        for k, method in enumerate(there):
            at, bar = i + (k - (len(there) - 1) / 2) * wide, arms[method + end][quantity]
            axes.bar(at, bar["value"], wide * 0.9, color=COLOURS[method], alpha=0.75)
            axes.errorbar(at, bar["value"], yerr=bar["std"] or 0, color=INK, capsize=2.5, lw=1)
            means = [float(np.mean(w[quantity])) for w in part["walks"][method + end].values()]
            axes.plot(_spread(at, wide, len(means)), means, ".", color=INK, ms=3.5, alpha=0.6)
    for method in METHODS:
        if any(method + end in part["walks"] for part, end in groups.values()):
            axes.bar(0, 0, 0, color=COLOURS[method], alpha=0.75, label=NAMES[method])
    axes.set_xticks(range(len(groups)), list(groups))
    axes.set_xlim(-0.55, len(groups) - 0.45)
    axes.tick_params(axis="x", length=0)
    axes.set_ylabel(QUANTITIES[quantity])
    axes.axhline(0, color=SOFT, lw=0.8)
    axes.grid(axis="y")
    figure.legend(loc="outside upper left", ncols=4, fontsize=8)
    return as_svg(figure)


def _groups(directions: Mapping[str, Any]) -> dict[str, tuple[Mapping[str, Any], str]]:
    """What stands side by side, by caption: the walks of a direction, and how their arms end."""
    groups = {}
    for direction, part in directions.items():
        for end, words in zip(FLEETS, ("", "\ndiagnosed fleet"), strict=True):
            if any(method + end in part["walks"] for method in METHODS):
                groups[direction + words] = part, end
    return groups


def _spread(at: float, wide: float, count: int) -> np.ndarray:
    return at + (np.linspace(-0.3, 0.3, count) if count > 1 else np.zeros(1)) * wide


def per_robot(walks: Mapping[str, Any], end: str) -> Drawing:
    """Each method's mean distance on each robot, a row for each.

    Args:
      walks: of one direction, by arm and robot.
      end: of the arms, one of `verdicts.FLEETS`.
    """
    arms = [method + end for method in METHODS if method + end in walks]
    robots = sorted({robot for arm in arms for robot in walks[arm]})
    figure = new_figure(WIDTH + 0.4, 1.1 + 0.24 * len(robots))
    axes = figure.subplots()
    for arm in arms:
        rows = [(robots.index(r), walk["distance"]) for r, walk in walks[arm].items()]
        middle = [float(np.mean(distance)) for _, distance in rows]
        spread = [
            float(np.std(distance, ddof=1)) if len(distance) > 1 else 0 for _, distance in rows
        ]
        at = np.array([row for row, _ in rows]) + 0.14 * (arms.index(arm) - (len(arms) - 1) / 2)
        axes.errorbar(
            middle, at, xerr=spread, fmt="o", ms=4, lw=0.9, color=COLOURS[arm.removesuffix(end)],
            label=NAMES[arm],
        )  # fmt: skip
    _rows(axes, robots)
    axes.set_xlim(left=min(0.0, axes.get_xlim()[0]))
    axes.set_xlabel("distance, m (bars: deviation of the walks)")
    axes.grid(axis="x")
    figure.legend(loc="outside upper left", ncols=2 if end else 4, fontsize=8)
    return as_svg(figure)


def searches(part: Mapping[str, Any]) -> Drawing:
    """The best walk so far over trials, as a share of what PUP comes after all of them.

    Robots on which PUP does not walk are left out: there is nothing to be a share of.

    Args:
      part: one direction of the document.
    """
    figure = new_figure(WIDTH, 2.9)
    axes = figure.subplots()
    far = walking(part["walks"])
    for arm, told in part["searches"].items():
        shares = [
            np.nan_to_num(best_so_far(distances), neginf=0.0) / far[robot]  # no walk is no distance
            for robot, distances in told.items()
            if distances and robot in far
        ]
        if not shares:
            continue
        shortest = min(map(len, shares))
        drawn = np.array([share[:shortest] for share in shares])
        trial, (method, _, more) = np.arange(1, shortest + 1), arm.partition("+")
        colour, dash = FURTHER.get(more, COLOURS[method]), DASHES.get(more, "-")
        low, high = np.quantile(drawn, [0.25, 0.75], axis=0)
        axes.fill_between(trial, low, high, color=colour, alpha=0.1, lw=0)
        axes.plot(trial, np.median(drawn, axis=0), dash, color=colour, label=NAMES[arm])
    axes.axhline(ENOUGH, color=PALE, lw=1)
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("trials")
    axes.set_ylabel("best walk so far, share of PUP's\ndistance after all trials")
    axes.grid()
    figure.legend(loc="outside upper left", ncols=2, fontsize=7.5)
    return as_svg(figure)


def fleet_bounds(bounds: Mapping[str, Any]) -> Drawing:
    """The fleet's bounds in the search range, with each robot's own fit as a dot.

    Args:
      bounds: of the document.
    """
    parameters = bounds["parameters"]
    figure = new_figure(WIDTH, 1.1 + ROW * len(parameters))
    axes = figure.subplots()
    for row, p in enumerate(parameters):
        first, width = p["search"][0], p["search"][1] - p["search"][0]
        low, high, nominal = ((p[k] - first) / width for k in ("lower", "upper", "nominal"))
        colour = BLUE if p["identified"] else PALE
        axes.barh(row, high - low, 0.6, left=low, color=colour, alpha=0.55)
        axes.vlines(nominal, row - 0.42, row + 0.42, color=RED, lw=2.2)
        told = [robot[p["name"]] for robot in bounds["robots"].values() if p["name"] in robot]
        own = [(value - first) / width for value in told]
        axes.plot(own, np.full(len(own), row), ".", color=INK, ms=4.5)
    axes.barh(0, 0, 0, color=BLUE, alpha=0.55, label="bounds of the fleet")
    axes.plot([], [], color=RED, lw=2.2, label="its nominal values")
    axes.plot([], [], ".", color=INK, ms=4.5, label="fits of single robots")
    _rows(axes, [p["name"] for p in parameters])
    axes.set_xlim(-0.01, 1.01)
    axes.set_xlabel("search range, 0 to 1")
    axes.grid(axis="x")
    figure.legend(loc="outside upper left", ncols=2, fontsize=8)
    return as_svg(figure)


def before_after(robots: Mapping[str, tuple[float, float]], label: str) -> Drawing:
    """A number of each robot before and after, an arrow each.

    Args:
      robots: before and after, by robot.
      label: what it is, with its unit.
    """
    names = sorted(robots)
    figure = new_figure(WIDTH, 1.1 + 0.24 * len(names))
    axes = figure.subplots()
    for row, name in enumerate(names):
        before, after = robots[name]
        axes.annotate(
            "", (after, row), (before, row), arrowprops={"arrowstyle": "->", "color": SOFT, "lw": 1}
        )
        axes.plot(before, row, "o", ms=5, color=SOFT, label="before" if row == 0 else None)
        axes.plot(after, row, "o", ms=5, color=GREEN, label="after" if row == 0 else None)
    _rows(axes, names)
    if min(min(pair) for pair in robots.values()) >= 0:
        axes.set_xlim(left=0.0)
    axes.set_xlabel(label)
    axes.grid(axis="x")
    figure.legend(loc="outside upper left", ncols=2, fontsize=8)
    return as_svg(figure)


def held_out(models: Mapping[str, Any]) -> Drawing:
    """Errors of several models on motions left out, overall and by type of motion.

    Args:
      models: `rmse` and `per_motion` (rad) by the model's name.
    """
    names = list(models)
    motions = sorted({m for told in models.values() for m in told["per_motion"]})
    rows = ["all", *motions] if len(motions) > 1 else motions
    figure = new_figure(WIDTH, 1.2 + 0.3 * len(rows) * max(1, len(names)) / 2)
    axes = figure.subplots()
    colours = dict(zip(names, (SOFT, BLUE, AMBER, GREEN, PURPLE), strict=False))
    height = 0.8 / len(names)
    for k, name in enumerate(names):
        told = models[name]
        values = [(told["per_motion"] | {"all": told["rmse"]}).get(row, np.nan) for row in rows]
        at = np.arange(len(values)) - 0.4 + (k + 0.5) * height
        axes.barh(
            at,
            1e3 * np.array(values, float),
            height * 0.9,
            color=colours[name],
            label=MODELS.get(name, name),
        )
    _rows(axes, rows)
    axes.set_xlabel("error on motions left out, mrad")
    axes.grid(axis="x")
    figure.legend(loc="outside upper left", ncols=2, fontsize=8)
    return as_svg(figure)


def _rows(axes: Any, names: Sequence[str]) -> None:
    """One row each, from the top."""
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)
