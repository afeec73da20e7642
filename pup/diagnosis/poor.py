"""Recordings that cannot show anything, or not what they seem to: said before any fit is believed.

A simulator fits a dead encoder, a clipped one or two exchanged columns with whatever physics it
has, and well enough to sound sure. Each of these leaves a mark in the readings themselves.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.residuals import SETTLING, Measured
from pup.physics.terms.scale import Scale
from pup.sysid.accuracy import JointUnits

Array = NDArray[np.float64]

FEWEST = 60
"""Samples below which nothing can be said."""
MOTION = 0.02
"""A joint that never moves by as much shows nothing, rad; slides as much less as their range is."""
SLOWEST = 0.12
"""Readings further apart tell nothing of a servo, which answers within a tenth of a second, s."""
ASKED, DEAD = 0.1, 0.05
"""A joint that is asked to move by as much, rad, and moves by less than this share of it, is dead
or blocked."""
CLIPPED, USUAL, WIDE = 8, 0.34, 0.2
"""So many equal readings in a row at an end of the range are a clipped encoder's, where no others
are as long as this share of them, and commands meanwhile range as widely, rad."""
FEW = 10
"""Values that a recording must have to have ends."""
EXCHANGED = 0.5
"""A joint's readings follow another's commands where they are off by less than this share of what
they are off from its own."""
LATEST = 0.2
"""Lag up to which a servo may follow its own commands, s."""


@dataclass(frozen=True)
class Poor:
    """What is wrong with recordings.

    Attributes:
      reason: why they can show nothing.
      cure: what to do when the same motions are recorded again; empty where others are needed.
    """

    reason: str
    cure: str = ""


def why_poor(measured: Measured) -> Poor | None:
    """Why some recordings can show nothing; None where they may."""
    return next(_reasons(measured), None)


def _reasons(measured: Measured) -> Iterator[Poor]:
    if len(measured.values) < FEWEST:
        yield Poor(f"{len(measured.values)} readings are too few to tell anything")
        return
    joints = range(len(measured.robot.joints))
    angle = Scale.of(measured.robot).angle
    every = range(len(measured.recordings))
    moves = [
        max(
            _reach(measured.values[(measured.channel == j) & (measured.recording == i)])
            for i in every
        )
        for j in joints
    ]
    targets = _ordered(measured, [r.target for r in measured.recordings])
    wanted = [max(_reach(target[:, j]) for target in targets) for j in joints]
    if max(moves) < MOTION * angle and max(wanted) < ASKED * angle:
        unit = JointUnits.of(measured.robot, measured.recordings).position
        yield Poor(f"no joint moves by more than {MOTION * angle:.2g} {unit}")
    read = [r.id for i, r in enumerate(measured.recordings) if measured.only([i]).any()]
    if len(read) < 2:
        only = f"only {read[0]} has readings after its first {SETTLING:g} s, and "
        yield Poor(
            f"{only if len(every) > 1 else ''}one recording leaves nothing to check a finding on; "
            "record a second motion"
        )
    step = np.diff(measured.time)
    apart = float(np.median(step[step > 0]))
    if apart > SLOWEST:
        yield Poor(
            f"readings are {apart:.2g} s apart, and servos answer within 0.1 s; record at 20 Hz or "
            "faster",
            "read at 20 Hz or faster",
        )
    for j, name in enumerate(measured.robot.joint_names):
        if wanted[j] >= ASKED * angle and moves[j] < DEAD * wanted[j]:
            yield Poor(
                f"{name} hardly moves though it is asked to: its encoder is dead or the joint is "
                "blocked; look at it, or leave these recordings out",
                f"with {name} mended",
            )
        if _clipped(measured, j, WIDE * angle):
            yield Poor(
                f"readings of {name} stop short at an end of their range, again and again at the "
                "same value: they are clipped; record with the encoder's whole range",
                f"with the whole range of the encoder of {name}",
            )
    exchanged = _exchanged(measured, targets, ASKED * angle, 1 + int(LATEST / apart))
    if exchanged:
        yield Poor(
            f"readings of {exchanged[0]} follow the commands of {exchanged[1]}: columns or servo "
            "ids are exchanged",
            f"with the servo ids of {exchanged[0]} and {exchanged[1]} put right",
        )


def _reach(values: Array) -> float:
    known = values[~np.isnan(values)]
    return float(np.ptp(known)) if len(known) else 0.0


def _ordered(measured: Measured, values: Sequence[Array]) -> list[Array]:
    """Columns of each recording in the robot's order, shape (n_ticks, n_joints), rad."""
    names = measured.robot.joint_names
    return [
        v[:, [r.joints.index(n) for n in names]]
        for v, r in zip(values, measured.recordings, strict=True)
    ]


def _clipped(measured: Measured, joint: int, wide: float) -> bool:
    """Whether readings stand still at an end of their range alone, whatever is commanded."""
    name, ends, others, asked = measured.robot.joint_names[joint], 0, 0, 0.0
    for number, recording in enumerate(measured.recordings):
        own = (measured.channel == joint) & (measured.recording == number)
        values = measured.values[own]
        if len(np.unique(values)) < FEW:
            continue
        tick = np.searchsorted(recording.time - recording.time[0], measured.time[own] - 1e-9)
        target = recording.target[tick, recording.joints.index(name)]
        edges = np.flatnonzero(np.r_[True, np.diff(values) != 0, True])
        lengths = np.diff(edges)
        for end in (values.min(), values.max()):
            long = [
                slice(start, start + length)
                for start, length in zip(edges, lengths, strict=False)
                if values[start] == end and length >= CLIPPED
            ]
            if long:
                ends = max(ends, *(run.stop - run.start for run in long))
                asked = max(asked, _reach(np.concatenate([target[run] for run in long])))
        inside = (values[edges[:-1]] > values.min()) & (values[edges[:-1]] < values.max())
        others = max(others, int(lengths[inside].max()))
    return asked > wide and others < USUAL * ends


def _exchanged(
    measured: Measured, targets: Sequence[Array], least: float, lags: int
) -> tuple[str, str] | None:
    """A joint whose readings follow another's commands, and that other.

    Joints that follow one another in time, as in a gait, are told apart by letting each follow its
    own commands late: a servo that lags, by less than so many ticks, is no exchange.
    """
    asked = np.concatenate(targets)
    read = np.concatenate(_ordered(measured, [r.position for r in measured.recordings]))
    names = measured.robot.joint_names

    def off(joint: int, other: int) -> float:
        return float(np.nanstd(read[:, joint] - asked[:, other]))

    late = [np.concatenate([_later(target, lag) for target in targets]) for lag in range(lags)]
    own = {
        joint: min(float(np.nanstd(read[:, joint] - told[:, joint])) for told in late)
        for joint in range(len(names))
        if not np.isnan(read[:, joint]).all()
    }
    for joint, other in permutations(range(len(names)), 2):
        told = joint in own and _reach(asked[:, other]) >= least
        if told and off(joint, other) < EXCHANGED * own[joint]:
            return names[joint], names[other]
    return None


def _later(target: Array, lag: int) -> Array:
    """Commands so many ticks later, shape (n_ticks, n_joints)."""
    return np.concatenate([np.repeat(target[:1], lag, axis=0), target])[: len(target)]
