"""What one diagnosis got right of one case."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np

from pup.blind.absorb import FAINT
from pup.blind.catalogue import CLASS_OF
from pup.blind.places import covered, credit
from pup.robot import RobotDescription

SHARP = 0.8  # share of a finding's probability from which a name counts as a sharp claim
STATED = 0.5  # probability from which `unknown` counts though something else stands first
PER_SECOND = 100  # resolution in which spans of time are compared
CALM = "null:nuisance"  # the nulls that have a nuisance
UNKNOWN = "unknown"  # what a finding outside the list is called
OWN_LINES = ("weak", "unidentifiable")  # strata in which little to be gained is the rule


@dataclass(frozen=True)
class Named:
    """One explanation in a diagnosis: a finding or one of its equivalents.

    Attributes:
      effect: its name.
      place: as in the document.
      probability: of it.
      finding: index of the finding it belongs to.
    """

    effect: str
    place: Mapping[str, Any]
    probability: float
    finding: int


@dataclass(frozen=True)
class Judged:
    """The verdict on a case, judged. What does not apply is None.

    Attributes:
      id: of the case.
      robot: its name.
      stratum: of the case.
      null: whether nothing is missing.
      excused: whether it is a null whose nuisance is material.
      visible: whether it is a null whose nuisance is not, yet clear enough to be detected.
      immaterial: whether what is missing gains too little on held-out motions to be material.
      absorbed: share of what is missing that a refit hides.
      nuisance: what a complete model of a null's nuisance gains, in units of sigma.
      verdict: the diagnosis's, or `missing`.
      exact: rank of the first right effect, from 1.
      kind: rank of the first right class, from 1.
      all_found: whether every effect's class stands among the first three, each in a finding of
        its own.
      place: credit for the place that is named first, 0 to 1; None on a robot of one joint.
      background: whether what stands first is a nuisance that is there, by class and place.
      place_background: as `place`, such a nuisance's place counted as right.
      covered: whether the first finding and its equivalents hold the truth.
      size: how many effects those are.
      sharp: whether the first finding is all but a single effect.
      allowed: whether the verdict is one that the data allow.
      unknown: whether something outside the list is told of.
      confidence: probability of the class named first.
      regime: F1 of the times at which it is said to act.
      errors: relative errors of comparable parameters.
      inside: whether their 90 % intervals hold the truth.
      ambiguous: whether more than one effect, or no verdict, is left standing.
      next: whether a next recording is proposed.
      seconds: how long the diagnosis took.
      oracle: share of the possible gain on the test motions that was had.
      named: the first three effects, for the list of failures.
    """

    id: str
    robot: str
    stratum: str
    null: bool
    excused: bool
    verdict: str
    visible: bool = False
    immaterial: bool = False
    absorbed: float | None = None
    nuisance: float | None = None
    exact: int | None = None
    kind: int | None = None
    all_found: bool | None = None
    place: float | None = None
    background: bool = False
    place_background: float | None = None
    covered: bool | None = None
    size: int | None = None
    sharp: bool = False
    allowed: bool = False
    unknown: bool = False
    confidence: float | None = None
    regime: float | None = None
    errors: tuple[float, ...] = ()
    inside: tuple[bool, ...] = ()
    ambiguous: bool = False
    next: bool = False
    seconds: float | None = None
    oracle: float | None = None
    named: tuple[str, ...] = field(default=())


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


def judge(
    truth: Mapping[str, Any],
    diagnosis: Mapping[str, Any] | None,
    robot: RobotDescription,
    oracle: float | None = None,
    repeats: Collection[str] = (),
) -> Judged:
    """Judge one diagnosis. Findings count where its verdict is a mismatch.

    Args:
      truth: the case's entry in the key.
      diagnosis: its document; None where there is none.
      robot: of the case.
      oracle: share of the possible gain on the test motions that was had.
      repeats: ids of its recordings that repeat another.
    """
    document = diagnosis or {"verdict": "missing"}
    verdict = str(document["verdict"])
    findings = document.get("findings", []) if verdict == "mismatch" else []
    named = ranking(findings)
    group = _group(findings)
    background = _background(robot, named, truth.get("nuisance", []))
    stood = _stood(truth)
    case: dict[str, Any] = {
        "id": truth["id"],
        "robot": truth["robot"],
        "stratum": truth["stratum"],
        **stood,
        "verdict": verdict,
        "size": len(group) or None,
        "sharp": _sharp(document.get("findings", [])),
        "allowed": verdict in truth["answer"]["verdicts"] or stood["immaterial"],
        "unknown": any(
            n.effect == UNKNOWN and (n is named[0] or n.probability >= STATED) for n in named
        ),
        "confidence": _confidence(named),
        "background": bool(background),
        "ambiguous": verdict == "undetermined" or len(group) > 1,
        "next": document.get("next_recording") is not None,
        "seconds": _seconds(document),
        "oracle": oracle,
        "named": tuple(dict.fromkeys(n.effect for n in named))[:3],
    }
    if stood["null"]:
        return Judged(**case)
    effects = truth["effects"]
    wanted = {str(e["effect"]) for e in effects}
    accepted = wanted | {b for e in effects for b in e["besides"]}
    classes = {CLASS_OF[e] for e in accepted if e in CLASS_OF}
    answers = set(truth["answer"]["set"])
    case |= {
        "exact": _rank([n.effect for n in named], wanted),
        "kind": _rank([_class(n.effect) for n in named], classes or wanted),
        "all_found": _all_found(named, effects),
        "place": _placed(robot, named, effects),
        "place_background": _placed(robot, named, [*effects, *background]),
        "covered": answers <= group if answers and group else bool(group & accepted),
        "regime": _regime(truth, findings, repeats),
    }
    errors, inside = _parameters(robot, effects, findings)
    return Judged(**case, errors=errors, inside=inside)


def _stood(truth: Mapping[str, Any]) -> dict[str, Any]:
    """What is asked of a case, by what its effects or its nuisance do."""
    stratum = str(truth["stratum"])
    null = stratum.startswith("null:")
    everything = truth.get("all_seen") or {}
    alone = truth.get("effect_seen") or everything
    excused = null and bool(everything.get("material"))
    nuisance = everything if stratum == CALM else {}
    return {
        "null": null,
        "excused": excused,
        "visible": nuisance.get("snr", 0.0) >= FAINT and not excused,
        "immaterial": not null and stratum not in OWN_LINES and alone.get("material") is False,
        "absorbed": None if null else alone.get("absorbed"),
        "nuisance": nuisance.get("held_out_gain_sigma"),
    }


def _group(findings: Sequence[Mapping[str, Any]]) -> set[str]:
    """The effects that the first finding leaves standing."""
    if not findings:
        return set()
    return {str(e["effect"]) for e in (findings[0], *findings[0].get("equivalents", []))}


def _sharp(findings: Sequence[Mapping[str, Any]]) -> bool:
    """Whether one effect has nearly all of the first finding's probability."""
    mass: dict[str, float] = {}
    for finding in findings[:1]:
        for one in (finding, *finding.get("equivalents", [])):
            mass[one["effect"]] = mass.get(one["effect"], 0.0) + float(one["probability"])
    return bool(mass) and max(mass.values()) >= SHARP * sum(mass.values())


