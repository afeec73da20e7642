"""The section of the report on what is missing: each finding with its size, its law, its rivals."""

from collections.abc import Iterator, Mapping

from pup.diagnosis.drawing import MARKS, ink_on
from pup.diagnosis.laws import NAMELESS
from pup.diagnosis.result import Diagnosis
from pup.diagnosis.sentences import sentence
from pup.diagnosis.verdict import Finding
from pup.diagnosis.wording import Speech, percent, quantity_words
from pup.sysid.html import Column, Html, table, tag
from pup.sysid.wording import listed

HID = 6
"""Nominal parameters told of those that hid a finding, at most."""
BADGE = "border-radius: 1em; padding: 0 0.5em; margin-right: 0.5em;"
"""Looks of a finding's number."""


def badge(number: int) -> Html:
    """A finding's number in its colour, as it stands in the drawing."""
    colour = MARKS[(number - 1) % len(MARKS)]
    looks = f"{BADGE} color: {ink_on(colour)}; background: {colour}"
    return tag("span", str(number), style=looks)


def missing(diagnosis: Diagnosis, speech: Speech) -> Iterator[Html]:
    """Each finding, and what hid it."""
    findings = diagnosis.findings
    hidden = [finding.absorbed_by for finding in findings if finding.absorbed_by]
    shared = len(hidden) > 1 and all(one == hidden[0] for one in hidden)
    for number, finding in enumerate(findings, start=1):
        yield tag("h3", badge(number), speech.heading(finding.effect, finding.place))
        if len(findings) > 1:
            yield tag("p", sentence(diagnosis, finding, speech))
        yield tag("p", *_detail(finding))
        rows = _sizes(finding, speech)
        if rows:
            columns = [Column("Quantity"), Column("Value", "number")]
            columns.append(Column("90 % interval", "number"))
            yield table("Sizes as fitted", columns, rows)
        if finding.absorbed_by and not shared:
            yield tag("p", _absorbed(finding.absorbed_by, speech, "it"))
        yield tag("p", otherwise(finding, speech))
    if shared:  # the parameters moved for all of them at once
        yield tag("h3", "What hid them")
        yield tag("p", _absorbed(hidden[0], speech, "them"))


def otherwise(finding: Finding, speech: Speech) -> str:
    """How sure a finding is, and what else it could be."""
    own = f"Probability {percent(finding.probability)}"
    if finding.effect == NAMELESS:
        return f"{own} that it is there; no effect of the library explains it."
    rest = [
        f"{speech.words(a.effect, a.place)} ({percent(a.probability)})" for a in finding.equivalents
    ]
    if not rest and finding.probability <= 0.5:
        return f"{own}: so much is left that its cause may as well have another name."
    if not rest:
        return f"{own}. No other effect of the library explains these motions nearly as well."
    return f"{own}. These motions would also fit {listed(rest)}."


def _detail(finding: Finding) -> Iterator[str]:
    """When a finding shows, and its law."""
    if finding.regime == "throughout":
        yield "It shows throughout the recordings. "
    else:
        yield f"It shows most {finding.regime}. "
    if finding.law:
        yield "In the simulator: "
        yield tag("code", finding.law)
        yield "."
    elif finding.effect == NAMELESS:
        yield "It is not in the corrected robot, as no law for it holds on motions left out."


def _sizes(finding: Finding, speech: Speech) -> list[tuple[str, str, str]]:
    """Rows of a finding's quantities."""
    rows = []
    for name, p in finding.parameters.items():
        value, low, high = (speech.quantity(v, p.unit, 3) for v in (p.value, p.lower, p.upper))
        rows.append((quantity_words(name), value, f"{low} to {high}"))
    return rows


def _absorbed(absorbed: Mapping[str, float], speech: Speech, it: str) -> str:
    """Which nominal parameters had made up for what was missing."""
    shifts = speech.shifts(absorbed, HID)
    if not shifts:
        return f"The nominal fit hid nothing of {it}: no parameter moves by more than 5 %."
    return f"Without {it}, the nominal fit makes up for {it} by the {shifts}."
