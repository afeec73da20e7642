"""A concealed Darwin with 15 recordings of 8 s, made as sealed cases are, to time diagnosis on.

`python -m benchmarks.long_set --out DIR` writes DIR/recordings and DIR/truth.json, which takes some
minutes; then `pup diagnose DIR/recordings --robot darwin_op2 --out VERDICT --cores 2`.
"""

import argparse
from pathlib import Path
from unittest.mock import patch

import numpy as np

from pup.blind import motions, programme
from pup.blind.cases import make_case
from pup.blind.motions import LIMB
from pup.blind.seal import write_key
from pup.blind.setting import STRATA, Setting
from pup.recording import write_recordings
from pup.robot import RobotDescription

SECONDS = 8.0
PLAYED = 13
"""Motions, of every type two or three; one of them is repeated twice."""


def every_type(
    ground: bool, given: Setting, rng: np.random.Generator
) -> tuple[list[tuple[str, bool]], list[tuple[str, bool, bool]]]:
    """Types of motion in the air, none of them kept for a test; as `programme._types`."""
    types = [m for m in LIMB if not (given.powered and m == "drop")]
    return [(types[k % len(types)], False) for k in range(PLAYED)], []


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stratum", choices=STRATA, default="single")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True)
    asked = parser.parse_args()
    robot = RobotDescription.load("darwin_op2")
    with (
        patch.object(motions, "DURATION", (SECONDS, SECONDS)),
        patch.object(programme, "REPEATED", 1.0),
        patch.object(programme, "_types", every_type),
    ):
        case = make_case(robot, asked.stratum, False, (20261130, 15, asked.seed), "long")
    write_recordings(case.recordings, asked.out / "recordings")
    write_key(asked.out / "truth.json", case.truth)
    print(f"{len(case.recordings)} recordings of {SECONDS:g} s in {asked.out}")


if __name__ == "__main__":
    main()
