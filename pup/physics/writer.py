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


class RowWriter(FieldWriter):
    """The same for some of the simulations, whose fields start from the model's own values.

    Args:
      batch: the simulations.
      model: what they are simulations of.
      rows: which of them, shape (n_rows,). The fields have a row for each.
    """

    def __init__(
        self, batch: mujoco.batch.Batch, model: mujoco.MjModel, rows: NDArray[np.int32]
    ) -> None:
        super().__init__(batch, model)
        self.rows = rows
        self._fields: dict[str, Array] = {}

    def field(self, name: str) -> Array:
        """A model field to write to, shape (n_rows, ...)."""
        if name not in self._fields:
            own = self.model.opt if name.startswith("opt.") else self.model
            value = np.asarray(getattr(own, name.removeprefix("opt.")))
            self._fields[name] = np.tile(value, (len(self.rows), *[1] * value.ndim))
        return self._fields[name]

    def done(self) -> None:
        """Write the fields to the batch and recompute what follows from them."""
        for name, values in self._fields.items():
            super().field(name)[self.rows] = values
        if self.stale:
            self.batch.set_const(ids=self.rows)
