"""What one diagnosis got right of one case."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import mujoco
import numpy as np

from pup.blind.catalogue import CLASS_OF
from pup.robot import RobotDescription

SHARP = 0.8  # probability from which a single name counts as a sharp claim
PER_SECOND = 100  # resolution in which spans of time are compared
WHOLE = ("bus", "robot")  # places that cover all joints
CALM = "null:nuisance"  # the nulls that have a nuisance
UNKNOWN = "unknown"  # what a finding outside the list is called


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
      nuisance: what a complete model of a null's nuisance gains, in units of sigma.
      verdict: the diagnosis's, or `missing`.
      exact: rank of the first right effect, from 1.
      kind: rank of the first right class, from 1.
      all_found: whether every effect's class stands among the first three.
      place: credit for the place that is named first, 0 to 1.
      background: whether what stands first is a nuisance that is there, by class and place.
      place_background: as `place`, such a nuisance's place counted as right.
      covered: whether the first finding and its equivalents hold the truth.
      size: how many effects those are.
      sharp: whether a single effect is claimed with confidence.
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


def ranking(diagnosis: Mapping[str, Any]) -> list[Named]:
    """Findings and their equivalents: what is claimed first, then all others by probability.

    First is the first finding, for findings stand most important first (contract, section 5); a
    finding `unknown` is where it is more probable than that one. Among equals the others stay as
    they stand in the document, each finding before its equivalents.
    """
    groups = [
        [
            Named(str(e["effect"]), e["place"], float(e["probability"]), index)
            for e in (finding, *finding.get("equivalents", []))
        ]
        for index, finding in enumerate(diagnosis.get("findings", []))
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
) -> Judged:
    """Judge one diagnosis.

    Args:
      truth: the case's entry in the key.
      diagnosis: its document; None where there is none.
      robot: of the case.
      oracle: share of the possible gain on the test motions that was had.
    """
    null = str(truth["stratum"]).startswith("null:")
    seen = truth.get("all_seen") or {}
    case: dict[str, Any] = {
        "id": truth["id"],
        "robot": truth["robot"],
        "stratum": truth["stratum"],
        "null": null,
        "excused": null and bool(seen.get("material")),
        "nuisance": seen.get("held_out_gain_sigma") if truth["stratum"] == CALM else None,
    }
    if diagnosis is None:
        return Judged(**case, verdict="missing")
    named = ranking(diagnosis)
    findings = diagnosis.get("findings", [])
    group = _group(findings)
    verdict = str(diagnosis.get("verdict"))
    background = _background(robot, named, truth.get("nuisance", []))
    case |= {
        "verdict": verdict,
        "size": len(group) or None,
        "sharp": len(group) == 1 and max(n.probability for n in named) >= SHARP,
        "allowed": verdict in truth["answer"]["verdicts"],
        "unknown": any(n.effect == UNKNOWN for n in named) or any(f.get("law") for f in findings),
        "confidence": _confidence(named),
        "background": bool(background),
        "ambiguous": verdict == "undetermined" or len(group) > 1,
        "next": diagnosis.get("next_recording") is not None,
        "seconds": _seconds(diagnosis),
        "oracle": oracle,
        "named": tuple(dict.fromkeys(n.effect for n in named))[:3],
    }
    if null:
        return Judged(**case)
    effects = truth["effects"]
    wanted = {str(e["effect"]) for e in effects}
    accepted = wanted | {b for e in effects for b in e["besides"]}
    classes = {CLASS_OF[e] for e in accepted if e in CLASS_OF}
    kinds = [_class(n.effect) for n in named]
    first = list(dict.fromkeys(kinds))[:3]
    answers = set(truth["answer"]["set"])
    case |= {
        "exact": _rank([n.effect for n in named], wanted),
        "kind": _rank(kinds, classes or wanted),
        "all_found": all(_classes_of(e) & set(first) for e in effects),
        "place": _placed(robot, named, effects),
        "place_background": _placed(robot, named, [*effects, *background]),
        "covered": answers <= group if answers and group else bool(group & accepted),
        "regime": _regime(truth, findings),
    }
    errors, inside = _parameters(effects, findings)
    return Judged(**case, errors=errors, inside=inside)


def _group(findings: Sequence[Mapping[str, Any]]) -> set[str]:
    """The effects that the first finding leaves standing."""
    if not findings:
        return set()
    return {str(e["effect"]) for e in (findings[0], *findings[0].get("equivalents", []))}


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
    told = _where(robot, first.place)
    return [
        n
        for n in nuisance
        if _class(n["effect"]) == _class(first.effect) and told & _where(robot, n["place"])
    ]


def _rank(named: Sequence[str], right: set[str]) -> int | None:
    """Place of the first right name among different ones, from 1."""
    different = list(dict.fromkeys(named))
    return next((n for n, name in enumerate(different, start=1) if name in right), None)


def _classes_of(effect: Mapping[str, Any]) -> set[str]:
    return {_class(e) for e in (effect["effect"], *effect["besides"])}


def _class(effect: str) -> str:
    """The class of an effect; what is not on the list is one of its own."""
    return CLASS_OF.get(effect, effect)


def _placed(
    robot: RobotDescription, named: Sequence[Named], effects: Sequence[Mapping[str, Any]]
) -> float:
    """Credit for the place that is named first, by the effect that it fits best."""
    return max((_credit(robot, n, e) for n in named[:1] for e in effects), default=0.0)


def _credit(robot: RobotDescription, named: Named, effect: Mapping[str, Any]) -> float:
    """1 for the place, half for its mirror, or for a group that holds it or that it holds."""
    told, true = _where(robot, named.place), _where(robot, effect["place"])
    if told == true:
        return 1.0
    mirrors = {joint.name: joint.mirror for joint in robot.joints}
    if told == {mirrors.get(name) or name for name in true}:
        return 0.5
    nested = bool(told & true) and (told <= true or true <= told)
    return 0.5 if nested and len(told) < len(robot.joints) else 0.0


def _where(robot: RobotDescription, place: Mapping[str, Any]) -> frozenset[str]:
    """What a place covers: joints where it can be told in joints, else its kind and names."""
    kind, names = str(place["kind"]), [str(n) for n in place["names"]]
    if kind == "group":
        return frozenset(j.name for j in robot.joints if j.group in names)
    if kind in WHOLE:
        return frozenset(robot.joint_names)
    if kind in ("sensor", "ground"):
        return frozenset((kind,))
    if kind in ("body", "foot"):
        return frozenset(_joint_of(robot).get(name, f"body {name}") for name in names)
    return frozenset(names)


@lru_cache(maxsize=8)
def _joint_of(robot: RobotDescription) -> dict[str, str]:
    """The joint that moves each body; bodies above all joints are left out."""
    model = mujoco.MjSpec.from_file(str(robot.model_path)).compile()
    found = {}
    for body in range(1, model.nbody):
        above = body
        while above and not model.body_jntnum[above]:
            above = model.body_parentid[above]
        name = model.joint(model.body_jntadr[above]).name if above else ""
        if name in robot.joint_names:
            found[model.body(body).name] = name
    return found


def _regime(truth: Mapping[str, Any], findings: Sequence[Mapping[str, Any]]) -> float | None:
    """F1 of the times at which the effects are told to act; None where nothing is told."""
    told = _times([w for finding in findings for w in finding.get("when", [])])
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
    effects: Sequence[Mapping[str, Any]], findings: Sequence[Mapping[str, Any]]
) -> tuple[tuple[float, ...], tuple[bool, ...]]:
    """Relative errors and coverage where a finding has one parameter of the truth's unit."""
    errors, inside = [], []
    for effect in effects:
        size = effect["size"]
        for finding in findings:
            if not effect["comparable"] or finding["effect"] != effect["effect"]:
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
