"""Masses, inertias and forces the model does not have."""

import numpy as np
from numpy.typing import NDArray

from pup.physics.terms.base import Quantity, Term
from pup.physics.terms.transmission import Transmission
from pup.physics.writer import FieldWriter

Array = NDArray[np.float64]


class Payload(Term):
    """A mass at a body's centre of mass; negative where the model is too heavy."""

    effect = "payload"
    constant = True
    kinds = ("body",)
    layout = "bodies"
    quantities = (Quantity("mass", "kg", 0.05, 1.0, signed=True),)
    source = "estimate: 5 to 10 % of a link"

    def fields(self, writer: FieldWriter) -> None:
        """See Term."""
        mass = writer.field("body_mass")
        mass[:] = np.maximum(mass + self.values["mass"], 0.05 * mass)


class Armature(Term):
    """Inertia of a joint's rotor and gear beyond the nominal."""

    effect = "armature"
    constant = True
    kinds = ("joint",)
    quantities = (Quantity("inertia", "kg m2", 0.003, 0.05),)
    source = "MX-28: 193:1 gear on a coreless rotor, 0.001 to 0.01"

    def fields(self, writer: FieldWriter) -> None:
        """See Term."""
        writer.field("dof_armature")[:, self.scene.model.dofs] += self.values["inertia"]
        self.scene.armature[:] += self.values["inertia"]
        self.scene.inertia[:] += self.values["inertia"]


class ComOffset(Term):
    """A body's centre of mass is elsewhere, in the body's own axes."""

    effect = "com_offset"
    constant = True
    kinds = ("body",)
    layout = "bodies"
    quantities = tuple(Quantity(axis, "m", 0.01, 0.1, signed=True) for axis in "xyz")
    source = "estimate: 5 to 20 mm at the torso (paper, section III)"

    def fields(self, writer: FieldWriter) -> None:
        """See Term."""
        place = writer.field("body_ipos")
        for axis, name in enumerate("xyz"):
            place[:, :, axis] += self.values[name]


class StructuralFlex(Transmission):
    """A body gives under the torque of the joint that carries it, out of its encoder's sight."""

    effect = "structural_flex"
    kinds = ("body",)
    layout = "carried"
    quantities = (Quantity("compliance", "rad/(N m)", 0.006, 0.1),)
    source = "estimate: 100 to 500 N m/rad"

    def give(self) -> Array:
        """See Transmission."""
        return self.values["compliance"]

    def behind(self) -> Array:
        """See Transmission."""
        return np.zeros_like(self.values["compliance"])


class ExternalForce(Term):
    """A constant force on a body, in the world's axes: a tether, wind."""

    effect = "external_force"
    constant = True
    kinds = ("body",)
    layout = "bodies"
    quantities = tuple(Quantity(axis, "N", 1.0, 30.0, signed=True) for axis in "xyz")
    source = "the paper's robot walks to the end of its power cable"

    def push(self, xfrc: Array) -> None:
        """See Term."""
        for axis, name in enumerate("xyz"):
            xfrc[:, :, axis] += self.values[name]
