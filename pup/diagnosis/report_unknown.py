"""The section of the report on what no known effect explains."""

import re
from collections.abc import Iterator, Sequence

import numpy as np

from pup.diagnosis.discover import Unexplained
from pup.diagnosis.lacks import Lack
from pup.diagnosis.report_missing import lacking
from pup.diagnosis.result import Diagnosis
from pup.diagnosis.summary import described
from pup.diagnosis.wording import Speech, percent
from pup.physics.terms import Place
from pup.sysid.html import Column, Html, table, tag
from pup.sysid.wording import listed

BEST = 12
"""Channels told of, at most."""
SEEN = 0.1
"""An error of less, in units of the noise, is not worth a word."""
_SYMBOLS = {
    "q": "position",
    "v": "speed",
    "e": "error (command minus position)",
    "u": "torque of the servo",
    "t": "time since the recording's start",
    "age": "time since the command last changed",
    "sgn": "sign",
}


def left(diagnosis: Diagnosis, speech: Speech) -> Iterator[Html]:
    """Where it shows, which laws were tried, and which torque is missing."""
    told = diagnosis.unexplained
    if told is None:
        return
    known = _known(told, speech)
    beside = f"With {listed(known)} in the model" if known else "With no effect in the model"
    lacks = sorted(told.lacks, key=lambda one: -max(one.surprise, one.repeated_surprise))
    yield tag("p", f"{beside}, more than noise is left. {_worst(lacks, speech)}")
    yield from _laws(told, described(diagnosis, told.finding))
    if lacks:
        yield _table(lacks[:BEST], speech)
    if known:  # else it is the torque that the nominal model lacks, told above
        yield tag("h3", "The torque that is still missing")
        yield from lacking(diagnosis, speech, told.missing, "the model with the known effects")


def _known(told: Unexplained, speech: Speech) -> list[str]:
    """The known effects that are in the model, each with its places."""
    places: dict[str, list[Place]] = {}
    for hypothesis in told.model.hypotheses:
        places.setdefault(hypothesis.effect, []).append(hypothesis.place)
    return [speech.lack(effect, where) for effect, where in places.items()]


def _worst(lacks: Sequence[Lack], speech: Speech) -> str:
    """Where most is left, and what speaks for it."""
    if not lacks:
        return ""
    worst = lacks[0]
    parts = []
    if worst.repeated is not None and worst.repeated > SEEN**2:
        parts.append(f"{_root(worst.repeated)} come back when a motion is repeated")
    if worst.explained > SEEN**2:
        parts.append(f"a torque would explain {_root(_by_torque(worst))}")
    more = f", of which {listed(parts)}" if parts else ""
    where = speech.channels()[worst.channel]
    return f"Clearest at the {where}: errors are {_root(1 + worst.excess)} times the noise{more}."


def _laws(told: Unexplained, share: float) -> Iterator[Html]:
    """The laws that were tried, with a key to their symbols; the first explains a share of it."""
    kept = bool(told.terms)
    yield tag("h3", "Laws for it")
    if not told.laws:
        yield tag("p", "No law of what a servo sees and does comes near to explaining it.")
        return
    verdict = (
        "The first is in the corrected robot: it holds on motions that were left out of the fit, "
        f"and explains {percent(share)} of what is more than noise."
        if kept
        else "None of them predicts motions that were left out of the fit, so none is in the "
        "corrected robot. They are hints."
    )
    rows = [
        (tag("code", law), "in the corrected robot" if kept and i == 0 else "not added")
        for i, law in enumerate(told.laws)
    ]
    yield table(verdict, [Column("Law", "long"), Column("")], rows)
    tokens = set(re.findall("[a-z]+", " ".join(told.laws)))
    key = [f"{symbol} {meaning}" for symbol, meaning in _SYMBOLS.items() if symbol in tokens]
    if key:
        yield tag("p", f"Symbols: {', '.join(key)}.")


def _table(lacks: Sequence[Lack], speech: Speech) -> Html:
    """How far the errors of channels are from noise."""
    columns = [Column("Where"), Column("Error", "number"), Column("Above noise by", "number")]
    columns += [Column("Comes back", "number"), Column("Above chance by", "number")]
    columns.append(Column("A torque explains", "number"))
    rows = [
        (
            speech.channels()[one.channel],
            _root(1 + one.excess),
            f"{max(one.surprise, 0.0):.1f} sd",
            "not repeated" if one.repeated is None else _root(one.repeated),
            "" if one.repeated is None else f"{max(one.repeated_surprise, 0.0):.1f} sd",
            _root(_by_torque(one)),
        )
        for one in lacks
    ]
    caption = (
        "Errors in units of the noise: their root mean square, how much of it comes back when a "
        "motion is repeated (noise does not), and how much torques at the joints would explain. "
        "sd: standard deviations."
    )
    return table(caption, columns, rows)


def _by_torque(one: Lack) -> float:
    """Mean square that a torque explains; on one channel it may be more than the error there."""
    return min(one.explained, 1 + one.excess)


def _root(square: float) -> str:
    return f"{np.sqrt(max(square, 0.0)):.2f}"
