"""How long a job took, over all its starts."""

import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.replays import Batch, Runner
from pup.errors import InputError
from pup.files import read_json, write_json

EVERY = 1.0
"""Time between two entries in the file, s."""


class Stopwatch:
    """Time spent on a job, kept in a file so that a job that was killed goes on counting.

    Args:
      file: where it is kept while the job lasts.
      digest: of the job; another job's time does not count.
    """

    def __init__(self, file: Path, digest: str) -> None:
        self.file, self.digest = file, digest
        self.before = self._kept()
        self.begin = time.monotonic(), time.process_time()
        self.entered = -EVERY

    def spent(self) -> tuple[float, float]:
        """Seconds, and seconds of this process's processor, from the first start on."""
        now = time.monotonic(), time.process_time()
        wall, processor = (
            round(before + end - begin, 3)
            for before, begin, end in zip(self.before, self.begin, now, strict=True)
        )
        return wall, processor

    def around(self, runner: Runner) -> Runner:
        """A runner whose calls are followed by an entry in the file."""

        def run(batches: Sequence[Batch]) -> list[NDArray[np.float64]]:
            answers = runner(batches)
            if time.monotonic() - self.entered >= EVERY:
                self.entered = time.monotonic()
                write_json(self.file, {"job": self.digest, "spent": self.spent()})
            return answers

        return run

    def _kept(self) -> tuple[float, float]:
        with suppress(InputError, KeyError, TypeError, ValueError):  # a torn file counts as none
            told = read_json(self.file)
            wall, processor = told["spent"]
            if told["job"] == self.digest:
                return float(wall), float(processor)
        return 0.0, 0.0
