"""Walking robots in the engine that is asked for."""

from typing import TYPE_CHECKING

from pup.errors import InputError
from pup.locomotion.simulations import Simulations
from pup.physics.engine import Engine
from pup.physics.parameters import Candidates
from pup.robot import RobotDescription

if TYPE_CHECKING:
    from pup.locomotion.brax_simulations import BraxSimulations


AT_ONCE = 16
"""Robots that JAX lets walk on a processor: with 64 on two cores a control step never ended."""


def check_size(engine: Engine, n: int) -> None:
    """Refuse more simulations than an engine can step where this process runs.

    Raises:
      InputError: they are too many, or the engine is not installed.
    """
    engine.require()
    if engine is Engine.MUJOCO or n <= AT_ONCE:
        return
    from pup.physics.brax_engine import jax

    if jax.default_backend() == "cpu":
        raise InputError(
            f"--simulations {n}: the {engine.value} engine needs an accelerator for more than "
            f"{AT_ONCE}; use --simulations {AT_ONCE} or --engine mujoco"
        )


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
