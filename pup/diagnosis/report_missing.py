"""Part of the report: the torques that a model lacks, where and when."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis import summary
from pup.diagnosis.discover import EVIDENCE
from pup.diagnosis.figures_missing import Pushed, torque_ranking, torque_window
from pup.diagnosis.locate import BAND, MissingInput
from pup.diagnosis.result import Diagnosis
from pup.diagnosis.wording import Speech, digits, minus, percent
from pup.physics.model import compile_model
from pup.sysid.html import Column, Html, figure, table, tag
from pup.sysid.wording import counted, listed

Array = NDArray[np.float64]

PANELS = 4
"""Channels that are drawn over time, at most."""
BEST = 12
"""Joints shown of a ranking."""
NAMED = 4
"""Places named in a sentence, at most."""
FAINT = 1.0
"""Evidence of less is not drawn."""
LASTS = 4.0
"""A torque is shown for so long, s."""
GRAVITY = 9.81
_WORDS = {"force": "force on the torso along", "torque": "torque on the torso about"}


@dataclass(frozen=True)
class Stretch:
    """Where a channel's missing torque is most certain.

    Attributes:
      recording: its number.
      knots: those that are shown.
    """

    recording: int
    knots: slice


@dataclass(frozen=True)
class _Channel:
    """One channel of a missing input, as it is told.

    Attributes:
      number: among the channels.
      name: in words.
      strength: with its unit.
      share: strength over what the servo can give, or the force over the robot's weight.
      whole: what that is a share of.
      evidence: for it.
    """

    number: int
    name: str
    strength: str
    share: float
    whole: str
    evidence: float

    @property
    def size(self) -> str:
        """Strength and share."""
        return f"{self.strength}, {percent(self.share)}" if self.whole else self.strength


def torques(diagnosis: Diagnosis, speech: Speech) -> Iterator[Html]:
    """The torques that the nominal model lacks."""
    if diagnosis.missing is None:
        return
    yield tag("h3", "The torque that is missing")
    yield tag(
        "p",
        "Every joint was allowed an unknown torque at every time, beside what the nominal "
        "parameters can make up for. Evidence says how much more probable the readings are with "
        "that torque than without, as a natural logarithm: "
        f"{EVIDENCE:.0f} are odds of 22,000 to 1.",
    )
    yield from lacking(diagnosis, speech, diagnosis.missing, "the nominal model")


def lacking(
    diagnosis: Diagnosis, speech: Speech, missing: MissingInput, model: str
) -> Iterator[Html]:
    """What a model lacks: a sentence, a ranking, and the clearest torques over time.

    Args:
      diagnosis: whose model.
      speech: of the robot.
      missing: the torques.
      model: what the model is called.
    """
    told = [c for c in _channels(diagnosis, speech, missing) if c.evidence > FAINT]
    sure = [c for c in told if c.evidence > EVIDENCE]
    yield tag("p", _takeaway(sure, len(diagnosis.robot.joints), model))
    yield from _ranking(diagnosis, speech, missing, told)
    panels = [_panel(diagnosis, speech, missing, channel) for channel in sure[:PANELS]]
    if panels:
        yield tag(
            "p",
            "When it is missing: each torque where it is most certain, with its 90 % band; above, "
            "the joint's readings and its command (grey).",
        )
        yield tag("div", *panels, class_="panels")


def clearest(missing: MissingInput, channel: int) -> Stretch:
    """The stretch in which a channel's torque stands out most from its own uncertainty."""
    best, found = -1.0, Stretch(0, slice(0, 1))
    for number, time in enumerate(missing.time):
        mean, deviation = (v[number][:, channel] for v in (missing.mean, missing.deviation))
        known = deviation > 0
        squares = np.where(known, mean / np.where(known, deviation, 1.0), 0.0) ** 2
        period = float(time[1] - time[0]) if len(time) > 1 else LASTS
        width = int(np.clip(round(LASTS / period), 1, len(time)))
        sums = np.convolve(squares, np.ones(width), "valid")
        start = int(np.argmax(sums))
        if sums[start] > best:
            best, found = float(sums[start]), Stretch(number, slice(start, start + width))
    return found


def _channels(diagnosis: Diagnosis, speech: Speech, missing: MissingInput) -> list[_Channel]:
    """All channels, that of most evidence first."""
    joints = len(diagnosis.robot.joints)
    limits, weight = summary.limits(diagnosis), np.nan
    if missing.evidence[joints:].max(initial=0.0) > FAINT:
        masses = compile_model(diagnosis.robot, "ground").compiled.body_mass
        weight = GRAVITY * float(masses.sum())
    told = []
    for i in np.argsort(-missing.evidence):
        strength, name = float(missing.strength[i]), missing.channels[i]
        whole, most = "", np.nan
        if i < joints:
            name, most = speech.channels()[i], float(limits[i])
            whole = "of what its servo can give"
        else:
            kind, _, axis = name.partition(" ")
            name = f"{_WORDS[kind]} {axis}"
            if kind == "force":
                most, whole = weight, "of the robot's weight"
        share = strength / most
        told.append(
            _Channel(
                int(i),
                name,
                f"{digits(strength)} {speech.unit(missing.units[i])}",
                share,
                whole if np.isfinite(share) else "",
                float(missing.evidence[i]),
            )
        )
    return told


