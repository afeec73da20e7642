"""Sections of the report that show errors: before and after, and where and when they happen."""

from collections.abc import Iterator, Mapping

import numpy as np

from pup.diagnosis import summary
from pup.diagnosis.figures import (
    COLOURS,
    Traced,
    error_bars,
    misfit_map,
    misfit_norm,
    misfit_time,
    window,
)
from pup.diagnosis.folds import fold_words
from pup.diagnosis.result import Diagnosis
from pup.diagnosis.summary import View
from pup.diagnosis.wording import Speech, capital, percent, spoken
from pup.sysid.figures import INK, SOFT
from pup.sysid.html import Html, figure, tag
from pup.sysid.wording import listed, thousandths

PANELS = 6
"""Windows and recordings that are drawn, at most; maps of recordings twice as many."""
WIDE = "grid-template-columns: repeat(auto-fill, minmax(min(22rem, 100%), 1fr))"
"""Two maps side by side, or one on a phone."""
BINS = 80
"""Stretches of time that a recording is mapped in."""


def before_and_after(diagnosis: Diagnosis, speech: Speech) -> Iterator[Html]:
    """Held-out errors per joint and motion type, and the windows that tell most."""
    held = diagnosis.held_out
    if held is None or diagnosis.model is None:
        return
    corrected = summary.corrected(diagnosis)
    yield tag(
        "p",
        f"Every error here is of a prediction: one {fold_words(diagnosis.measured)} at a time was "
        "left out, the model fitted to all others, and its simulation compared with it.",
    )
    noise = summary.joint_noise(diagnosis)
    joints = {spoken(name): pair for name, pair in held.per_joint.items()}
    bars = [("joint", joints, noise), ("type of motion", held.per_motion, noise)]
    if held.per_tilt:
        bars.append(("angle of the torso", held.per_tilt, summary.tilt_noise(diagnosis)))
    for what, told, floor in bars:
        if len(told) < 2 and what == "joint" and len(held.per_motion) > 1:
            continue
        pairs = [pair if corrected else pair[:1] for pair in told.values()]
        drawing = error_bars(list(told), pairs, speech.units.small, floor)
        takeaway = _takeaway(told, speech, corrected)
        yield figure(drawing, f"Bars of held-out errors per {what}. {takeaway}", takeaway)
    yield from _windows(diagnosis, speech)


def _takeaway(told: Mapping[str, tuple[float, float]], speech: Speech, corrected: bool) -> str:
    """What bars of errors say."""
    small = speech.units.small
    if not corrected:
        name = max(told, key=lambda n: told[n][0])
        return f"The largest error is that of {name}: {thousandths(told[name][0])} {small}."
    name = max(told, key=lambda n: told[n][0] ** 2 - told[n][1] ** 2)
    before, after = told[name]
    worse = [f"{n} by {percent(a / b - 1)}" for n, (b, a) in told.items() if a > 1.02 * b]
    name = capital(name)
    but = f" Worse: {listed(worse)}." if worse else " None gets worse."
    return (
        f"{name} gains most: from {thousandths(before)} to {thousandths(after)} {small} "
        f"({percent(1 - after / before)} less).{but}"
    )


