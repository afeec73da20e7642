"""Pictures of what jobs and recordings left, as SVG: samples over time, curves, bounds."""

from collections.abc import Iterator, Sequence
from html import escape
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pup.recording import Recording
from services.gateway.documents import BoundedParameter, BoundsDocument, Curve
from services.gateway.drawing import Axes, svg, ticks

Array = NDArray[np.float64]

JOINTS = 48
"""Joints of a recording that are drawn."""
POINTS = 400
"""Of a line: about what a screen can show."""
GAP = 5
"""Samples that are so many times further apart than usual are not joined."""
GAPS = 50
"""Of a line that are drawn; one with more is joined throughout."""
SMOOTHED = 10
"""Iterations of a training whose mean is drawn."""
LARGEST = 1e9
"""Numbers beyond it, which no unit explains, are drawn at the edge."""
WIDTH = 320
RANGE_WIDTH, RANGE_HEIGHT, MARGIN, NARROW = 240, 26, 6, 5


def thinned(x: Array, y: Array, most: int = POINTS) -> tuple[Array, Array]:
    """A line of about so many points that looks the same: lows and highs of each piece stay.

    Args:
      x: increasing, shape (n_points,).
      y: finite, shape (n_points,).
      most: points that stay.
    """
    if len(x) <= most:
        return x, y
    pieces = np.array_split(np.arange(len(x)), max(1, most // 2))
    kept = {0, len(x) - 1}
    for piece in pieces:
        kept |= {int(piece[y[piece].argmin()]), int(piece[y[piece].argmax()])}
    at = sorted(kept)
    return x[at], y[at]


def _runs(x: Array) -> list[slice]:
    """Stretches of samples without a gap."""
    steps = np.diff(x)
    if not len(steps):
        return [slice(0, len(x))]
    cuts = np.flatnonzero(steps > GAP * np.median(steps)) + 1
    edges = [0, *(cuts.tolist() if len(cuts) <= GAPS else []), len(x)]
    return [slice(a, b) for a, b in pairwise(edges)]


def _lines(axes: Axes, x: Array, y: Array, kind: str) -> Iterator[str]:
    """Samples as lines, missing ones left out."""
    there = np.isfinite(y)
    x, y = x[there], _clipped(y[there])
    for run in _runs(x):
        xs, ys = x[run], y[run]
        most = max(4, POINTS * len(xs) // max(1, len(x)))
        yield axes.line(*(a.tolist() for a in thinned(xs, ys, most)), kind)


def _stairs(axes: Axes, x: Array, y: Array, kind: str) -> str:
    """Samples that are held until the next one, however late, and the last one to the end."""
    there = np.isfinite(y)
    xs = np.append(np.repeat(x[there], 2)[1:], x[-1])
    ys = np.repeat(_clipped(y[there]), 2)
    return axes.line(*(a.tolist() for a in thinned(xs, ys)), kind)


def _clipped(values: Array) -> Array:
    return np.clip(values, -LARGEST, LARGEST)


def _span(*values: Array) -> tuple[float, float]:
    told = _clipped(np.concatenate([v[np.isfinite(v)] for v in values]))
    return (float(told.min()), float(told.max())) if len(told) else (0.0, 1.0)


def _ends(x: Array) -> tuple[float, float]:
    return float(x[0]), float(x[-1])


def joint(recording: Recording, j: int) -> list[str]:
    """A joint's command and position over time, and its current where it was measured."""
    name, time = recording.joints[j], recording.time - recording.time[0]
    target, position = recording.target[:, j], recording.position[:, j]
    axes = Axes(_ends(time), _span(target, position), WIDTH)
    seconds = ticks(*_ends(time))
    drawn = axes.frame("time, s", "position", seconds)
    drawn.append(_stairs(axes, time, target, "command"))
    drawn += _lines(axes, time, position, "position")
    told = [svg(WIDTH, f"command and position of {name}", drawn)]
    current = recording.extras.get(f"current/{name}")
    if current is not None:
        axes = Axes(_ends(time), _span(current), WIDTH)
        drawn = axes.frame("time, s", "current, A", seconds)
        drawn += _lines(axes, time, current, "current")
        told.append(svg(WIDTH, f"current of {name}", drawn))
    return told


def curves(curve: Curve) -> list[tuple[str, str]]:
    """Return, distance and time upright over the steps of a training: titles and pictures."""
    steps = np.array(curve.steps, dtype=float) / 1e6
    panels = (
        ("Return of an episode", "", curve.returns),
        ("Distance of an episode", "m", curve.distance),
        ("Time upright", "s", curve.time),
    )
    return [(title, _curve(title, unit, steps, values)) for title, unit, values in panels]


def _curve(title: str, unit: str, steps: Array, values: Sequence[float | None]) -> str:
    y = np.array(values, dtype=float)
    there = np.isfinite(y)
    x, y = steps[there], _clipped(y[there])
    last = max(float(steps[-1]), 1e-9)
    axes = Axes((0.0, last), _span(y), WIDTH)
    drawn = axes.frame("million steps", unit, ticks(0.0, last))
    if len(y):
        drawn.append(axes.line(*(a.tolist() for a in thinned(x, y)), "raw"))
        sums = np.cumsum(np.insert(y, 0, 0.0))
        count = np.minimum(np.arange(1, len(y) + 1), SMOOTHED)
        mean = (sums[1:] - sums[np.arange(1, len(y) + 1) - count]) / count
        drawn.append(axes.line(*(a.tolist() for a in thinned(x, mean)), "mean"))
    told = f"{title}, now {mean[-1]:.3g} {unit}".strip() if len(y) else f"{title}: none yet"
    return svg(WIDTH, told, drawn)


def bounds(parameter: BoundedParameter, document: BoundsDocument) -> str:
    """A parameter's bounds in its search range, its nominal fit and those of the subsets."""
    seen = [
        s.parameters[parameter.name] for s in document.subsets if parameter.name in s.parameters
    ]
    p = parameter
    low = min(p.search[0], p.lower, p.nominal)
    high = max(p.search[1], p.upper, p.nominal)

    def at(value: float) -> float:
        across = (min(max(value, low), high) - low) / max(high - low, 1e-300)
        return round(MARGIN + across * (RANGE_WIDTH - 2 * MARGIN), 1)

    middle, left, right = RANGE_HEIGHT / 2, at(p.lower), at(p.upper)
    kind, wide = "found" if p.identified else "vague", max(NARROW, right - left)
    told = (
        f"{p.name}: from {p.lower:.4g} to {p.upper:.4g}, nominal {p.nominal:.4g}, searched from "
        f"{p.search[0]:.4g} to {p.search[1]:.4g}"
    )
    drawn = [
        f'<line class="search" x1="{at(p.search[0])}" y1="{middle}" x2="{at(p.search[1])}" '
        f'y2="{middle}"/>',
        f'<rect class="{kind}" x="{(left + right - wide) / 2:.1f}" y="6" width="{wide:.1f}" '
        f'height="{RANGE_HEIGHT - 12}" rx="2"/>',
        *(f'<circle class="seen" cx="{at(v)}" cy="{middle}" r="2.5"/>' for v in seen),
        f'<line class="nominal" x1="{at(p.nominal)}" y1="2" x2="{at(p.nominal)}" '
        f'y2="{RANGE_HEIGHT - 2}"/>',
    ]
    return (
        f'<svg class="range" viewBox="0 0 {RANGE_WIDTH} {RANGE_HEIGHT}" role="img" '
        f'aria-label="{escape(told)}"><title>{escape(told)}</title>{"".join(drawn)}</svg>'
    )