def _takeaway(sure: Sequence[_Channel], joints: int, model: str) -> str:
    """Where a torque is missing, in a sentence or two."""
    if not sure:
        return (
            f"No torque at any joint makes the readings much more probable: what {model} lacks "
            "does not act as a torque, or changes faster than these readings can show."
        )
    first = sure[0]
    share = f", {percent(first.share)} {first.whole}" if first.whole else ""
    text = (
        f"What {model} lacks shows most clearly {_at(first, joints)}: typically "
        f"{first.strength}{share}."
    )
    rest = [_at(channel, joints) for channel in sure[1 : 1 + NAMED]]
    more = len(sure) - 1 - len(rest)
    rest += [f"at {counted(more, 'more place')}"] if more else []
    return f"{text} Also {listed(rest)}." if rest else text


def _at(channel: _Channel, joints: int) -> str:
    return f"at the {channel.name}" if channel.number < joints else f"as a {channel.name}"


def _ranking(
    diagnosis: Diagnosis, speech: Speech, missing: MissingInput, told: Sequence[_Channel]
) -> Iterator[Html]:
    """Bars of the joints, and a table of the forces and torques on the torso."""
    joints = len(diagnosis.robot.joints)
    shown = [c for c in told if c.number < joints][:BEST]
    if shown:
        numbers = [c.number for c in shown]
        drawing = torque_ranking(
            [c.name for c in shown],
            missing.evidence[numbers],
            missing.strength[numbers],
            [percent(c.share) if c.whole else "" for c in shown],
            speech.unit("N m"),
            EVIDENCE,
        )
        sizes = listed([f"{c.name} {c.size}" for c in shown[:NAMED]])
        rest = " Joints that are not shown lack nothing." if len(shown) < joints else ""
        yield figure(
            drawing,
            f"Bars of evidence and strength of a missing torque by joint: {sizes}.",
            "Typical: the standard deviation of the torque over time; beside it, its share of the "
            f"servo's limit.{rest}",
        )
    pushed = [c for c in told if c.number >= joints]
    if pushed:
        columns = [Column("On the torso"), Column("Evidence", "number")]
        columns += [Column("Typical strength", "number"), Column("Share of the weight", "number")]
        rows = [
            (c.name, f"{c.evidence:,.0f}", c.strength, percent(c.share) if c.whole else "")
            for c in pushed
        ]
        yield table(
            "Where joints do not explain it, a wrench on the torso may: it stands for the ground "
            "and for whatever touches the robot.",
            columns,
            rows,
        )


def _panel(diagnosis: Diagnosis, speech: Speech, missing: MissingInput, channel: _Channel) -> Html:
    """One channel's torque, where it is most certain."""
    stretch = clearest(missing, channel.number)
    number = stretch.recording
    time, mean, deviation = (
        v[number][stretch.knots] for v in (missing.time, missing.mean, missing.deviation)
    )
    mean, deviation = mean[:, channel.number], deviation[:, channel.number]
    measured = diagnosis.measured
    readings = command = None
    factor = float(np.degrees(1)) if speech.units.turning else 1000.0
    if channel.number < len(diagnosis.robot.joints):
        readings, command = _motion(diagnosis, channel.number, number, time, factor)
    unit = speech.unit(missing.units[channel.number])
    drawing = torque_window(
        Pushed(
            time,
            mean,
            BAND * deviation,
            unit,
            readings,
            command,
            "°" if speech.units.turning else speech.units.small,
        )
    )
    most = int(np.argmax(np.abs(mean)))
    caption = minus(
        f"{channel.name} in {measured.recordings[number].id}: largest at {time[most]:.1f} s, "
        f"{digits(mean[most])} ± {digits(BAND * deviation[most])} {unit}"
    )
    return figure(drawing, f"Missing torque over time, {caption}.", caption)


def _motion(
    diagnosis: Diagnosis, joint: int, number: int, time: Array, factor: float
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Readings and command of a joint over some time."""
    measured = diagnosis.measured
    recording = measured.recordings[number]
    chosen = (measured.recording == number) & (measured.channel == joint)
    chosen &= (measured.time >= time[0]) & (measured.time <= time[-1])
    elapsed = recording.time - recording.time[0]
    inside = (elapsed >= time[0]) & (elapsed <= time[-1])
    column = recording.joints.index(diagnosis.robot.joint_names[joint])
    return (
        (measured.time[chosen], factor * measured.values[chosen]),
        (elapsed[inside], factor * recording.target[inside, column]),
    )