def _windows(diagnosis: Diagnosis, speech: Speech) -> Iterator[Html]:
    """The windows in which findings show best, else the largest errors that are left."""
    count = len(diagnosis.findings)
    if count:
        each = max(1, PANELS // count)
        groups = [
            (
                speech.heading(finding.effect, finding.place),
                summary.telling(diagnosis, finding, each),
            )
            for finding in diagnosis.findings
        ]
    else:
        groups = [("Windows with the largest errors", summary.worst(diagnosis, PANELS // 2))]
    key = [("command", SOFT, "solid"), ("measured", INK, "dotted")]
    dashes = {"nominal": "dashed", "corrected": "solid"}
    key += [(name, COLOURS[name], dashes[name]) for name in summary.models(diagnosis)]
    shown = False
    for title, views in groups:
        if not views:
            continue
        yield tag("h3", title)
        if not shown:
            shown = True
            yield tag(
                "ul",
                *(
                    tag("li", tag("span", style=f"border-top: 3px {dash} {colour}"), name)
                    for name, colour, dash in key
                ),
                class_="key",
            )
            best = "The windows that show it best are shaded. " if count else ""
            yield tag(
                "p",
                f"{best}Above, positions; below, measured minus simulated, with the noise as a "
                "grey band.",
            )
        yield tag("div", *(_panel(diagnosis, speech, view) for view in views), class_="panels")


def _panel(diagnosis: Diagnosis, speech: Speech, view: View) -> Html:
    """One window, drawn."""
    measured = diagnosis.measured
    number = [r.id for r in measured.recordings].index(view.window.recording)
    recording = measured.recordings[number]
    chosen = (measured.recording == number) & (measured.channel == view.channel)
    chosen &= (measured.time >= view.start) & (measured.time <= view.end)
    joints = diagnosis.robot.joint_names
    tilts = view.channel >= len(joints)
    turns = tilts or speech.units.turning
    factor = float(np.degrees(1)) if turns else 1000.0
    unit, small = ("°", "mrad") if turns else (speech.units.small, speech.units.small)
    models = summary.models(diagnosis)
    command = None
    if not tilts:
        elapsed = recording.time - recording.time[0]
        inside = np.flatnonzero((elapsed >= view.start) & (elapsed <= view.end))
        column = recording.target[:, recording.joints.index(joints[view.channel])]
        command = elapsed[inside], factor * column[inside]
    drawing = window(
        Traced(
            time=measured.time[chosen],
            measured=factor * measured.values[chosen],
            models={(n, COLOURS[n]): factor * m.predicted[chosen] for n, m in models.items()},
            command=command,
            noise=1000 * float(np.sqrt(np.mean(measured.deviation(diagnosis.noise)[chosen] ** 2))),
            span=(view.window.start, view.window.end),
            unit=unit,
            small=small,
            factor=1000 / factor,
        )
    )
    errors = {
        label: float(np.sqrt(np.mean((measured.values - m.predicted)[chosen] ** 2)))
        for label, m in models.items()
    }
    told = " → ".join(f"{thousandths(e)}" for e in errors.values())
    where = f"{speech.channels()[view.channel]} in {recording.id}"
    caption = f"{where}: error {told} {small}"
    return figure(drawing, f"Over time, {caption} ({' → '.join(errors)}).", caption)


def maps(diagnosis: Diagnosis, speech: Speech) -> Iterator[Html]:
    """Errors by regime of motion, and over the time of each recording."""
    fit = diagnosis.nominal.fit
    regimes, before = summary.by_regime(diagnosis, fit)
    names = [speech.channels()[c] for c in summary.channels(diagnosis)]
    inner = before[:, 1:]
    if not np.isfinite(before).any():
        return
    norm = misfit_norm(before)
    fitted = diagnosis.nominal.certificate.made
    model = "nominal model, fitted to all recordings" if fitted else "robot as it is described"
    yield tag(
        "p",
        f"Errors of the {model}, in units of the noise: 1 is noise alone. Joints where the cause "
        "sits are not always those where it shows.",
    )
    if np.isfinite(inner).any():
        row, column = np.unravel_index(np.nanargmax(inner), inner.shape)
        worst = inner[row, column]
        takeaway = (
            f"Largest {regimes[column + 1]}, at the {names[row]}: {worst:.1f} times the noise."
        )
    else:
        takeaway = "No regime of motion has enough readings to be told of."
    panels = [
        figure(
            misfit_map(names, regimes, before, norm),
            f"Heat map of errors by joint and regime. {takeaway}",
            f"{'Nominal model' if fitted else 'Robot as it is described'}. {takeaway}",
        )
    ]
    corrected = summary.models(diagnosis).get("corrected")
    if corrected is not None:
        _, after = summary.by_regime(diagnosis, corrected.fit)
        panels.append(
            figure(
                misfit_map(names, regimes, after, norm),
                "Heat map of errors of the corrected model.",
                "Corrected model, same colours. The largest number left is "
                f"{np.nanmax(after):.1f}.",
            )
        )
    yield tag("div", *panels, class_="panels", style=WIDE)
    yield from _over_time(diagnosis, speech)


def _over_time(diagnosis: Diagnosis, speech: Speech) -> Iterator[Html]:
    """Maps of joints over time, of the recordings that fit worst."""
    fit, measured = diagnosis.nominal.fit, diagnosis.measured
    numbers = [int(n) for n in np.unique(measured.recording)]
    total = {n: summary.misfit(diagnosis, fit, measured.recording == n) for n in numbers}
    shown = sorted(numbers, key=lambda n: -np.nan_to_num(total[n]))[: 2 * PANELS]
    names = [speech.channels()[c] for c in summary.channels(diagnosis)]
    told = {n: summary.by_time(diagnosis, fit, n, BINS) for n in shown}
    norm = misfit_norm(np.concatenate([values.ravel() for _, values in told.values()]))
    yield tag("h3", "Over time")
    first = measured.recordings[shown[0]].id
    few = f" The {len(shown)} worst of {len(numbers)}." if len(shown) < len(numbers) else ""
    yield tag(
        "p",
        f"The darker, the further off; pale is noise. Worst is {first}, "
        f"{total[shown[0]]:.1f} times the noise.{few}",
    )
    yield tag(
        "div",
        *(
            figure(
                misfit_time(names, *told[n], norm),
                f"Heat map of errors over time in {measured.recordings[n].id}.",
                f"{measured.recordings[n].id}: {total[n]:.1f} times the noise",
            )
            for n in shown
        ),
        class_="panels",
    )
