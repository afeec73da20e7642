"""What a diagnosis claims: the names it gives, the first of them first."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pup.blind.catalogue import CLASS_OF

SHARP = 0.8  # share of a finding's probability from which a name counts as a sharp claim
UNKNOWN = "unknown"  # what a finding outside the list is called


@dataclass(frozen=True)
class Named:
    """One explanation in a diagnosis: a finding or one of its equivalents.

    Attributes:
      effect: its name.
      place: as in the document.
      probability: of it.
      finding: index of the finding it belongs to.
      head: whether it is that finding, not one of its equivalents.
    """

    effect: str
    place: Mapping[str, Any]
    probability: float
    finding: int
    head: bool


def ranking(findings: Sequence[Mapping[str, Any]]) -> list[Named]:
    """Findings and their equivalents: what is claimed first, then all others by probability.

    First is the first finding, for findings stand most important first (contract, section 5); a
    finding `unknown` is where it is more probable than that one. Among equals the others stay as
    they stand in the document, each finding before its equivalents.
    """
    groups = [
        [
            Named(
                str(e["effect"]),
                e["place"],
                float(e["probability"]),
                index,
                e is finding,
            )
            for e in (finding, *finding.get("equivalents", []))
        ]
        for index, finding in enumerate(findings)
    ]
    if not groups:
        return []
    heads = [group[0] for group in groups]
    rivals = [head for head in heads if head.effect == UNKNOWN]
    first = max([heads[0], *rivals], key=lambda n: n.probability)
    others = [n for group in groups for n in group if n is not first]
    return [first, *sorted(others, key=lambda n: -n.probability)]


def sharp(findings: Sequence[Mapping[str, Any]]) -> bool:
    """Whether one effect has nearly all of the first finding's probability."""
    mass: dict[str, float] = {}
    for finding in findings[:1]:
        for one in (finding, *finding.get("equivalents", [])):
            mass[one["effect"]] = mass.get(one["effect"], 0.0) + float(one["probability"])
    return bool(mass) and max(mass.values()) >= SHARP * sum(mass.values())


def confidence(named: Sequence[Named]) -> float | None:
    """Probability of the class that is named first, its members in the same finding added up."""
    if not named:
        return None
    first = named[0]
    members = [n for n in named if n.finding == first.finding]
    return min(
        1.0, sum(n.probability for n in members if class_of(n.effect) == class_of(first.effect))
    )


def rank(named: Sequence[str], right: set[str]) -> int | None:
    """Place of the first right name among different ones, from 1."""
    different = list(dict.fromkeys(named))
    return next((n for n, name in enumerate(different, start=1) if name in right), None)


def class_of(effect: str) -> str:
    """The class of an effect; what is not on the list is one of its own."""
    return CLASS_OF.get(effect, effect)
