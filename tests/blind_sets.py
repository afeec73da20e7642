"""Small blind sets of a bench servo, made by hand: their truths are known, their time is short."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from diagnosis_cases import recordings

from pup.blind.seal import commit, write_key
from pup.recording import Recording, write_recordings

SERVO = {"kind": "joint", "names": ["servo"]}
FRICTION = {"coulomb_friction/torque@joint:servo": 0.03}
NOISE = 0.002
POOR = 28
"""Ticks of recordings that are too short to tell anything, and quickly diagnosed."""
ENOUGH = 70
"""Ticks of recordings that are long enough for a clear effect."""


def truth(name: str, missing: Mapping[str, float]) -> dict[str, Any]:
    """An entry of the key; what is missing is one effect or none."""
    effects = [
        {
            "effect": column.partition("/")[0],
            "place": SERVO,
            "size": {"name": "torque", "value": value, "unit": "N m"},
            "besides": [],
            "comparable": True,
        }
        for column, value in missing.items()
    ]
    return {
        "id": name,
        "robot": "servo_bench",
        "stratum": "single" if effects else "null:noise",
        "effects": effects,
        "noise": {"sigma": NOISE},
        "answer": {"verdicts": ["mismatch" if effects else "none"], "set": []},
        "all_seen": {"material": bool(effects), "when": []},
    }


def poor(seed: int) -> tuple[Recording, ...]:
    """Two short motions."""
    runs = recordings({}, seed)
    return tuple(shortened(run, POOR) for run in (runs[0], runs[2]))


def shortened(run: Recording, ticks: int) -> Recording:
    return replace(
        run, time=run.time[:ticks], target=run.target[:ticks], position=run.position[:ticks]
    )


def seal(
    folder: Path,
    cases: Mapping[str, Sequence[Recording]],
    missing: Mapping[str, Mapping[str, float]] | None = None,
    tests: Mapping[str, Sequence[Recording]] | None = None,
) -> Path:
    """Seal recordings as the cases of `set`, with `key.json` beside it.

    Args:
      folder: of both.
      cases: their recordings by their ids.
      missing: what is missing in them; nothing where it is not told.
      tests: recordings for the score alone.

    Returns:
      The set.
    """
    for kind, some in (("recordings", cases), ("test", tests or {})):
        for name, runs in some.items():
            write_recordings(runs, folder / "set" / f"case_{name}" / kind)
    return sealed(folder, {name: (missing or {}).get(name, {}) for name in cases})


def sealed(folder: Path, cases: Mapping[str, Mapping[str, float]]) -> Path:
    """Seal what stands in `set`."""
    truths = [truth(name, missing) for name, missing in cases.items()]
    write_key(folder / "key.json", {"schema": 1, "salt": "ab", "cases": truths})
    (folder / "set").mkdir(exist_ok=True)
    commit(folder / "set", folder / "key.json")
    return folder / "set"


def motions(missing: Mapping[str, float]) -> tuple[list[Recording], list[Recording]]:
    """Recordings to find something in, and one of another motion to check it on."""
    runs = [shortened(run, ENOUGH) for run in recordings(missing)]
    return [r for r in runs if r.motion != "triangle"], [r for r in runs if r.motion == "triangle"]
