"""Between motor and link: play, give, springs and stops."""

import numpy as np
from numpy.typing import NDArray

from pup.physics.terms.base import Flow, Quantity, Term
from pup.physics.writer import FieldWriter

Array = NDArray[np.float64]


class Transmission(Term):
    """A motor with its own rotor that reaches the link through play and give.

    Motor and link are two masses. The motor's step is solved together with the link's: seen from
    the link, the rest is a torque and a viscous coefficient, whatever the stiffness between them,
    and as play and give go to nothing the rotor's inertia goes back to the link.
    """

    def gap(self) -> Array:
        """Half of the play, (n_simulations, n_joints), rad."""
        raise NotImplementedError

    def give(self) -> Array:
        """Compliance, same shape, rad/(N m)."""
        raise NotImplementedError

    def behind(self) -> Array:
        """Share of the play and give that the encoder sees: 0 at the motor, 1 at the link."""
        raise NotImplementedError

    def prepare(self) -> None:
        """See Term."""
        self._gap, self._give, self._behind = self.gap(), self.give(), self.behind()
        self.active = (self._gap > 0) | (self._give > 0)
        self._position: Array | None = None
        self._velocity = np.zeros_like(self._gap)
        self._free = np.zeros_like(self._gap)
        self._heft = np.ones_like(self._gap)
        self._sent = np.zeros_like(self._gap), np.zeros_like(self._gap)

    def fields(self, writer: FieldWriter) -> None:
        """See Term: the rotor leaves the link."""
        armature = writer.field("dof_armature")
        dofs = self.scene.model.dofs
        armature[:, dofs] = np.where((self.gap() > 0) | (self.give() > 0), 0.0, armature[:, dofs])

    def sense(self, position: Array, velocity: Array) -> tuple[Array, Array]:
        """See Term."""
        n = len(position)
        if self._position is None:
            self._position = position.copy()
            self._velocity[:] = velocity
        else:
            torque, damping = (part[:n] for part in self._sent)
            carried = torque - damping * velocity
            self._velocity[:n] = self._free[:n] - carried / self._heft[:n]
            self._position[:n] += self.scene.timestep * self._velocity[:n]
        behind, active = self._behind[:n], self.active[:n]
        told = behind * position + (1 - behind) * self._position[:n]
        speed = behind * velocity + (1 - behind) * self._velocity[:n]
        return np.where(active, told, position), np.where(active, speed, velocity)

    def flow(self, flow: Flow) -> None:
        """See Term."""
        assert self._position is not None
        n, step = len(flow.torque), self.scene.timestep
        gap, heft = self._gap[:n], self._heft[:n]
        rotor = np.maximum(self.scene.armature[:n], 1e-7) / step
        heft[:] = rotor + flow.damping
        self._free[:n] = (rotor * self._velocity[:n] + flow.torque) / heft
        ahead = self._position[:n] - flow.position
        coming = ahead + step * (self._free[:n] - flow.velocity)
        beyond = coming - np.clip(coming, -gap, gap)
        side = np.sign(beyond) * gap
        grip = step / (self._give[:n] + step / heft)
        torque = np.where(beyond != 0, grip * ((ahead - side) / step + self._free[:n]), 0.0)
        damping = np.where(beyond != 0, grip, 0.0)
        for sent, part in zip(self._sent, (torque, damping), strict=True):
            sent[:n] = part
        np.copyto(flow.torque, torque, where=self.active[:n])
        np.copyto(flow.damping, damping, where=self.active[:n])


class Backlash(Transmission):
    """Play between motor and link."""

    effect = "backlash"
    quantities = (
        Quantity("gap", "rad", 0.006, 0.06),
        Quantity("behind", "1", 1.0, 1.0, grid=(0.0, 1.0)),
    )
    source = "half of 0.01 to 0.035 rad: Webots' OP2, SO-101, microduck"

    def gap(self) -> Array:
        """See Transmission."""
        return self.values["gap"]

    def give(self) -> Array:
        """See Transmission."""
        return np.zeros_like(self.values["gap"])

    def behind(self) -> Array:
        """See Transmission."""
        return self.values["behind"]


class JointCompliance(Transmission):
    """A spring between motor and link."""

    effect = "joint_compliance"
    quantities = (
        Quantity("compliance", "rad/(N m)", 0.008, 0.1),
        Quantity("behind", "1", 1.0, 1.0, grid=(0.0, 1.0)),
    )
    source = "estimate: 60 to 300 N m/rad"

    def gap(self) -> Array:
        """See Transmission."""
        return np.zeros_like(self.values["compliance"])

    def give(self) -> Array:
        """See Transmission."""
        return self.values["compliance"]

    def behind(self) -> Array:
        """See Transmission."""
        return self.values["behind"]


class JointSpring(Term):
    """A spring beside the servo: a cable or a harness."""

    effect = "joint_spring"
    kinds = ("joint",)
    quantities = (
        Quantity("stiffness", "N m/rad", 0.15, 3.0),
        Quantity("preload", "N m", 0.05, 1.0, signed=True),
    )
    source = "estimate: 0.05 to 0.3 N m/rad"

    def flow(self, flow: Flow) -> None:
        """See Term."""
        n = len(flow.torque)
        flow.torque += self.values["preload"][:n] - self.values["stiffness"][:n] * flow.position


class JointStop(Term):
    """Something stiff in the way beyond an angle."""

    effect = "joint_stop"
    kinds = ("joint",)
    quantities = (
        Quantity("stiffness", "N m/rad", 20.0, 500.0),
        Quantity("angle", "rad", 0.0, 3.2, grid=(-1.0, 1.0)),
        Quantity("side", "1", 1.0, 1.0, grid=(-1.0, 1.0)),
    )
    source = "geometry; stiffness of plastic parts"

    def flow(self, flow: Flow) -> None:
        """See Term."""
        n = len(flow.torque)
        stiffness, side = self.values["stiffness"][:n], np.sign(self.values["side"][:n])
        into = side * (flow.position - self.values["angle"][:n])
        pressed = np.where(into > 0, stiffness, 0.0)
        flow.torque -= side * pressed * into
        flow.damping += pressed * self.scene.timestep
