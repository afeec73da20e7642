"""How well diagnoses predict motions that they were never given."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pup.blind.score import Replayed
from pup.diagnosis.residuals import LOST, Measured
from pup.errors import InputError
from pup.files import read_json
from pup.physics.mujoco_batch import MujocoSimulator
from pup.physics.parameters import ParameterSpace, robot_space
from pup.recording import Recording
from pup.robot import RobotDescription
from services.diagnosis import CORRECTED, DIAGNOSIS

LAW = "pd"
"""Torque law of the nominal model (docs/physics.md)."""


def replayed(diagnosed: Path, tests: Sequence[Recording]) -> Replayed | None:
    """Replay the refitted nominal model and the corrected robot of a diagnosis: a `score.Replay`.

    Args:
      diagnosed: the diagnosis's folder.
      tests: recordings of motions it was not given.

    Returns:
      The errors; None where the document does not tell the nominal model.
    """
    nominal = read_json(diagnosed / DIAGNOSIS).get("nominal")
    if not isinstance(nominal, dict) or not all(
        isinstance(v, int | float) for v in nominal.values()
    ):
        return None
    robot = RobotDescription.load(tests[0].robot)
    corrected = RobotDescription.load(diagnosed / CORRECTED)
    if corrected.joint_names != robot.joint_names:
        raise InputError(f"{diagnosed / CORRECTED}: has other joints than robot {robot.name!r}")
    refitted = robot_space(robot, LAW).at(nominal)
    return Replayed(
        nominal=_error(robot, refitted, tests),
        corrected=_error(corrected, robot_space(corrected, LAW), tests),
    )


def _error(robot: RobotDescription, space: ParameterSpace, tests: Sequence[Recording]) -> float:
    """Root mean square of the joints' errors, rad, on the samples that a diagnosis looks at."""
    measured = Measured.of(robot, tests)
    simulator = MujocoSimulator(robot, measured.recordings, LAW)
    simulated = measured.pick(simulator.replay(space.candidates()))[0]
    errors = np.where(np.isnan(simulated), LOST, measured.values - simulated)
    joints = measured.channel < len(robot.joints)
    return float(np.sqrt(np.mean(errors[joints] ** 2)))
