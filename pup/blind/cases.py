"""The cases of a sealed set: what is concealed in each, and what it does to the readings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pup.blind.absorb import CLEAR, FAINT, MATERIAL, Visibility, labelled, visibility
from pup.blind.catalogue import COMPARABLE, KINDS
from pup.blind.drafts import Draft, draw_case, draw_null
from pup.blind.reference import Reference, readings
from pup.blind.sensors import measure
from pup.blind.setting import setting
from pup.blind.sound import check
from pup.blind.world import Effect
from pup.errors import InputError
from pup.recording import Recording
from pup.robot import RobotDescription

ROUNDS = 5  # steps of a refit that is measured
REDRAWS, TUNINGS, CALMINGS = 30, 4, 2
STRICT = 12  # redraws in which a case must turn out to be of the stratum that it is drawn for
VERDICTS = ("mismatch", "none", "undetermined")


@dataclass(frozen=True, eq=False)
class Case:
    """One case.

    Attributes:
      id: random, tells nothing.
      recordings: what the engine is given.
      tests: recordings of other motions, kept for the held-out score.
      truth: the case's entry in the key.
    """

    id: str
    recordings: tuple[Recording, ...]
    tests: tuple[Recording, ...]
    truth: dict[str, Any]


def strata(counts: int, shares: Mapping[str, float]) -> list[str]:
    """As many strata as asked for, in the given proportions (largest remainders)."""
    exact = {name: counts * share for name, share in shares.items()}
    whole = {name: int(value) for name, value in exact.items()}
    rest = sorted(exact, key=lambda name: whole[name] - exact[name])
    for name in rest[: counts - sum(whole.values())]:
        whole[name] += 1
    return [name for name, count in whole.items() for _ in range(count)]


def make_case(
    robot: RobotDescription, stratum: str, ground: bool, seed: Sequence[int], id: str
) -> Case:
    """Make one case.

    Args:
      robot: of the case.
      stratum: one of STRATA, or of NULLS after `null:`.
      ground: whether it stands on its feet in most recordings.
      seed: of all that is random in the case.
      id: of the case.

    Raises:
      InputError: no case of that kind could be made.
    """
    rng = np.random.default_rng(seed)
    kind = stratum.removeprefix("null:")
    draw = draw_case if stratum == kind else draw_null
    given = setting(stratum, ground, rng)
    for turn in range(REDRAWS):
        try:
            found = _finished(draw(robot, kind, ground, rng, given), rng, id, turn < STRICT)
        except InputError:
            continue
        if found is not None:
            return found
    raise InputError(f"robot {robot.name!r}: no case of stratum {stratum!r} could be made")


def _finished(draft: Draft, rng: np.random.Generator, id: str, strict: bool) -> Case | None:
    """Simulate, tune the size to the stratum, measure and write the truth down.

    Were cases taken whatever stratum they turn out to be of, the setting, which favours some, would
    tell of it.

    Returns:
      None where the effect cannot be seen, or is of another stratum and that is not allowed, so
      that another must be drawn.
    """
    if draft.stratum.startswith("null:"):
        views: dict[str, Any] = {"all_seen": None}
        if draft.stratum in ("null:engine", "null:nuisance"):
            draft, seen, view = _calmed(draft)
            if draft.stratum == "null:engine" and view.gain > MATERIAL:
                return None
            views = {"all_seen": view.document()}
        else:
            seen = readings(draft.full(), draft.plans)[0]
        truth = _truth(draft, id, draft.stratum, ["none"]) | views
    else:
        reference = Reference.of(draft.world, draft.plans, draft.values)
        draft, seen, alone = _tuned(draft, reference)
        each = _each(draft, reference) if len(draft.effects) > 1 else [alone]
        stratum = labelled(draft.stratum, alone.document(), draft.noise.sigma)
        floor = CLEAR if draft.stratum == "unlisted" else FAINT
        faint = draft.stratum != "unidentifiable" and alone.snr < floor
        missed = stratum != draft.stratum and (
            strict or (draft.stratum in ("single", "masked") and stratum == "weak")
        )
        if faint or missed or (len(each) > 1 and min(e.snr for e in each) < CLEAR):
            return None
        check(draft, reference, seen)
        everything = alone
        if draft.nuisance:
            everything = visibility(reference, seen, draft.noise, rounds=ROUNDS)
        slight = bool(draft.answers) and alone.gain <= MATERIAL
        allowed = VERDICTS if stratum == "weak" or slight else draft.verdicts or ("mismatch",)
        truth = _truth(draft, id, stratum, allowed) | {
            "effect_seen": alone.document(),
            "each_seen": [one.document() for one in each],
            "all_seen": everything.document(),
        }
    made = [measure(draft.full(), p, seen[p.id], draft.noise, rng) for p in draft.plans]
    tests = {plan.id for plan in draft.plans if plan.test}
    return Case(
        id,
        tuple(r for r in made if r.id not in tests),
        tuple(r for r in made if r.id in tests),
        truth,
    )


def _calmed(draft: Draft) -> tuple[Draft, Mapping[str, Any], Visibility]:
    """Halve a nuisance that matters, for as often as is tried; readings and what it does."""
    reference = Reference.of(draft.world, draft.plans, draft.values)
    for turn in range(CALMINGS + 1):
        seen = readings(draft.full(), draft.plans)[0]
        view = visibility(reference, seen, draft.noise, rounds=ROUNDS)
        if view.gain <= MATERIAL or not draft.nuisance or turn == CALMINGS:
            break
        draft = replace(draft, nuisance=tuple(effect.scaled(0.5) for effect in draft.nuisance))
    return draft, seen, view


def _tuned(draft: Draft, reference: Reference) -> tuple[Draft, Mapping[str, Any], Visibility]:
    """Bring the size into the stratum; the readings and what the effects alone do to them.

    Raises:
      InputError: it would take a size that no robot has.
    """
    background = None
    if draft.nuisance:
        background = readings(replace(draft.world, effects=draft.nuisance), draft.plans)[0]
    for turn in range(TUNINGS + 1):
        seen = readings(draft.full(), draft.plans)[0]
        alone = visibility(reference, seen, draft.noise, background)
        factor = _correction(draft, alone)
        if factor == 1.0 or turn == TUNINGS:
            alone = visibility(reference, seen, draft.noise, background, ROUNDS)
            break
        draft = draft.resized(factor)
    return draft, seen, alone


def _each(draft: Draft, reference: Reference) -> list[Visibility]:
    """What each effect does on its own."""
    views = []
    for effect in draft.effects:
        seen = readings(replace(draft.world, effects=(effect,)), reference.plans)[0]
        views.append(visibility(reference, seen, draft.noise, rounds=ROUNDS))
    return views


def _correction(draft: Draft, found: Visibility) -> float:
    """Factor on the size that brings an effect into its stratum; 1 where it is or should stay."""
    ratio, snr = max(found.left / draft.noise.sigma, 1e-6), max(found.snr, 1e-6)
    if any(effect.name == "joint_stop" for effect in draft.effects):
        return 1.0
    if draft.stratum == "below_noise":
        return 1.0 if 0.35 <= ratio <= 0.9 else float(np.clip(0.6 / ratio, 0.05, 4.0))
    if draft.stratum == "weak":
        return 1.0 if FAINT <= snr <= 8.0 else float(np.clip(6.0 / snr, 0.05, 4.0))
    if draft.stratum == "single" and ratio < 1.2 and draft.room > 1.02:
        return float(np.clip(1.5 / ratio, 1.02, draft.room))
    return 1.0


def _truth(draft: Draft, id: str, stratum: str, verdicts: Sequence[str]) -> dict[str, Any]:
    """The case's entry in the key, but for what can be seen of it."""
    return {
        "id": id,
        "robot": draft.world.robot.name,
        "ground": any(plan.support == "ground" for plan in draft.plans),
        "stratum": stratum,
        "drawn_as": draft.stratum,
        "effects": [effect.document() | _besides(effect) for effect in draft.effects],
        "nuisance": [effect.document() for effect in draft.nuisance],
        "nominal": dict(draft.values),
        "physics_seed": draft.world.seed,
        "engine": draft.world.engine.document(),
        "noise": {**vars(draft.noise), "sigma": draft.noise.sigma},
        "answer": {"verdicts": list(verdicts), "set": list(draft.answers)},
        "recordings": sorted(plan.id for plan in draft.plans if not plan.test),
        "tests": sorted(plan.id for plan in draft.plans if plan.test),
    }


def _besides(effect: Effect) -> dict[str, Any]:
    kind = KINDS.get(effect.name)
    return {
        "besides": list(kind.besides) if kind else [],
        "comparable": effect.name in COMPARABLE,
    }
