"""How much faster a second worker makes a diagnosis.

`python -m benchmarks.workers --robot darwin_leg RECORDINGS` diagnoses on Ray and has every call's
batches run twice: one after another, as by one worker, and as many at once as there are cores. Both
fall into the same seconds, so that a machine that is now faster and now slower does not decide.
What the searching process does between calls is counted once for each. One worker alone would have
larger batches, which on a leg cost a tenth less; on a whole robot they are full anyway.
"""

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pup.diagnosis.engine import diagnose
from pup.diagnosis.replays import Batch, Runner
from pup.diagnosis.residuals import Measured
from pup.recording import load_recordings
from pup.robot import RobotDescription
from workers.cluster import connected
from workers.hypotheses import lanes, ray_runner

Array = NDArray[np.float64]


@dataclass
class Tally:
    """Seconds that batches took, and how many calls they were.

    Attributes:
      one: one batch after another.
      many: on all workers.
      calls: of the searching process.
    """

    one: float = 0.0
    many: float = 0.0
    calls: int = 0

    def around(self, run: Runner) -> Runner:
        """A runner whose batches are run both ways, first one and then the other in turn."""

        def one_by_one(batches: Sequence[Batch]) -> list[Array]:
            return [run([batch])[0] for batch in batches]

        def both(batches: Sequence[Batch]) -> list[Array]:
            ways = [("one", one_by_one), ("many", run)]
            for name, way in ways if self.calls % 2 else ways[::-1]:
                start = time.perf_counter()
                samples = way(batches)
                setattr(self, name, getattr(self, name) + time.perf_counter() - start)
            self.calls += 1
            return samples

        return both


def main() -> None:
    """Diagnose, and tell of both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--robot", required=True)
    parser.add_argument("--effects", type=int, default=8)
    parser.add_argument("--cores", type=int, default=2)
    asked = parser.parse_args()
    robot = RobotDescription.load(asked.robot)
    recordings, tally = load_recordings(asked.recordings, robot), Tally()

    def factory(measured: Measured) -> Runner:
        return tally.around(ray_runner(measured, "pd"))

    with connected(cores=asked.cores), threadpool_limits(limits=1):
        start = time.perf_counter()
        told = diagnose(robot, recordings, factory, lanes(), lambda *_: None, effects=asked.effects)
        between = time.perf_counter() - start - tally.one - tally.many
    one, many = tally.one + between, tally.many + between
    print(
        f"{told.verdict}, {told.replays} candidates in {tally.calls} calls; one worker {one:.0f} s,"
        f" {asked.cores} workers {many:.0f} s: {one / many:.2f} times as fast; "
        f"{between:.1f} s of each between calls"
    )


if __name__ == "__main__":
    main()
