"""Replays kept on disk, so that a diagnosis that was stopped goes on where it was.

The diagnosis asks for the same batches in the same order whenever it is run: one that was answered
before is read instead of simulated.
"""

import hashlib
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.replays import Batch, Runner
from pup.files import write_atomic

Array = NDArray[np.float64]


class Store:
    """Answers of a runner, kept in a folder.

    Args:
      folder: where they are kept.
      digest: of the measurements and the model.
    """

    def __init__(self, folder: Path, digest: str) -> None:
        self.folder = folder
        self.digest = digest

    def around(self, runner: Runner) -> Runner:
        """A runner that simulates only what is not kept yet."""

        def run(batches: Sequence[Batch]) -> list[Array]:
            files = [self.folder / f"{self._name(batch)}.f32" for batch in batches]
            kept = [_read(file) for file in files]
            missing = [i for i, answer in enumerate(kept) if answer is None]
            for i, answer in zip(missing, runner([batches[i] for i in missing]), strict=True):
                narrow = answer.astype(np.float32)  # to 1e-7 rad; kept or new, the same
                write_atomic(files[i], _bytes(narrow))
                kept[i] = narrow.astype(np.float64)
            return [answer for answer in kept if answer is not None]

        return run

    def clear(self) -> None:
        """Remove all that is kept, and what a killed process was writing."""
        if self.folder.is_dir():
            shutil.rmtree(self.folder)

    def _name(self, batch: Batch) -> str:
        digest = hashlib.sha256(self.digest.encode())
        digest.update("\n".join(batch.candidates.space.names).encode())
        digest.update(np.ascontiguousarray(batch.candidates.values).tobytes())
        digest.update(repr((batch.recordings, batch.until, batch.coarse)).encode())
        if batch.push is not None:
            digest.update(repr(batch.push.period).encode())
            digest.update(np.ascontiguousarray(batch.push.values).tobytes())
        return digest.hexdigest()


def _bytes(values: NDArray[np.float32]) -> bytes:
    shape = np.array(values.shape, dtype=np.int64)
    return shape.tobytes() + values.tobytes()


def _read(file: Path) -> Array | None:
    try:
        raw = file.read_bytes()
    except FileNotFoundError:
        return None
    rows, columns = np.frombuffer(raw[:16], dtype=np.int64)
    values = np.frombuffer(raw[16:], dtype=np.float32).reshape(int(rows), int(columns))
    return values.astype(np.float64)
