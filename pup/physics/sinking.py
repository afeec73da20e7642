"""How deep a robot that rests has sunk into the floor.

Contacts are springs. A robot that is put on top of the floor drops and rocks until these carry it,
and one that has stood there for a while did so before its recording began.
"""

import mujoco.batch
import numpy as np
from numpy.typing import NDArray

HEIGHT = 2
"""Place of the torso's height in qpos, and of its speed among the degrees of freedom."""
DEEPEST = 0.03
"""A floor in which a robot sinks further is none, m."""
HALVINGS = 12


def sink(batch: mujoco.batch.Batch, rows: NDArray[np.int32]) -> None:
    """Lower robots to where the floor carries them; their derived quantities are made anew.

    Args:
      batch: the simulations, with their torques applied; the lowest points are on the floor.
      rows: those whose robots rest.
    """
    qpos, carried, others = (batch.bind(n) for n in ("qpos", "qfrc_constraint", "qfrc_smooth"))
    top = qpos[rows, HEIGHT].copy()
    least, most = np.zeros(len(rows)), np.full(len(rows), DEEPEST)
    for _ in range(HALVINGS):
        depth = (least + most) / 2
        qpos[rows, HEIGHT] = top - depth
        batch.forward(ids=rows)
        falls = carried[rows, HEIGHT] + others[rows, HEIGHT] < 0
        least, most = np.where(falls, depth, least), np.where(falls, most, depth)
