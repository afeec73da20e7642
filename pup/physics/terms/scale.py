"""How large typical sizes are on a robot of another strength than the one they were taken from."""

from dataclasses import dataclass

import mujoco
import numpy as np

from pup.physics.model import compile_model
from pup.robot import RobotDescription

REFERENCE_TORQUE = 2.5
"""Torque limit of the MX-28, N m, of whose kind the library's typical sizes are."""
REFERENCE_RANGE = 2.0
"""Range of a joint, rad, that they belong to."""

REFERENCE_MASS = 2.93
"""Mass of the Darwin OP2, kg."""

_MASSES = {"kg": 1.0, "N": 1.0, "m": 1 / 3}
"""Powers of the mass of a heavier robot: its loads, the forces on it, its lengths."""
_POWERS = {
    # unit: powers of torque and of angle
    "N m": (1, 0),
    "rad": (0, 1),
    "rad/s": (0, 1),
    "N m/rad": (1, -1),
    "N m s/rad": (1, -1),
    "N m s2/rad2": (1, -2),
    "N m/(rad s)": (1, -1),
    "rad/(N m)": (-1, 1),
    "1/(N m)": (-1, 0),
    "s/rad": (0, -1),
    "s2/rad": (0, -1),
    "kg m2": (1, -1),
}


@dataclass(frozen=True)
class Scale:
    """Factors on the library's typical sizes.

    Attributes:
      torque: strength of the robot's servos over the reference.
      angle: range of its joints over the reference; 1 for hinges.
      mass: of the robot over the reference; 1 for lighter ones, as parts of one are.
    """

    torque: float
    angle: float
    mass: float

    @classmethod
    def of(cls, robot: RobotDescription) -> "Scale":
        """The scale of a robot: a slide's ranges are in m, forces in N."""
        limits = [p.nominal for p in robot.parameters if p.name.startswith("tau_max/")]
        torque = float(np.median(limits)) / REFERENCE_TORQUE if limits else 1.0
        model = compile_model(robot, "suspended" if robot.floating else "bench").compiled
        kinds = [model.joint(name).type[0] for name in robot.joint_names]
        slides = mujoco.mjtJoint.mjJNT_SLIDE in kinds
        ranges = [joint.upper - joint.lower for joint in robot.joints]
        return cls(
            torque,
            float(np.median(ranges)) / REFERENCE_RANGE if slides else 1.0,
            max(1.0, float(model.body_mass.sum()) / REFERENCE_MASS),
        )

    def factor(self, unit: str) -> float:
        """On a quantity of some unit."""
        torque, angle = _POWERS.get(unit, (0, 0))
        mass = _MASSES.get(unit, 0.0)
        return float(self.torque**torque * self.angle**angle * self.mass**mass)
