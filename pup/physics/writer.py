"""Per-simulation fields of a batch, written by the names of their elements."""

import mujoco
import mujoco.batch
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class FieldWriter:
    """Per-simulation model fields, with the constants MuJoCo derives from them kept in step.

    Args:
      batch: the simulations.
      model: what they are simulations of.
    """

    def __init__(self, batch: mujoco.batch.Batch, model: mujoco.MjModel) -> None:
        self.batch = batch
        self.model = model
        self.stale = False

    def field(self, name: str) -> Array:
        """A model field, live, shape (n_simulations, ...)."""
        self.stale |= name in mujoco.MjModel._setconst_inputs or name.startswith("opt.")
        return np.asarray(self.batch.expand(name))

    def element(self, name: str, element: str) -> Array:
        """One named element of a model field, live, shape (n_simulations, ...)."""
        kind = {"jnt": "joint", "dof": "joint"}.get(name.split("_")[0], name.split("_")[0])
        accessor = getattr(self.model, kind)
        index = (
            int(self.model.joint(element).dofadr[0])
            if name.startswith("dof_")
            else accessor(element).id
        )
        return self.field(name)[:, index]

    def done(self) -> None:
        """Recompute what follows from the fields written."""
        if self.stale:
            self.batch.set_const()
