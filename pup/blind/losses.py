"""Gears and bearings: what resists a joint other than the nominal law's damping."""

import numpy as np

from pup.blind.parts import Moment, Part

ELEMENTS = 8  # springs with sliders, in parallel
SMOOTH = 0.004  # s, over which gear teeth average their load
CHANGE = 0.02  # W, power at which a gear changes between driving and being driven
OVERTONE = 0.25


class CoulombFriction(Part):
    """The same grip at any speed."""

    def hold(self, now: Moment) -> None:
        """Grip."""
        now.grip[self.at] += self.size


class StribeckFriction(Part):
    """A grip that falls from rest to speed, by Hess and Soom's law."""

    def hold(self, now: Moment) -> None:
        """Grip by the speed."""
        fast = (now.speed[self.at] / self.shape["speed"]) ** 2
        floor = self.shape["floor"]
        now.grip[self.at] += self.size * (floor + (1.0 - floor) / (1.0 + fast))


class PreslidingHysteresis(Part):
    """Iwan's bed of springs with sliders, whose breakaway lengths are spread."""

    def begin(self) -> None:
        """All springs relaxed."""
        spread = np.geomspace(0.2, 3.0, ELEMENTS)
        self.length = self.shape["length"] * spread
        self.stiffness = self.size / ELEMENTS / self.length
        self.stretch = np.zeros((*self.lanes, ELEMENTS))

    def resist(self, now: Moment) -> None:
        """Stretch, slide and pull back."""
        moved = self.stage.step * now.speed[self.at][..., None]
        self.stretch = np.clip(self.stretch + moved, -self.length, self.length)
        now.passive[self.at] -= self.stretch @ self.stiffness


class LoadDependentFriction(Part):
    """Teeth that are pressed on both sides of the gear."""

    def begin(self) -> None:
        """No load yet."""
        self.load = np.zeros(self.lanes)
        self.share = -np.expm1(-self.stage.step / SMOOTH)

    def hold(self, now: Moment) -> None:
        """Grip by the load on teeth."""
        drive = now.drive[self.at]
        passed = drive - self.stage.rotor[self.at] * now.acceleration[self.at]
        self.load += self.share * (np.abs(drive) + np.abs(passed) - self.load)
        now.grip[self.at] += self.size * self.load


class GearEfficiency(Part):
    """Less torque comes through when driving, more is needed when driven."""

    def hold(self, now: Moment) -> None:
        """Grip by the direction of power."""
        drive = now.drive[self.at]
        driving = 0.5 * (1.0 + np.tanh(drive * now.speed[self.at] / CHANGE))
        back = 1.0 / (1.0 - self.size) - 1.0
        now.grip[self.at] += np.abs(drive) * (driving * self.size + (1.0 - driving) * back)


class FrictionAsymmetry(Part):
    """Dry friction of another size in each direction."""

    def resist(self, now: Moment) -> None:
        """Push to the easy side."""
        now.passive[self.at] -= self.size * self.shape["share"]

    def hold(self, now: Moment) -> None:
        """Grip by the mean of both sides."""
        now.grip[self.at] += self.size


class QuadraticDamping(Part):
    """Churning grease and air: about the square of the speed."""

    def resist(self, now: Moment) -> None:
        """Brake."""
        speed = now.speed[self.at]
        power, at = self.shape["power"], self.shape["reference"]
        now.passive[self.at] -= (
            self.size * at**2 * np.sign(speed) * (np.minimum(np.abs(speed), 4 * at) / at) ** power
        )


class Cogging(Part):
    """A ripple over the gear's tooth pitch, with an overtone."""

    def resist(self, now: Moment) -> None:
        """Push by the angle."""
        angle = self.shape["teeth"] * now.position[self.at] + self.shape["phase"]
        now.passive[self.at] += self.size * (
            np.sin(angle) + OVERTONE * np.sin(2 * angle + self.shape["second"])
        )


class JointSpring(Part):
    """A cable or harness that stiffens as it bends."""

    def resist(self, now: Moment) -> None:
        """Pull back."""
        bent = now.position[self.at] - self.shape["rest"]
        now.passive[self.at] -= self.size * bent * (1.0 + self.shape["stiffening"] * bent**2)


PARTS: dict[str, type[Part]] = {
    "coulomb_friction": CoulombFriction,
    "stribeck_friction": StribeckFriction,
    "presliding_hysteresis": PreslidingHysteresis,
    "load_dependent_friction": LoadDependentFriction,
    "gear_efficiency": GearEfficiency,
    "friction_asymmetry": FrictionAsymmetry,
    "quadratic_damping": QuadraticDamping,
    "cogging": Cogging,
    "joint_spring": JointSpring,
}
