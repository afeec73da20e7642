"""Pictures as SVG: axes, and those of a study: distances by trial, slices of its process."""

import math
from collections.abc import Sequence
from html import escape
from itertools import accumulate

from pup.transfer.study import Study
from pup.transfer.trial import Purpose, Trial, TrialState
from services.gateway.records import Row

WIDTH, HEIGHT = 440, 220
LEFT, RIGHT, TOP, BOTTOM = 48, 12, 24, 36


class Axes:
    """Where numbers are on a picture."""

    def __init__(self, x: tuple[float, float], y: tuple[float, float], width: int) -> None:
        self.x, self.width = x, width
        low, high = y
        least = max(1e-3, 0.01 * max(abs(low), abs(high)))  # whose numbers can be told apart
        middle, half = (low + high) / 2, 0.56 * max(high - low, least)
        self.y = (middle - half, middle + half)

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Place of a point, in pixels."""
        across = (x - self.x[0]) / max(self.x[1] - self.x[0], 1e-12)
        up = (y - self.y[0]) / max(self.y[1] - self.y[0], 1e-12)
        right = LEFT + across * (self.width - LEFT - RIGHT)
        return round(right, 1), round(HEIGHT - BOTTOM - up * (HEIGHT - TOP - BOTTOM), 1)

    def line(self, xs: Sequence[float], ys: Sequence[float], kind: str) -> str:
        """A line through points."""
        points = " ".join("{},{}".format(*self.at(*p)) for p in zip(xs, ys, strict=True))
        return f'<polyline class="{kind}" points="{points}"/>'

    def frame(self, x_name: str, y_name: str, x_ticks: Sequence[float]) -> list[str]:
        """Axes with numbers and names."""
        drawn = []
        for y in ticks(*self.y):
            a, b = self.at(self.x[0], y), self.at(self.x[1], y)
            drawn.append(f'<line class="grid" x1="{a[0]}" y1="{a[1]}" x2="{b[0]}" y2="{b[1]}"/>')
            drawn.append(f'<text x="{LEFT - 6}" y="{a[1] + 4}" class="end">{y:.4g}</text>')
        for x in x_ticks:
            a = self.at(x, self.y[0])
            drawn.append(f'<text x="{a[0]}" y="{HEIGHT - 18}" class="mid">{x:.4g}</text>')
        middle = (LEFT + self.width - RIGHT) / 2
        drawn.append(f'<text x="{middle}" y="{HEIGHT - 3}" class="mid">{escape(x_name)}</text>')
        drawn.append(f'<text x="4" y="11">{escape(y_name)}</text>')
        return drawn


def ticks(low: float, high: float) -> list[float]:
    """Round numbers in a range, about four of them."""
    step = 10 ** math.floor(math.log10(max(high - low, 1e-9)))
    for share in (0.2, 0.5, 1.0):
        if (high - low) / (step * share) <= 6:
            step *= share
            break
    first = math.ceil(low / step)
    return [i * step for i in range(first, math.floor(high / step) + 1)]


def svg(width: int, told: str, drawn: Sequence[str]) -> str:
    """A picture of the usual height, with what it says to those who do not see it."""
    return (
        f'<svg viewBox="0 0 {width} {HEIGHT}" role="img" aria-label="{escape(told)}">'
        f"<title>{escape(told)}</title>{''.join(drawn)}</svg>"
    )


def progress(study: Study) -> str:
    """Distance of each trial, and the farthest so far of the search."""
    walked = [(t, t.result.distance) for t in study.told if t.result]
    points = [(t, d) for t, d in walked if d is not None]
    if not points:
        return ""
    last = max(2, len(study.trials))
    walks = [0.0, *(d for _, d in points)]  # some went backwards
    axes = Axes((0.5, last + 0.5), (min(walks), max(walks)), WIDTH)
    step = max(1, last // 10)
    drawn = axes.frame("trial", "distance, m", range(1, last + 1, step))
    searched = [(t, d) for t, d in points if t.purpose in (Purpose.INITIAL, Purpose.SEARCH)]
    numbers, farthest = [], []
    ends = [t.number for t, _ in searched[1:]] + [last]
    best = accumulate((d for _, d in searched), max)
    for (trial, _), end, distance in zip(searched, ends, best, strict=False):
        numbers += [trial.number, end]
        farthest += [distance] * 2
    drawn.append(axes.line(numbers, farthest, "best"))
    drawn += [_mark(axes, t, d) for t, d in points]
    return svg(WIDTH, f"distances of {len(points)} walks", drawn)


def _mark(axes: Axes, trial: Trial, distance: float) -> str:
    x, y = axes.at(trial.number, distance)
    told = f"trial {trial.number}, {trial.purpose}: {distance:.3f} m"
    kind = "infeasible" if trial.state is TrialState.INFEASIBLE else trial.purpose.value
    return f'<circle class="{kind}" cx="{x}" cy="{y}" r="4.5"><title>{told}</title></circle>'


def slices(posterior: Row, study: Study) -> list[str]:
    """The process along each entry of eta through the best, with twice its deviation."""
    width = 320
    walked = [(t.eta, t.result.distance) for t in study.told if t.result]
    seen = [(eta, d) for eta, d in walked if d is not None]
    everything = [
        edge
        for s in posterior["slices"]
        for m, d in zip(s["mean"], s["deviation"], strict=True)
        for edge in (m - 2 * d, m + 2 * d)
    ] + [d for _, d in seen]
    drawn = []
    for s in posterior["slices"]:
        entry, eta, mean, deviation = s["entry"], s["eta"], s["mean"], s["deviation"]
        axes = Axes((eta[0], eta[-1]), (min(everything), max(everything)), width)
        best = posterior["best"]["eta"][entry]
        marks = axes.frame(f"eta {entry + 1}", "m", [eta[0], (eta[0] + eta[-1]) / 2, eta[-1]])
        upper = [axes.at(x, m + 2 * d) for x, m, d in zip(eta, mean, deviation, strict=True)]
        lower = [axes.at(x, m - 2 * d) for x, m, d in zip(eta, mean, deviation, strict=True)]
        band = " ".join(f"{x},{y}" for x, y in upper + lower[::-1])
        marks.append(f'<polygon class="band" points="{band}"/>')
        marks.append(axes.line(eta, mean, "mean"))
        top, foot = axes.at(best, axes.y[1]), axes.at(best, axes.y[0])
        marks.append(
            f'<line class="chosen" x1="{top[0]}" y1="{top[1]}" x2="{foot[0]}" y2="{foot[1]}"/>'
        )
        for at, distance in seen:
            x, y = axes.at(at[entry], distance)
            marks.append(f'<circle class="seen" cx="{x}" cy="{y}" r="3"/>')
        drawn.append(svg(width, f"expected distance along eta {entry + 1}", marks))
    return drawn
