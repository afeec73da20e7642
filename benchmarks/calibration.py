"""How far a diagnosis's probabilities can be trusted, over several sealed sets together.

`python -m benchmarks.calibration SET KEY DIAGNOSES [SET KEY DIAGNOSES ...]` judges the diagnoses
of each opened set as `pup blind score` does, and tells the expected calibration error of the class
named first, of each set and of all: one of 80 cases has too few claims to show 0.05. Probabilities
are told beside how often they were right. `--robot NAME` looks at one kind of robot.
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pup.blind.bound import bounded
from pup.blind.judge import judge
from pup.blind.seal import verify
from pup.blind.statistics import BINS, calibration
from pup.robot import RobotDescription

Claim = tuple[float, bool]
"""The probability of the class that is named first, and whether it is right."""


def claims(folder: Path, key: Path, diagnoses: Path, robot: str | None) -> Iterator[Claim]:
    """Those of cases in which something that matters is missing, weak effects left out."""
    for truth in verify(folder, key)["cases"]:
        file = diagnoses / f"case_{truth['id']}" / "diagnosis.json"
        if not file.is_file() or robot not in (None, truth["robot"]):
            continue
        told, described = json.loads(file.read_text()), RobotDescription.load(truth["robot"])
        case = folder / f"case_{truth['id']}"
        entry, _ = bounded(truth, case, described, told.get("nominal"))
        judged = judge(entry, told, described)
        left_out = judged.null or judged.immaterial or judged.stratum == "weak"
        if judged.confidence is not None and not judged.excused and not left_out:
            yield judged.confidence, judged.kind == 1


def tell(name: str, made: list[Claim]) -> None:
    """A line of a set."""
    told = calibration([p for p, _ in made], [right for _, right in made])
    chance = f"chance up to {told['ece_chance']:.3f}" if made else "no claim"
    print(f"{name}: ECE {told['ece'] or 0:.3f} of {told['of']} ({chance})", flush=True)


def main() -> None:
    """Tell it of each set, and of all together."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sets", nargs="+", type=Path, metavar="SET KEY DIAGNOSES")
    parser.add_argument("--robot")
    asked = parser.parse_args()
    if len(asked.sets) % 3:
        parser.error("each set takes three paths: SET KEY DIAGNOSES")
    every: list[Claim] = []
    for i in range(0, len(asked.sets), 3):
        made = list(claims(*asked.sets[i : i + 3], asked.robot))
        tell(str(asked.sets[i]), made)
        every += made
    tell("all", every)
    told, right = np.array([p for p, _ in every]), np.array([r for _, r in every])
    within = np.minimum((told * BINS).astype(int), BINS - 1)
    for row in np.unique(within):
        here = within == row
        print(f"  told {told[here].mean():.3f}, right {right[here].mean():.3f} of {here.sum()}")


if __name__ == "__main__":
    main()
