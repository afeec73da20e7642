"""The flight recorder: what a walk did so far, in a file while it walks.

An agent that is killed leaves it behind, and the next start makes a recording of it. A line of JSON
tells what it is about; a row of float64 per tick follows. A last row that was cut off is left out.
The next walk takes its place.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hardware_agent.rollout import Row, row_names
from pup.wire import Assign

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Flight:
    """What is known of a walk.

    Attributes:
      assign: the trial.
      rows: of its ticks, shape (n_ticks, n_columns); see `row_names`.
    """

    assign: Assign
    rows: Array


class FlightRecorder:
    """The file of the latest walk.

    Losing it must not stop a walk: where the disk does not take it, there is none.

    Args:
      file: that it is in.
      joints: of the robot.
    """

    def __init__(self, file: Path, joints: Sequence[str]) -> None:
        self._file, self._width = file, len(row_names(joints))
        self._kept, self._lost = 0, False

    def begin(self, assign: Assign) -> None:
        """A walk begins."""
        self._kept, self._lost = 0, False
        try:
            self._file.write_bytes(json.dumps(asdict(assign)).encode() + b"\n")
        except OSError:
            self._lost = True

    def keep(self, rows: Sequence[Row]) -> None:
        """Add what is new.

        Args:
          rows: all of the walk so far.
        """
        new = rows[self._kept :]
        self._kept += len(new)
        if not new or self._lost:
            return
        try:
            with self._file.open("ab") as file:
                file.write(np.array([row.values for row in new]).tobytes())
        except OSError:  # it ends here: what came behind half a row could not be told from it
            self._lost = True

    def left(self) -> Flight | None:
        """The latest walk, as far as it can be read."""
        try:
            head, _, data = self._file.read_bytes().partition(b"\n")
            told = json.loads(head)
            assign = Assign(**(told | {"eta": tuple(told["eta"])}))
        except (OSError, ValueError, TypeError, KeyError):
            return None
        whole = len(data) // (8 * self._width)
        values = np.frombuffer(data[: 8 * self._width * whole])
        return Flight(assign, values.reshape(whole, self._width))
