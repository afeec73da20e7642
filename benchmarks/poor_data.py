"""What a diagnosis says of recordings that were spoiled: honest is `undetermined`, or a refusal.

`python -m benchmarks.poor_data --robot darwin_leg RECORDINGS` spoils sound recordings in seven ways
and diagnoses each; a name with more than an even chance is a fault, and the exit status is 1.
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pup.diagnosis.engine import diagnose
from pup.diagnosis.replays import Bench, threads
from pup.errors import InputError
from pup.recording import Recording, load_recordings
from pup.recording_cuts import thinned
from pup.robot import RobotDescription

CONFIDENT = 0.5
SLOW = 0.2  # s
CLIP = 0.6  # of what a joint moves

Runs = Sequence[Recording]


def still(runs: Runs) -> list[Recording]:
    """Nothing is asked, and nothing but noise is read."""
    rng = np.random.default_rng(0)
    return [
        replace(
            r,
            target=np.broadcast_to(r.target[0], r.target.shape),
            position=r.position[0] + 0.001 * rng.normal(size=r.position.shape),
        )
        for r in runs
    ]


def on_first(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Runs], list[Recording]]:
    """The first joint's readings changed."""

    def spoil(runs: Runs) -> list[Recording]:
        out = []
        for r in runs:
            position = r.position.copy()
            position[:, 0] = change(position[:, 0])
            out.append(replace(r, position=position))
        return out

    return spoil


def clipped(q: np.ndarray) -> np.ndarray:
    """Readings that end short of what the joint moves."""
    middle, reach = (np.nanmax(q) + np.nanmin(q)) / 2, np.nanmax(q) - np.nanmin(q)
    return np.clip(q, middle - CLIP * reach / 2, middle + CLIP * reach / 2)


def slow(runs: Runs) -> list[Recording]:
    """Read at 5 Hz."""
    return [thinned(r, max(1, round(SLOW / float(np.median(np.diff(r.time)))))) for r in runs]


def exchanged(runs: Runs) -> list[Recording]:
    """The first two joints' readings in each other's column."""
    if len(runs[0].joints) < 2:
        raise InputError("one joint alone cannot be exchanged")
    order = [1, 0, *range(2, len(runs[0].joints))]
    return [replace(r, position=r.position[:, order]) for r in runs]


def another(runs: Runs) -> list[Recording]:
    """Recordings of another robot, by its joints."""
    return [replace(r, joints=tuple(f"arm_{i}" for i in range(len(r.joints)))) for r in runs]


FAULTS: dict[str, Callable[[Runs], Runs]] = {
    "one recording": lambda runs: runs[:1],
    "no excitation": still,
    "an encoder that is stuck": on_first(lambda q: 0 * q + q[0]),
    "an encoder that is clipped": on_first(clipped),
    "5 Hz": slow,
    "two joints exchanged": exchanged,
    "another robot": another,
}


def said(robot: RobotDescription, runs: Runs) -> tuple[str, float]:
    """The answer, and the largest probability of a name in it."""
    try:
        for run in runs:
            run.validate(robot)
        told = diagnose(robot, runs, lambda m: threads(Bench(m), 1), 1, lambda stage, share: None)
    except InputError as error:
        return f"refused: {error}", 0.0
    named = [f.probability for f in told.findings if f.effect != "unknown"]
    words = ", ".join(f"{f.effect} {f.probability:.2f}" for f in told.findings)
    return f"{told.verdict}: {told.reason or words}", max(named, default=0.0)


def main() -> int:
    """Print the table; 1 where a name was given with confidence."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", required=True)
    parser.add_argument("recordings", type=Path, nargs="+")
    asked = parser.parse_args()
    robot = RobotDescription.load(asked.robot)
    sound = load_recordings(asked.recordings, robot)
    worst = 0.0
    print("| fault | answer |\n|---|---|")
    for name, spoil in FAULTS.items():
        try:
            answer, chance = said(robot, spoil(sound))
        except InputError as error:
            answer, chance = f"does not apply: {error}", 0.0
        worst = max(worst, chance)
        print(f"| {name} | {answer} |", flush=True)
    return int(worst > CONFIDENT)


if __name__ == "__main__":
    raise SystemExit(main())
