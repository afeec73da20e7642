"""How hot the motors' windings are, over a restart of the agent: their heat outlives it."""

import json
import math
import time
from contextlib import suppress
from pathlib import Path

PERIOD = 1.0  # s between two writings
LEAST = 0.01  # share of the allowed heat that is not worth it


class Warmth:
    """A file with the heat of the hottest winding.

    Args:
      file: where it is.
      time_constant: in which windings cool, s.
    """

    def __init__(self, file: Path, time_constant: float) -> None:
        self._file, self._time_constant = file, time_constant
        self._written, self._told = -math.inf, 0.0

    def left(self) -> float:
        """What is left of the heat, as a share of what is allowed; all of it where none knows."""
        try:
            told = json.loads(self._file.read_text())
            share, age = float(told["share"]), time.time() - float(told["at"])
        except FileNotFoundError:
            return 0.0
        except (OSError, ValueError, TypeError, KeyError):
            return 1.0
        if not 0 <= share <= 1:
            return 1.0
        return share * math.exp(-max(age, 0.0) / self._time_constant)

    def keep(self, share: float) -> None:
        """Write it down, now and then; a full disk stops no robot.

        Args:
          share: of what is allowed.
        """
        now = time.monotonic()
        if now - self._written < PERIOD or max(share, self._told) < LEAST:
            return
        self._written, self._told = now, share
        with suppress(OSError):
            fresh = self._file.with_suffix(".new")
            fresh.write_text(json.dumps({"share": min(share, 1.0), "at": time.time()}))
            fresh.replace(self._file)
