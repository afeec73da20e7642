"""The model parameters of a robot, by name."""

import numpy as np

from pup.errors import InputError
from pup.physics.space import Candidates, ParameterSpace
from pup.physics.terms import described
from pup.robot import RobotDescription

__all__ = ["NETWORK_NAMES", "NETWORK_WEIGHTS", "Candidates", "ParameterSpace", "robot_space"]

NETWORK_WEIGHTS = 27  # W1 2x5, b1 5, W2 5x2, b2 2 (paper, section III-B)
NETWORK_NAMES = tuple(f"phi/{i}" for i in range(NETWORK_WEIGHTS))


def robot_space(robot: RobotDescription, actuator: str) -> ParameterSpace:
    """The parameters that a robot's description gives to an actuator model.

    Those of its terms (`terms.split_column` tells them) stand behind the others; fits leave them
    as they are.

    Args:
      robot: the robot.
      actuator: `nn_pd` (the paper's, with its network weights appended) or `pd`.

    Raises:
      InputError: the robot is not described for that actuator, or a term means nothing.
    """
    specs = [p for p in robot.parameters if actuator in p.actuators]
    if not specs:
        raise InputError(
            f"robot {robot.name!r} describes no parameters for the {actuator} actuator"
        )
    names = [p.name for p in specs]
    units = [p.unit for p in specs]
    nominal = [p.nominal for p in specs]
    lower = [p.search[0] for p in specs]
    upper = [p.search[1] for p in specs]
    if actuator == "nn_pd":
        if robot.network is None:
            raise InputError(f"robot {robot.name!r} has no [network] table for the nn_pd actuator")
        names += NETWORK_NAMES
        units += ["1"] * NETWORK_WEIGHTS
        nominal += robot.network.weights
        lower += [-1.0] * NETWORK_WEIGHTS
        upper += [1.0] * NETWORK_WEIGHTS
    space = ParameterSpace(
        tuple(names), tuple(units), np.array(nominal), np.array(lower), np.array(upper)
    )
    for number, term in enumerate(robot.terms, 1):
        try:
            space = space.plus(described(term))
        except InputError as error:
            raise InputError(f"{robot.folder / 'robot.toml'}: term[{number}]: {error}") from error
    return space
