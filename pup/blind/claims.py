"""What a diagnosis claims: the names it gives, the first of them first."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pup.blind.catalogue import CLASS_OF

SHARP = 0.8  # share of a finding's probability from which a name counts as a sharp claim
UNKNOWN = "unknown"  # what a finding outside the list is called
VERDICTS = ("mismatch", "none", "undetermined")
ROUNDING = 1e-9  # by which a probability may be outside of 0 to 1


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


def check(document: Mapping[str, Any], robot: str) -> None:
    """Refuse a diagnosis of which a word or a number would be counted in silence as something else.

    Args:
      document: the diagnosis.
      robot: of the case.

    Raises:
      ValueError: the verdict is none of the contract's, it is of another robot, a number in a
        finding is none, or a probability is no share.
    """
    if document["verdict"] not in VERDICTS:
        raise ValueError(f"verdict {document['verdict']!r} is none of {', '.join(VERDICTS)}")
    if document.get("robot", robot) != robot:
        raise ValueError(f"robot {document['robot']!r}, in a case of {robot!r}")
    findings = document.get("findings", [])
    if not all(math.isfinite(number) for number in _numbers(findings)):
        raise ValueError("a number in a finding is not finite")
    for one in (e for finding in findings for e in (finding, *finding.get("equivalents", []))):
        if not -ROUNDING <= float(one["probability"]) <= 1.0 + ROUNDING:
            raise ValueError(f"probability {one['probability']} is not between 0 and 1")


def _numbers(value: object) -> Iterator[float]:
    """All numbers in a JSON value."""
    if isinstance(value, float):
        yield value
    elif isinstance(value, Mapping | list):
        for part in value.values() if isinstance(value, Mapping) else value:
            yield from _numbers(part)


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
