"""What one diagnosis got right of one case."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np

from pup.blind.absorb import FAINT
from pup.blind.catalogue import CLASS_OF
from pup.blind.claims import UNKNOWN, Named, class_of, confidence, rank, ranking, sharp
from pup.blind.places import covered, credit
from pup.robot import RobotDescription

STATED = 0.5  # probability from which `unknown` counts though something else stands first
PER_SECOND = 100  # resolution in which spans of time are compared
CALM = "null:nuisance"  # the nulls that have a nuisance
OWN_LINES = ("weak", "unidentifiable")  # strata in which little to be gained is the rule


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
      ground: whether the robot stands on the ground in any of its recordings.
      snr: of what is missing, to a matched filter, after a refit.
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
      covered: whether the first finding and its equivalents hold the truth, at its place.
      size: how many those are, an effect at two places counted twice.
      sharp: whether the first finding is all but a single effect.
      allowed: whether the verdict is one that the data allow.
      unknown: whether something outside the list is told of; where that is the truth, at its place.
      confidence: probability of the class named first.
      regime: F1 of the times at which it is said to act.
      errors: relative errors of comparable parameters.
      inside: whether their 90 % intervals hold the truth.
      ambiguous: whether the first finding leaves more than one effect standing.
      next: whether a next recording is proposed: one that splits these effects, the truth among
        them, or where the verdict is `undetermined`, any.
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
    ground: bool = False
    snr: float | None = None
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
    group = [n for n in named if n.finding == 0]
    effects = truth.get("effects", [])
    background = _background(robot, named, truth.get("nuisance", []))
    stood = _stood(truth)
    case: dict[str, Any] = {
        "id": truth["id"],
        "robot": truth["robot"],
        "stratum": truth["stratum"],
        **stood,
        "verdict": verdict,
        "size": len({(n.effect, covered(robot, n.place)) for n in group}) or None,
        "sharp": sharp(document.get("findings", [])),
        "allowed": verdict in truth["answer"]["verdicts"] or stood["immaterial"],
        "unknown": _told_unknown(robot, named, effects),
        "confidence": confidence(named),
        "background": bool(background),
        "ambiguous": len({n.effect for n in group}) > 1,
        "next": verdict == "undetermined" and document.get("next_recording") is not None,
        "seconds": _seconds(document),
        "oracle": oracle,
        "named": tuple(dict.fromkeys(n.effect for n in named))[:3],
    }
    if stood["null"]:
        return Judged(**case)
    wanted = {str(e["effect"]) for e in effects}
    accepted = wanted | {b for e in effects for b in e["besides"]}
    classes = {CLASS_OF[e] for e in accepted if e in CLASS_OF}
    holds = _holds(robot, group, truth)
    case |= {
        "exact": rank([n.effect for n in named], wanted),
        "kind": rank([class_of(n.effect) for n in named], classes or wanted),
        "all_found": _all_found(named, effects),
        "place": _placed(robot, named, effects),
        "place_background": _placed(robot, named, [*effects, *background]),
        "covered": holds,
        "next": case["next"] or (holds and _splits(document.get("next_recording"), group)),
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
        "ground": bool(truth.get("ground")),
        "snr": None if null else alone.get("snr"),
        "absorbed": None if null else alone.get("absorbed"),
        "nuisance": nuisance.get("held_out_gain_sigma"),
    }


def _holds(robot: RobotDescription, group: Sequence[Named], truth: Mapping[str, Any]) -> bool:
    """Whether what the first finding leaves standing holds the truth.

    Where data cannot decide it is all of the answers, and nothing where a name is wrong as such.
    """
    answers = set(truth["answer"]["set"])
    if answers:
        return answers <= {n.effect for n in group}
    if "mismatch" not in truth["answer"]["verdicts"]:
        return False
    return any(
        n.effect in (effect["effect"], *effect["besides"])
        and _meet(robot, n.place, effect["place"])
        for n in group
        for effect in truth["effects"]
    )


def _splits(recording: Mapping[str, Any] | None, group: Sequence[Named]) -> bool:
    """Whether a next recording would tell effects apart that the first finding leaves standing."""
    standing = {n.effect for n in group}
    pairs = (recording or {}).get("splits", [])
    return any(len(set(pair) & standing) > 1 for pair in pairs)


def _told_unknown(
    robot: RobotDescription, named: Sequence[Named], effects: Sequence[Mapping[str, Any]]
) -> bool:
    """Whether something outside the list is told of: first, or as more likely than not.

    Where that is the truth, at its place: what is told elsewhere is something else.
    """
    places = [e["place"] for e in effects if e["effect"] == UNKNOWN]
    return any(
        n.effect == UNKNOWN
        and (n is named[0] or n.probability >= STATED)
        and (not places or any(_meet(robot, n.place, place) for place in places))
        for n in named
    )


def _meet(robot: RobotDescription, one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether two places have something in common."""
    return bool(covered(robot, one) & covered(robot, other))


def _all_found(named: Sequence[Named], effects: Sequence[Mapping[str, Any]]) -> bool:
    """Whether each effect has a finding of its own, by classes that stand among the first three.

    A finding tells of what it is named after, and of a class that is most probable in it.
    """
    foremost: dict[str, Named] = {}
    for n in named:
        foremost.setdefault(class_of(n.effect), n)
    first = set(list(foremost)[:3])
    heads = [n for n in named if n.head]
    tellers = [
        {
            n.finding
            for n in (*foremost.values(), *heads)
            if class_of(n.effect) in _classes_of(effect) & first
        }
        for effect in effects
    ]
    return any(len(set(choice)) == len(effects) for choice in product(*tellers))


def _background(
    robot: RobotDescription, named: Sequence[Named], nuisance: Sequence[Mapping[str, Any]]
) -> list[Mapping[str, Any]]:
    """The nuisances that the first name tells of: of its class, at a place that meets its own."""
    if not named:
        return []
    first = named[0]
    return [
        n
        for n in nuisance
        if class_of(n["effect"]) == class_of(first.effect) and _meet(robot, first.place, n["place"])
    ]


def _classes_of(effect: Mapping[str, Any]) -> set[str]:
    return {class_of(e) for e in (effect["effect"], *effect.get("besides", ()))}


def _placed(
    robot: RobotDescription, named: Sequence[Named], effects: Sequence[Mapping[str, Any]]
) -> float | None:
    """Credit for the place that is named first, by the effect of its class that it fits best.

    None on a robot of one joint, where there is nothing to choose from.
    """
    if len(robot.joints) == 1:
        return None
    right = [(n, e) for n in named[:1] for e in effects if class_of(n.effect) in _classes_of(e)]
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
        size = effect["size"]
        for finding in findings:
            if not effect["comparable"] or finding["effect"] != effect["effect"]:
                continue
            if not _meet(robot, finding["place"], effect["place"]):
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
