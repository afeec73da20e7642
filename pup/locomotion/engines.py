"""Walking robots in the engine that is asked for."""

from typing import TYPE_CHECKING

from pup.locomotion.simulations import Simulations
from pup.physics.engine import Engine
from pup.physics.parameters import Candidates
from pup.robot import RobotDescription

if TYPE_CHECKING:
    from pup.locomotion.brax_simulations import BraxSimulations


def make_simulations(
    engine: Engine,
    robot: RobotDescription,
    largest: Candidates,
    actuator: str,
    n: int,
    substeps: int,
    period: float,
    threads: int | None,
) -> "Simulations | BraxSimulations":
    """Simulations of walking robots; see `Simulations` for what they take.

    Raises:
      InputError: the engine is not installed, or cannot simulate the robot.
    """
    engine.require()
    if engine is Engine.MUJOCO:
        return Simulations(robot, largest, actuator, n, substeps, period, threads)
    from pup.locomotion.brax_simulations import BraxSimulations  # imports JAX

    return BraxSimulations(robot, largest, actuator, n, substeps, period)
