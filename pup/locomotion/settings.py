"""The numbers of the walking task: the paper's, and its authors' where the paper gives none."""

import math
from dataclasses import dataclass, replace
from enum import StrEnum

from pup.policy.bundle import PolicyCard
from pup.robot import RobotDescription, Walk

RATE = math.fsum(Walk.control_rate) / 2
"""Mean control rate of the paper's robot, Hz, at which everything was chosen that counts steps."""


class Direction(StrEnum):
    """Where to walk, as seen by the robot."""

    FORWARD = "forward"
    BACKWARD = "backward"
    SIDEWAYS = "sideways"

    @property
    def axis(self) -> tuple[float, float]:
        """The direction in the robot's frame at the start: x forward, y left.

        The authors start a sideways episode with the root turned left by a quarter and let it walk
        along the world's x axis: sideways is to the robot's right.
        """
        return {"forward": (1.0, 0.0), "backward": (-1.0, 0.0), "sideways": (0.0, -1.0)}[self]

    @property
    def symmetric(self) -> bool:
        """Whether the mirror image of the task is the task: a step to the right is not."""
        return self is not Direction.SIDEWAYS

    @property
    def reach(self) -> float:
        """The paper's delta (section VI-A): how far an action moves a target, rad."""
        return 0.2 if self is Direction.BACKWARD else 0.3


@dataclass(frozen=True)
class TaskSettings:
    """Everything about the task that is not the robot's; the defaults train as the paper does.

    Whoever has a robot makes them by `of`: what goes by its size stands in its `[walk]`.

    "Authors" is their public code (dart-env, DartDarwinSquat-v1), where the paper is silent.

    Attributes:
      direction: where to walk.
      horizon: longest episode, s (authors: the schedule of 14 s).
      on_course: whether an episode ends where the robot is off its course by the gait's limit
        (authors). In an evaluation it goes on: the robot cannot see its heading, and to stray is
        no fall.
      bins: values that an action has per joint (paper, VI-A).
      smoothing: actions in the moving average that moves the targets (authors, at RATE).
      control_rate: range of the control rate, drawn per episode, Hz (paper, VI-B).
      position_noise: standard deviation of a joint's reading, rad (paper, VI-B).
      tilt_bias: largest error of the IMU's roll and pitch, drawn per episode, rad (paper, VI-B).
      tilt_noise: the same, drawn per reading, rad (authors).
      parameter_noise: largest error of the parameters given to the policy, drawn per episode, in
        widths of their bounds (paper, VI-B).
      start_pitch_noise: largest error of the torso's pitch at the start, rad (authors).
      start_position_noise: of the joints, rad (authors).
      start_velocity_noise: of all velocities, m/s and rad/s (authors).
      speed_weight: reward per m/s in the direction, w_v (paper, VI-A).
      torque_weight: cost per (N m)², w_a.
      work_weight: cost per W, w_w.
      tracking_weight: cost per rad² beside the reference, w_t.
      alive: reward of a step that does not end in a fall, E_c.
      lateral_weight: cost per m/s of the centre of mass across the direction; not in the paper, 2
        in the authors' code.
      substeps: physics steps per control step; with the control rate they give the time step.
    """

    direction: Direction = Direction.FORWARD
    horizon: float = 14.0
    on_course: bool = True
    bins: int = 11
    smoothing: int = 5
    control_rate: tuple[float, float] = Walk.control_rate
    position_noise: float = 0.01
    tilt_bias: float = 0.3
    tilt_noise: float = 0.01
    parameter_noise: float = 0.25
    start_pitch_noise: float = 0.1
    start_position_noise: float = 0.01
    start_velocity_noise: float = 0.005
    speed_weight: float = 10.0
    torque_weight: float = Walk.effort
    work_weight: float = Walk.work
    tracking_weight: float = 0.2
    alive: float = 5.0
    lateral_weight: float = 2.0
    substeps: int = Walk.substeps

    @classmethod
    def of(cls, robot: RobotDescription, direction: Direction) -> "TaskSettings":
        """The task for a robot of its size."""
        walk = robot.walk
        settings = cls(
            direction=direction,
            control_rate=walk.control_rate,
            substeps=walk.substeps,
            torque_weight=walk.effort,
            work_weight=walk.work,
        )
        return replace(settings, smoothing=max(1, round(cls.smoothing * settings.tempo)))

    @classmethod
    def of_policy(cls, robot: RobotDescription, card: PolicyCard) -> "TaskSettings":
        """The task that a policy was trained for: it counts on the smoothing it had there."""
        settings = cls.of(robot, Direction(card.direction))
        return replace(settings, smoothing=card.smoothing)

    @property
    def rate(self) -> float:
        """Mean control rate, Hz."""
        return math.fsum(self.control_rate) / 2

    @property
    def tempo(self) -> float:
        """Control steps in the time of one of the paper's robot."""
        return self.rate / RATE

    def evaluation(self, rate: float | None = None) -> "TaskSettings":
        """The same task to its end or a fall, with the policy told the true parameters.

        Args:
          rate: of control, Hz, where one robot is meant, whose agent keeps one; None draws it, as
            a training does.
        """
        rates = self.control_rate if rate is None else (rate, rate)
        return replace(self, parameter_noise=0.0, on_course=False, control_rate=rates)

    def without_noise(self) -> "TaskSettings":
        """The same task with exact readings, one start, and the mean control rate."""
        return replace(
            self,
            control_rate=(self.rate, self.rate),
            position_noise=0.0,
            tilt_bias=0.0,
            tilt_noise=0.0,
            parameter_noise=0.0,
            start_pitch_noise=0.0,
            start_position_noise=0.0,
            start_velocity_noise=0.0,
        )
