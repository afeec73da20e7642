"""Makes walking tasks where runners are."""

from dataclasses import dataclass

import numpy as np

from pup.locomotion.sampling import ParameterSampler
from pup.locomotion.settings import TaskSettings
from pup.locomotion.task import WalkingTask
from pup.physics.engine import Engine
from pup.robot import RobotDescription
from pup.sysid.result import FittedBounds


@dataclass(frozen=True)
class Walking:
    """A walking task, to be made from a seed; see `rollouts.MakeTask`.

    Attributes:
      robot: the robot.
      bounds: of its parameters.
      settings: of the task.
      nominal: whether all episodes have the fitted parameters, instead of some from the bounds.
      engine: what simulates.
    """

    robot: RobotDescription
    bounds: FittedBounds
    settings: TaskSettings
    nominal: bool = False
    engine: Engine = Engine.MUJOCO

    def __call__(self, simulations: int, seed: int, threads: int) -> WalkingTask:
        """See `rollouts.MakeTask`."""
        of = ParameterSampler.nominal if self.nominal else ParameterSampler
        rng = np.random.default_rng(seed)
        sampler = of(self.bounds)
        return WalkingTask(
            self.robot, sampler, self.settings, simulations, rng, threads, self.engine
        )