def _all_found(named: Sequence[Named], effects: Sequence[Mapping[str, Any]]) -> bool:
    """Whether each effect has a finding of its own, by classes that stand among the first three."""
    first = list(dict.fromkeys(_class(n.effect) for n in named))[:3]
    tellers = [
        {n.finding for n in named if _class(n.effect) in _classes_of(effect).intersection(first)}
        for effect in effects
    ]
    return any(len(set(choice)) == len(effects) for choice in product(*tellers))


def _confidence(named: Sequence[Named]) -> float | None:
    """Probability of the class that is named first, its members in the same finding added up."""
    if not named:
        return None
    first = named[0]
    members = [n for n in named if n.finding == first.finding]
    return min(1.0, sum(n.probability for n in members if _class(n.effect) == _class(first.effect)))


def _background(
    robot: RobotDescription, named: Sequence[Named], nuisance: Sequence[Mapping[str, Any]]
) -> list[Mapping[str, Any]]:
    """The nuisances that the first name tells of: of its class, at a place that meets its own."""
    if not named:
        return []
    first = named[0]
    told = covered(robot, first.place)
    return [
        n
        for n in nuisance
        if _class(n["effect"]) == _class(first.effect) and told & covered(robot, n["place"])
    ]


def _rank(named: Sequence[str], right: set[str]) -> int | None:
    """Place of the first right name among different ones, from 1."""
    different = list(dict.fromkeys(named))
    return next((n for n, name in enumerate(different, start=1) if name in right), None)


