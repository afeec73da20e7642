"""What the exporters share."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from math import isnan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pup.recording import Recording

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Take:
    """One recording, with what the simulator made of it where it was replayed.

    Attributes:
      recording: as it is.
      simulated: columns of the contract at the recording's times, each of shape (n_ticks,); NaN
        where the simulation broke down.
    """

    recording: Recording
    simulated: Mapping[str, Array] = field(default_factory=dict)


def nested(columns: Iterator[tuple[str, Array]]) -> Iterator[dict[str, Any]]:
    """Rows as JSON objects, `position/l_knee` as `{"position": {"l_knee": ...}}`; None for NaN."""
    named = [(name.partition("/"), values) for name, values in columns]
    lists = [[None if isnan(v) else v for v in values.tolist()] for _, values in named]
    for row in zip(*lists, strict=True):
        nest: dict[str, Any] = {}
        for ((kind, slash, part), _), value in zip(named, row, strict=True):
            if slash:
                nest.setdefault(kind, {})[part] = value
            else:
                nest[kind] = value
        yield nest
