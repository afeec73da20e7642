"""Whether a robot stands where its episodes begin, and whether standing pays."""

import math

import mujoco
import numpy as np

from pup.errors import InputError
from pup.locomotion.sampling import ParameterSampler
from pup.locomotion.settings import TaskSettings
from pup.locomotion.simulations import may_touch
from pup.locomotion.task import WalkingTask
from pup.physics.model import FLOOR, compile_model
from pup.robot import RobotDescription

STANDING = 0.3
"""Time without action that a robot has to stay up, s."""
TOLD = 3
"""Pairs of geoms that a message names."""


def check_start(robot: RobotDescription, sampler: ParameterSampler, settings: TaskSettings) -> None:
    """Refuse a task whose episodes end as they begin, or in which it pays to fall.

    A training on it would spend all its steps and learn nothing.

    Args:
      robot: that is to walk.
      sampler: gives the parameters to stand with, such as `ParameterSampler.nominal`.
      settings: of the task; its noise is left out.

    Raises:
      InputError: the robot cannot walk, counts as fallen without any action, or standing costs more
        than it pays.
    """
    exact = settings.without_noise()
    task = WalkingTask(robot, sampler, exact, 1, np.random.default_rng(0), threads=1)
    task.reset()
    still = np.full((1, len(task.joints)), (task.bins - 1) / 2)
    squares = []
    for _ in range(math.ceil(STANDING * exact.control_rate[0])):
        step = task.step(still)
        if step.terminated[0]:
            raise InputError(
                f"{robot.folder / 'robot.toml'}: without any action the robot counts as fallen "
                f"{step.time[0]:.2f} s into an episode: {_why(task)}"
            )
        squares.append(float(np.square(task.motion.torque).sum()))
    _check_pay(robot, settings, float(np.mean(squares)))


def _check_pay(robot: RobotDescription, settings: TaskSettings, squares: float) -> None:
    """Refuse a reward that a robot gets more of by falling than by standing.

    Args:
      robot: the robot.
      settings: of the task.
      squares: sum of the squared torques that it stands with, (N m)².
    """
    cost = settings.torque_weight * squares
    if cost >= settings.alive:
        raise InputError(
            f"{robot.folder / 'robot.toml'}: to stand costs {cost:.3g} a step (walk.effort = "
            f"{settings.torque_weight:g} times {squares:.3g} (N m)²) and pays {settings.alive:g}: "
            f"it pays to fall; set walk.effort far below {settings.alive / squares:.2g}"
        )


def _why(task: WalkingTask) -> str:
    """What ended the episode of the only simulation."""
    falls, gait = task.falls, task.gait
    told = [
        words
        for fell, words in (
            (falls.broken, "the simulation breaks down; correct masses, servos or walk.substeps"),
            (
                falls.tilted,
                f"the torso leans by more than gait.tilt_limit = {gait.tilt_limit:g} rad; correct "
                "gait.start_pitch or the start pose",
            ),
            (falls.astray, f"it is off its line by gait.drift_limit = {gait.drift_limit:g} m"),
            (
                falls.off_height,
                f"the torso is off its height by gait.drift_limit = {gait.drift_limit:g} m",
            ),
        )
        if fell[0]
    ]
    if falls.touching[0]:
        told.extend(_touches(task) or ["something touches that should not"])
    return "; ".join(told)


def _touches(task: WalkingTask) -> list[str]:
    """Which geoms touch where the step ended; none where they have parted by then."""
    robot, motion, model = task.robot, task.motion, compile_model(task.robot, "ground")
    data = mujoco.MjData(model.compiled)
    data.qpos[:7], data.qpos[model.qpos] = motion.root[0], motion.position[0]
    mujoco.mj_forward(model.compiled, data)
    may = may_touch(robot, model)
    pairs = dict.fromkeys((int(a), int(b)) for a, b in data.contact.geom if not may[a, b])
    return [_touch(model.compiled, *pair) for pair in list(pairs)[:TOLD]]


def _touch(model: mujoco.MjModel, first: int, second: int) -> str:
    floor = model.geom(FLOOR).id
    if floor in (first, second):
        geom = first + second - floor
        return f"{_geom(model, geom)} touches the floor, which gait.ground_bodies does not name"
    return (
        f"{_geom(model, first)} touches {_geom(model, second)}; part them, or <exclude> their "
        "bodies in model.xml"
    )


def _geom(model: mujoco.MjModel, geom: int) -> str:
    name, body = model.geom(geom).name, model.body(model.geom_bodyid[geom]).name
    return f"geom {name!r} of body {body!r}" if name else f"a geom of body {body!r}"
