"""Diagnosis on Ray: every batch of replays is a stateless task.

Sensitivities, refits and leave-one-out predictions of the diagnosis are all rows of parameters to
be replayed; the driver asks for them in batches, and what answers them is here. A lost worker or
node costs its tasks, which run again elsewhere and come to the same.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import ray
from numpy.typing import NDArray

from pup.diagnosis.replays import Batch, Bench, Runner
from pup.diagnosis.residuals import Measured
from workers.fits import RETRIES, fetched

Array = NDArray[np.float64]

_BENCHES: dict[str, Bench] = {}
"""Measurements with their compiled models, kept by a worker process from task to task."""
CACHED = 4


def ray_runner(measured: Measured, actuator: str) -> Runner:
    """A runner of batches with an actuator on the Ray cluster this process is connected to."""
    shared = ray.put(measured)
    name = shared.hex()

    def run(batches: Sequence[Batch]) -> list[Array]:
        asked = [replay.remote(name, [shared], actuator, batch) for batch in batches]
        return [fetched(one) for one in asked]

    return run


def lanes() -> int:
    """Batches that the cluster can run at once."""
    return max(1, int(ray.cluster_resources().get("CPU", 1)))


@ray.remote(num_cpus=1, max_retries=RETRIES)
def replay(name: str, measured: list[Any], actuator: str, batch: Batch) -> Array:
    """Samples of one batch."""
    if name not in _BENCHES:
        if len(_BENCHES) >= CACHED:
            _BENCHES.clear()
        _BENCHES[name] = Bench(ray.get(measured[0]), actuator)
    return _BENCHES[name].run(batch)
