"""What the ground is like beyond one friction coefficient."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from pup.physics.rotations import CONJUGATE, multiply, rotation
from pup.physics.terms.base import Quantity, Term
from pup.physics.writer import FieldWriter

Array = NDArray[np.float64]

LEAST = 0.02
"""Friction coefficient that a change leaves, of what there was."""


def _direct(solref: Array) -> NDArray[np.bool_]:
    """Whether contact parameters (n, 2) are MuJoCo's stiffness and damping, negative; (n, 1)."""
    return np.asarray(solref[:, :1] <= 0)


class GroundCompliance(Term):
    """A softer floor: contacts take longer to push back."""

    effect = "ground_compliance"
    kinds = ("ground", "foot")
    layout = "feet"
    quantities = (Quantity("time", "s", 0.02, 0.2),)
    source = "a yoga mat of 6 mm foam, as in the paper: 100 to 300 N m/rad at the ankle"

    def fields(self, writer: FieldWriter) -> None:
        """See Term."""
        solref = writer.field("geom_solref")
        for geom, column in self.scene.model.contacts:
            own, time = solref[:, geom], self.values["time"][:, column]
            # Of stiffness and damping instead, negative, the time constant is two by the damping.
            slower = 1 / (1 + np.maximum(-own[:, 1], 0.0) * time / 2)
            direct = own * np.stack([slower**2, slower], axis=1)
            slow = own + np.stack([time, np.zeros_like(time)], axis=1)
            solref[:, geom] = np.where(_direct(own), direct, slow)


class ContactRestitution(Term):
    """A livelier contact: as stiff as before, it damps less of an impact."""

    effect = "contact_restitution"
    kinds = ("ground", "foot")
    layout = "feet"
    quantities = (Quantity("share", "1", 0.4, 0.95),)
    source = "estimate"

    def fields(self, writer: FieldWriter) -> None:
        """See Term."""
        solref = writer.field("geom_solref")
        left = np.maximum(1 - self.values["share"], 0.02)
        for geom, column in self.scene.model.contacts:
            # MuJoCo's stiffness goes by the product of the two, its damping by the first, unless
            # they are themselves stiffness and damping.
            direct = _direct(solref[:, geom])[:, 0]
            solref[:, geom, 0] /= np.where(direct, 1.0, left[:, column])
            solref[:, geom, 1] *= left[:, column]


class GroundFriction(Term):
    """One foot's friction differs from the floor's."""

    effect = "ground_friction"
    kinds = ("foot",)
    layout = "feet"
    quantities = (Quantity("change", "1", 0.3, 1.0, signed=True),)
    source = "estimate: rubber 1.0 to plastic 0.4"

    def fields(self, writer: FieldWriter) -> None:
        """See Term."""
        friction = writer.field("geom_friction")
        for geom, column in self.scene.model.contacts:
            own = friction[:, geom, 0]
            changed = own + self.values["change"][:, column]
            friction[:, geom, 0] = np.maximum(changed, np.minimum(own, LEAST))


class GroundSlope(Term):
    """The floor leans: gravity is turned against it, and with it what the IMU tells."""

    effect = "ground_slope"
    constant = True
    kinds = ("ground",)
    layout = "one"
    quantities = (
        Quantity("roll", "rad", 0.02, 0.3, signed=True),
        Quantity("pitch", "rad", 0.02, 0.3, signed=True),
    )
    source = "estimate: a degree of an uneven floor"

    def prepare(self) -> None:
        """See Term."""
        both = np.hstack([self.values["roll"], self.values["pitch"]])
        self._lean = rotation(np.hstack([both, np.zeros((len(both), 1))]))
        self._back = self._lean * CONJUGATE

    def fields(self, writer: FieldWriter) -> None:
        """See Term."""
        gravity = writer.field("opt.gravity")
        for row in np.flatnonzero(self._lean[:, 1:].any(axis=1)):
            mujoco.mju_rotVecQuat(gravity[row], gravity[row].copy(), self._back[row])

    def start(self, position: Array, torso: Array) -> None:
        """See Term: the torso was read against gravity."""
        torso[:] = multiply(self._back, torso)

    def tilt(self, quaternion: Array, rows: NDArray[np.int64]) -> Array:
        """See Term."""
        return multiply(self._lean[rows], quaternion)
