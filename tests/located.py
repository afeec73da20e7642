"""A leg with something missing, its model fitted near the truth: what localisation starts from."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pup.diagnosis.coordinates import nominal_coordinate
from pup.diagnosis.fit import Fit
from pup.diagnosis.fitting import differentiate, fit_together
from pup.diagnosis.nominal import free_names
from pup.diagnosis.replays import Bench, Replays, threads, union
from pup.diagnosis.residuals import Measured, Noise
from pup.physics.mujoco_batch import MujocoSimulator
from pup.physics.parameters import robot_space
from pup.physics.push import Push
from pup.recording import Recording
from pup.robot import RobotDescription

SIGMA = 0.001
MIDDLE = {"darwin_leg": np.array([-0.05, -0.4, 0.5, -1.0, -0.3, 0.1]), "servo_bench": np.zeros(1)}


def commands(robot: RobotDescription, motion: str, seconds: float, seed: int) -> Recording:
    """Steps or sines about the middle of a robot's joints."""
    rng = np.random.default_rng(seed)
    middle = MIDDLE[robot.name]
    time = np.cumsum(rng.uniform(1 / 33, 1 / 25, int(28 * seconds)))
    time -= time[0]
    if motion != "sine":
        levels = rng.uniform(-0.15, 0.15, (len(time) // 14 + 1, len(middle)))
        away = np.repeat(levels, 14, axis=0)[: len(time)]
        away[:6] = 0
    else:
        away = 0.15 * np.sin(2 * np.pi * np.outer(time, rng.uniform(0.4, 0.9, len(middle))))
    position = np.full((len(time), len(middle)), np.nan)
    position[0] = middle
    return Recording(
        id=f"{motion}_{seed}",
        robot=robot.name,
        motion=motion,
        support="bench",
        source="simulation",
        joints=robot.joint_names,
        time=time,
        target=middle + away,
        position=position,
    )


def replays_of(measured: Measured) -> Replays:
    """Replays in this process."""
    return Replays(measured, robot_space(measured.robot, "pd"), threads(Bench(measured), 1), 1)


def measured_under(
    robot: RobotDescription,
    missing: Mapping[str, float],
    motions: Sequence[str] = ("step", "sine"),
    seconds: float = 3.0,
    seed: int = 0,
    push: Push | None = None,
) -> Measured:
    """Recordings of a robot that has something the nominal model lacks, with noise."""
    rng = np.random.default_rng(seed)
    runs = [commands(robot, motion, seconds, seed + i) for i, motion in enumerate(motions)]
    space = union(robot_space(robot, "pd"), [missing])
    simulator = MujocoSimulator(robot, runs, "pd")
    told = simulator.replay(space.at(missing).candidates(), push).position[0]
    told = told + SIGMA * rng.normal(size=told.shape)
    parts = zip(runs, simulator.ticks, strict=True)
    return Measured.of(robot, [replace(run, position=told[part]) for run, part in parts])


def fitted(replays: Replays) -> tuple[Fit, Noise]:
    """The nominal model fitted from its nominal values, and the noise that there is."""
    measured, space = replays.measured, replays.space
    names = free_names(space, False)
    free_at = tuple(nominal_coordinate(space, n) for n in names)
    at = [c.coordinate(space.nominal[space.names.index(c.name)]) for c in free_at]
    noise = Noise(np.full(measured.channels, SIGMA), np.zeros(measured.channels), "repeats")
    return settled(Fit(free_at, np.array(at)), replays, noise), noise


def settled(fit: Fit, replays: Replays, noise: Noise) -> Fit:
    """A fit taken to its minimum, with its Jacobian there."""
    fit_together([fit], replays, noise)
    differentiate([fit], replays, noise)
    return fit
