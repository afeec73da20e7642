"""Which engine simulates."""

from collections.abc import Sequence
from enum import StrEnum
from importlib.util import find_spec

from pup.errors import InputError, how_to_install
from pup.physics.mujoco_batch import MujocoSimulator
from pup.physics.simulator import Simulator
from pup.recording import Recording
from pup.robot import RobotDescription


class Engine(StrEnum):
    """What simulations run on."""

    MUJOCO = "mujoco"
    BRAX = "brax"

    def require(self) -> None:
        """Refuse an engine that is not installed.

        Raises:
          InputError: it is not.
        """
        if self is Engine.BRAX and (find_spec("jax") is None or find_spec("brax") is None):
            raise InputError(f"the brax engine needs JAX and Brax; {how_to_install('brax')}")


def make_simulator(
    engine: Engine,
    robot: RobotDescription,
    recordings: Sequence[Recording],
    actuator: str,
    threads: int,
) -> Simulator:
    """A simulator of some recordings.

    Args:
      engine: what it runs on.
      robot: the robot.
      recordings: what is replayed, each for exactly this robot.
      actuator: the torque law, `pd` or `nn_pd`.
      threads: cores that MuJoCo uses; JAX takes what it finds.

    Raises:
      InputError: the engine is not installed, or cannot simulate the robot.
    """
    engine.require()
    if engine is Engine.MUJOCO:
        return MujocoSimulator(robot, recordings, actuator, threads)
    from pup.physics.brax_batch import BraxSimulator  # JAX is imported by those who ask for it

    return BraxSimulator(robot, recordings, actuator)