def _classes_of(effect: Mapping[str, Any]) -> set[str]:
    return {_class(e) for e in (effect["effect"], *effect.get("besides", ()))}


def _class(effect: str) -> str:
    """The class of an effect; what is not on the list is one of its own."""
    return CLASS_OF.get(effect, effect)


def _placed(
    robot: RobotDescription, named: Sequence[Named], effects: Sequence[Mapping[str, Any]]
) -> float | None:
    """Credit for the place that is named first, by the effect of its class that it fits best.

    None on a robot of one joint, where there is nothing to choose from.
    """
    if len(robot.joints) == 1:
        return None
    right = [(n, e) for n in named[:1] for e in effects if _class(n.effect) in _classes_of(e)]
    return max((credit(robot, n.place, e["place"]) for n, e in right), default=0.0)


def _regime(
    truth: Mapping[str, Any], findings: Sequence[Mapping[str, Any]], repeats: Collection[str]
) -> float | None:
    """F1 of the times at which the effects are told to act; None where nothing is told.

    Those in repeats are left out: the truth is of recordings that repeat no other.
    """
    every = [w for finding in findings for w in finding.get("when", [])]
    told = _times([w for w in every if w["recording"] not in repeats])
    true = _times((truth.get("all_seen") or {}).get("when", []))
    if not told or not true:
        return None
    return 2 * len(told & true) / (len(told) + len(true))


def _times(spans: Sequence[Mapping[str, Any]]) -> set[tuple[str, int]]:
    return {
        (str(span["recording"]), k)
        for span in spans
        for k in range(round(span["start"] * PER_SECOND), round(span["end"] * PER_SECOND))
    }


def _parameters(
    robot: RobotDescription,
    effects: Sequence[Mapping[str, Any]],
    findings: Sequence[Mapping[str, Any]],
) -> tuple[tuple[float, ...], tuple[bool, ...]]:
    """Relative errors and coverage where a finding has one parameter of the truth's unit.

    Of an effect elsewhere the size tells nothing: the places must meet.
    """
    errors, inside = [], []
    for effect in effects:
        size, there = effect["size"], covered(robot, effect["place"])
        for finding in findings:
            if not effect["comparable"] or finding["effect"] != effect["effect"]:
                continue
            if not covered(robot, finding["place"]) & there:
                continue
            same = [p for p in finding.get("parameters", {}).values() if p["unit"] == size["unit"]]
            if len(same) == 1:
                # The sign of an angle or an offset is a matter of convention.
                true, (low, high) = abs(size["value"]), same[0]["ci90"]
                errors.append(abs(abs(same[0]["value"]) - true) / true)
                inside.append(bool(low <= true <= high or low <= -true <= high))
            break
    return tuple(errors), tuple(inside)


def _seconds(diagnosis: Mapping[str, Any]) -> float | None:
    """How long it took, where the document tells."""
    told = diagnosis.get("seconds")
    return float(told) if isinstance(told, int | float) and np.isfinite(told) else None
