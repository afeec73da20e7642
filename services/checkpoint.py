"""Checkpoints of a training: arrays and the curve so far in one file, without pickle."""

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.files import write_atomic

SCHEMA = 2
META = "meta"


class Checkpoint:
    """What a file tells of a training, if it is there.

    Args:
      file: the checkpoint.
      digest: of the training it must be of.

    Attributes:
      state: arrays by name; none at the beginning.
      rows: of the curve.
      lost: steps lost with their runners.
      seconds: spent on iterations.

    Raises:
      InputError: it is of another training, or no checkpoint.
      OSError: it cannot be read now.
    """

    def __init__(self, file: Path, digest: str) -> None:
        self.file, self.digest = file, digest
        self.state: dict[str, NDArray[Any]] = {}
        self.rows: list[dict[str, Any]] = []
        self.lost, self.seconds = 0, 0.0
        if file.exists():
            self._read()

    def _read(self) -> None:
        raw = self.file.read_bytes()  # trouble of the storage is none of the file
        try:
            with np.load(io.BytesIO(raw), allow_pickle=False) as packed:
                told = {name: packed[name] for name in packed.files}
            meta = json.loads(told.pop(META).tobytes())
            schema, digest = meta["schema"], meta["digest"]
        except Exception as error:  # NumPy's reader raises what a torn file happens to hit
            raise InputError(f"{self.file}: not a checkpoint; use another --out") from error
        if (schema, digest) != (SCHEMA, self.digest):
            raise InputError(
                f"{self.file}: a checkpoint of another training; repeat its command to go on with "
                "it, or use another --out"
            )
        self.state, self.rows = told, meta["rows"]
        self.lost, self.seconds = meta["lost"], meta["seconds"]

    def write(
        self,
        state: Mapping[str, NDArray[Any]],
        rows: list[dict[str, Any]],
        lost: int,
        seconds: float,
    ) -> None:
        """Replace the file."""
        meta = {"schema": SCHEMA, "digest": self.digest, "rows": rows}
        meta |= {"lost": lost, "seconds": seconds}
        words = np.frombuffer(json.dumps(meta, allow_nan=False).encode(), dtype=np.uint8)
        packed = io.BytesIO()
        np.savez(packed, allow_pickle=False, **{**state, META: words})
        write_atomic(self.file, packed.getvalue())
