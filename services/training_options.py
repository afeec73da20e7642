"""What a training is told."""

import argparse
from dataclasses import dataclass, field, replace
from pathlib import Path

from pup.errors import InputError
from pup.locomotion.settings import Direction, TaskSettings
from pup.physics.engine import Engine
from pup.policy.bundle import read_bundle
from pup.policy.losses import LossWeights
from pup.policy.shape import Method
from pup.robot import RobotDescription
from workers.learner import Learning

SHARPEN = 2.5
"""By which exploration falls in a training from scratch; one that goes on explores as it did."""
RATE, WALKING_RATE = 3e-4, 1e-4
"""Adam's at the beginning: of a policy that learns to walk, and of one that does."""
PATTERN = 120
"""Generations of the search for the gait that a training from scratch begins with."""


@dataclass(frozen=True)
class Options:
    """What is trained, and how long.

    Attributes:
      method: how the policy deals with unknown parameters.
      direction: of the walk.
      steps: control steps of all simulations together.
      seed: of everything random.
      simulations: at once, of each process that samples.
      length: control steps of each between two updates.
      learning: how the networks are moved; what follows from the rest is filled in. The discount
        is of a control step of the paper's robot.
      runners: processes that sample; 0 for none beside this one.
      start: bundle whose weights are trained further, perhaps of other bounds or parameters;
        None draws weights.
      pattern: generations of a search for the gait that a policy begins with; 0 for none, as the
        paper, and where there is a `start`.
      track: other places that are told the curve, `wandb` and `mlflow`.
      engine: what simulates.
    """

    method: Method = Method.PUP
    direction: Direction = Direction.FORWARD
    steps: int = 3_000_000
    seed: int = 0
    simulations: int = 256
    length: int = 80
    learning: Learning = field(default_factory=Learning)
    runners: int = 0
    start: Path | None = None
    pattern: int = 0
    track: tuple[str, ...] = ()
    engine: Engine = Engine.MUJOCO


def usual_learning(start: Path | None, pattern: int) -> Learning:
    """How the networks are moved unless told otherwise; see `Options` for what it begins with."""
    walks = start is not None or pattern > 0
    return Learning(rate=WALKING_RATE if walks else RATE, sharpen=SHARPEN if start is None else 1.0)


def task_settings(robot: RobotDescription, options: Options) -> TaskSettings:
    """The task of a training; a policy that is trained further keeps its smoothing.

    Raises:
      InputError: the first policy cannot be read or is another robot's.
    """
    settings = TaskSettings.of(robot, options.direction)
    if options.start is None:
        return settings
    return replace(settings, smoothing=read_bundle(options.start, robot)[0].smoothing)


def training_options(given: argparse.Namespace) -> Options:
    """What `pup train` was told.

    Raises:
      InputError: it was told to begin with two gaits.
    """
    if given.start is not None and given.pattern:
        raise InputError(
            f"--pattern {given.pattern}: the policy of --start walks already; leave one of them out"
        )
    usual_pattern = PATTERN if given.start is None else 0
    pattern = usual_pattern if given.pattern is None else given.pattern
    usual = usual_learning(given.start, pattern)
    learning = replace(
        usual,
        epochs=given.epochs,
        minibatch=given.minibatch,
        rate=usual.rate if given.learning_rate is None else given.learning_rate,
        schedule=given.schedule,
        weights=LossWeights(entropy=given.entropy, mirror=given.mirror),
        sharpen=usual.sharpen if given.sharpen is None else given.sharpen,
    )
    return Options(
        method=Method(given.method),
        direction=Direction(given.direction),
        steps=given.steps,
        seed=given.seed,
        simulations=given.simulations,
        length=given.length,
        learning=learning,
        runners=given.runners,
        start=given.start,
        pattern=pattern,
        track=tuple(given.track),
        engine=Engine(given.engine),
    )
