"""Scoring verdicts against a revealed key."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pup.blind.absorb import MATERIAL
from pup.blind.bound import Lower, bounded
from pup.blind.claims import check
from pup.blind.judge import Judged, judge
from pup.blind.seal import COMMITMENT, verify
from pup.blind.statistics import calibration, mean, share
from pup.errors import InputError
from pup.files import read_json
from pup.recording import Recording, load_recordings
from pup.robot import RobotDescription

DIAGNOSIS, CORRECTED = "diagnosis.json", "corrected"
TOP = 3
HEAVY = 0.85  # share of the rms that a refit hides, from which a case has a line besides
LOUD = 8.0  # SNR after a refit, from which cases have a line besides
SINGLE = ("single", "below_noise", "masked")  # strata of one effect that is to be named
THERE = " (a nuisance that is there)"


@dataclass(frozen=True)
class Replayed:
    """How well a diagnosis predicts motions it was never given.

    Attributes:
      nominal: rms error of the refitted nominal model, rad.
      corrected: rms error of the corrected robot, rad.
    """

    nominal: float
    corrected: float


Replay = Callable[[Path, Sequence[Recording]], Replayed | None]
"""Replays the folder of a diagnosis, with its `corrected/`, on test recordings; None where the
diagnosis does not tell the refitted nominal model."""

Report = Callable[[int, int], None]
"""Told how many cases are judged, and of how many."""


def score_set(
    folder: Path,
    key: Path,
    diagnoses: Path,
    replay: Replay | None = None,
    only: Collection[str] | None = None,
    report: Report = lambda done, total: None,
) -> dict[str, Any]:
    """Score a set.

    Args:
      folder: the set.
      key: its key.
      diagnoses: folder with `case_<id>/diagnosis.json` for every case.
      replay: how to replay a corrected robot; without it there is no oracle ratio.
      only: ids of the cases to be scored; all of the set where None.
      report: told after each case.

    Returns:
      The scores, as JSON values. `all` and the robots' scores leave out the stratum `weak` and what
      is immaterial; the former is among `per_stratum`, the latter among `lines`, as are all cases
      of an SNR over 8, whatever is asked of them. `refits` tells
      where a diagnosis's nominal model comes nearer to the truth than the key's refit and counts.

    Raises:
      InputError: the key or the set is not the one committed to, or no diagnosis is of its cases.
    """
    known = verify(folder, key)["cases"]
    if not any((diagnoses / f"case_{t['id']}" / DIAGNOSIS).is_file() for t in known):
        raise InputError(f"{diagnoses}: no case_<id>/{DIAGNOSIS} of a case of this set in it")
    truths = [t for t in known if only is None or t["id"] in only]
    robots = {name: RobotDescription.load(name) for name in {t["robot"] for t in truths}}
    judged, bounds = [], []
    for truth in truths:
        name, robot = f"case_{truth['id']}", robots[truth["robot"]]
        document = _diagnosis(diagnoses / name / DIAGNOSIS, robot) or {}
        entry, lower = bounded(truth, folder / name, robot, document.get("nominal"))
        bounds.append((truth, entry, lower))
        judged.append(_judged(entry, folder / name, diagnoses / name, robot, replay))
        report(len(judged), len(truths))
    real = [case for case in judged if not case.null]
    counted = [case for case in real if case.stratum != "weak" and not case.immaterial]
    hidden = [c for c in counted if c.stratum in SINGLE and (c.absorbed or 0.0) >= HEAVY]
    return {
        "schema": 1,
        "commitment": read_json(folder / COMMITMENT),
        "cases": len(judged),
        "missing": sum(case.verdict == "missing" for case in judged),
        "all": _omissions(counted),
        "nulls": _nulls([case for case in judged if case.null]),
        "per_stratum": {
            stratum: _nulls(group) if stratum.startswith("null:") else _omissions(group)
            for stratum in sorted({case.stratum for case in judged})
            if (group := [case for case in judged if case.stratum == stratum])
        },
        "lines": {
            "immaterial": _omissions([case for case in real if case.immaterial]),
            "masked_85": _omissions(hidden),
            "snr_over_8": _omissions([c for c in real if (c.snr or 0.0) > LOUD]),
            "suspended": _omissions([c for c in counted if not c.ground]),
            "ground": _omissions([c for c in counted if c.ground]),
        },
        "per_robot": {
            name: _omissions([case for case in counted if case.robot == name])
            | {"nulls": _nulls([c for c in judged if c.null and c.robot == name])}
            for name in sorted(robots)
        },
        **_calibrations(judged),
        "refits": _refits(bounds),
        "failures": [_failure(case) for case in judged if _faults(case)],
    }


def _judged(
    truth: Mapping[str, Any],
    case: Path,
    diagnosed: Path,
    robot: RobotDescription,
    replay: Replay | None,
) -> Judged:
    """Judge the diagnosis in a folder."""
    document = _diagnosis(diagnosed / DIAGNOSIS, robot)
    null = truth["stratum"].startswith("null:")
    oracle = None if replay is None or null else _oracle(truth, case / "test", diagnosed, replay)
    with _by_contract(diagnosed / DIAGNOSIS):
        return judge(truth, document, robot, oracle, _repeats(case / "recordings"))


def _refits(
    bounds: Sequence[tuple[Mapping[str, Any], Mapping[str, Any], Lower | None]],
) -> dict[str, Any]:
    """Where a diagnosis's nominal model comes nearer to the truth than the key's refit."""
    return {
        "compared": sum(lower is not None for _, _, lower in bounds),
        "lower": [
            {
                "case": truth["id"],
                "robot": truth["robot"],
                "stratum": truth["stratum"],
                "counted_as": counted["stratum"],
                **lower,
            }
            for truth, counted, lower in bounds
            if lower
        ],
    }


def _repeats(recordings: Path) -> set[str]:
    """Recordings that repeat another."""
    known = load_recordings([recordings]) if recordings.is_dir() else ()
    return {recording.id for recording in known if recording.repeat_of is not None}


def _omissions(cases: Sequence[Judged]) -> dict[str, Any]:
    """The scores of cases in which something is missing."""
    listed = [c for c in cases if c.stratum not in ("unlisted", "unidentifiable")]
    open_ = [c for c in cases if c.stratum == "unidentifiable"]
    grouped = [*listed, *(c for c in open_ if c.size is not None)]
    pairs = [c for c in cases if c.stratum == "pair"]
    return {
        "detected": share([c.verdict == "mismatch" for c in cases if c not in open_]),
        "exact_top1": share([c.exact == 1 for c in listed]),
        "exact_top3": share([_within(c.exact) for c in listed]),
        "class_top1": share([c.kind == 1 for c in listed]),
        "class_top1_or_nuisance": share([_true(c) for c in listed]),
        "class_top3": share([_within(c.kind) for c in listed]),
        "found_or_split": share([c.kind == 1 or (c.ambiguous and c.next) for c in listed]),
        "pairs_both_in_top3": share([bool(c.all_found) for c in pairs]),
        "pairs_one_in_top3": share([_within(c.kind) for c in pairs]),
        "place_top1": mean([c.place for c in listed if c.place is not None]),
        "place_top1_or_nuisance": mean(
            [c.place_background for c in listed if c.place_background is not None]
        ),
        "set_covers": share([bool(c.covered) for c in grouped]),
        "set_size": mean([float(c.size) for c in grouped if c.size is not None]),
        "regime_f1": mean([c.regime for c in cases if c.regime is not None]),
        "parameter_error": mean([e for c in cases for e in c.errors]),
        "parameter_in_ci90": share([i for c in cases for i in c.inside]),
        "unidentifiable_allowed": share([_left_open(c) for c in open_]),
        "unlisted_flagged": share([c.unknown for c in cases if c.stratum == "unlisted"]),
        "listed_flagged_unknown": share([c.unknown for c in listed]),
        "ambiguous_with_next_recording": share(
            [c.next for c in cases if c.ambiguous and c.covered]
        ),
        "undetermined_with_next_recording": share(
            [c.next for c in cases if c.verdict == "undetermined"]
        ),
        "oracle_ratio": mean([c.oracle for c in cases if c.oracle is not None]),
        **_calibrations(cases),
        "seconds": mean([c.seconds for c in cases if c.seconds is not None]),
    }


def _nulls(cases: Sequence[Judged]) -> dict[str, Any]:
    """The scores of cases in which nothing material is missing."""
    there = [c for c in cases if c.verdict != "missing"]
    counted = [c for c in there if not _nuisance_told(c)]
    return {
        "false_positives": share([c.verdict == "mismatch" for c in counted]),
        "told_none": share([c.verdict == "none" for c in counted]),
        "undetermined": share([c.verdict == "undetermined" for c in counted]),
        "visible_nuisance": share([c.verdict == "mismatch" for c in there if c.visible]),
        "material_nuisance": share([c.verdict == "mismatch" for c in there if c.excused]),
        "missing": share([c.verdict == "missing" for c in cases]),
        "seconds": mean([c.seconds for c in cases if c.seconds is not None]),
    }


def _calibrations(cases: Sequence[Judged]) -> dict[str, Any]:
    """How far the probability of the class named first can be trusted, in both readings."""
    claims = [c for c in cases if c.confidence is not None and not c.excused]
    told = [c.confidence for c in claims if c.confidence is not None]
    return {
        "calibration": calibration(told, [c.kind == 1 for c in claims]),
        "calibration_or_nuisance": calibration(told, [_true(c) for c in claims]),
    }


def _left_open(case: Judged) -> bool:
    """Whether what data cannot decide is left open, between what it may be."""
    return case.allowed and not case.sharp and (case.verdict != "mismatch" or bool(case.covered))


def _nuisance_told(case: Judged) -> bool:
    """Whether a null has a nuisance that may be told of: a material one, or by its right name."""
    return case.excused or (case.visible and case.background)


def _true(case: Judged) -> bool:
    """Whether the class named first is there, as an omission or as a nuisance."""
    return case.kind == 1 or case.background


def _within(rank: int | None) -> bool:
    return rank is not None and rank <= TOP


def _faults(case: Judged) -> list[str]:
    """What is wrong with a verdict, in words."""
    if case.verdict == "missing":
        return ["no diagnosis"]
    if case.null:
        called = case.verdict == "mismatch" and not _nuisance_told(case)
        return [_alarm(case)] if called else []
    if case.stratum == "unidentifiable":
        faults = [] if case.allowed else [f"verdict {case.verdict}"]
        if case.sharp:
            return [*faults, "sharp name where the data cannot tell"]
        return faults or ["other names than what it may be"] * (not _left_open(case))
    if case.verdict != "mismatch":
        return [] if case.allowed else ["missed"]
    if case.stratum == "unlisted":
        return [] if case.unknown else ["not told to be outside the list"]
    faults = [] if case.kind == 1 else ["wrong class" + THERE * case.background]
    if case.kind == 1 and case.exact != 1:
        faults.append("wrong effect of the class")
    if case.stratum == "pair" and not case.all_found:
        faults.append("one of two found")
    wrong = case.kind == 1 and case.place is not None and case.place < 1
    return faults + ["wrong place"] * wrong


def _alarm(case: Judged) -> str:
    """A false positive, with what a complete model of the nuisance would gain."""
    if case.nuisance is None:
        return "false positive"
    return f"false positive (nuisance of {case.nuisance:.2f} sigma)"


def _failure(case: Judged) -> dict[str, Any]:
    return {
        "case": case.id,
        "robot": case.robot,
        "stratum": case.stratum,
        "faults": _faults(case),
        "named": list(case.named),
    }


@contextmanager
def _by_contract(path: Path) -> Iterator[None]:
    """Tell of a diagnosis that is not built as the contract has it."""
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise InputError(f"{path}: does not follow the contract ({error!r})") from error


def _diagnosis(path: Path, robot: RobotDescription) -> dict[str, Any] | None:
    """A diagnosis of a robot; None where there is none."""
    if not path.is_file():
        return None
    document = read_json(path)
    if not isinstance(document, dict) or document.get("schema") != 1:
        raise InputError(f"{path}: not a diagnosis (schema 1)")
    with _by_contract(path):
        check(document, robot.name)
    return document


def _oracle(truth: Mapping[str, Any], tests: Path, diagnosed: Path, replay: Replay) -> float | None:
    """Share of the possible gain on test motions; None where there is next to none to be had.

    Who tells no model has none of it. What a refit leaves stands in the key; for keys of earlier
    sets it is what the diagnosis's own nominal model leaves.
    """
    if not tests.is_dir():
        return None
    # Who knows the form and refits everything is left with the noise.
    best, seen = float(truth["noise"]["sigma"]), truth.get("all_seen") or {}
    left = seen.get("after_refit_test_rms_rad")
    nominal = None if left is None else float(np.hypot(best, left))
    if nominal is not None and not _worth(nominal, best):
        return None
    there = (diagnosed / DIAGNOSIS).is_file() and (diagnosed / CORRECTED).is_dir()
    errors = replay(diagnosed, load_recordings([tests])) if there else None
    if errors is None:
        return 0.0 if nominal is not None or seen.get("material") else None
    nominal = errors.nominal if nominal is None else nominal
    return (nominal - errors.corrected) / (nominal - best) if _worth(nominal, best) else None


def _worth(nominal: float, best: float) -> bool:
    """Whether there is enough to be gained for a share of it to mean something."""
    return nominal - best > MATERIAL * best
