"""Recordings of a bench servo with something the nominal model leaves out."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np

from pup.diagnosis.replays import union
from pup.physics.mujoco_batch import MujocoSimulator
from pup.physics.parameters import robot_space
from pup.recording import Recording
from pup.robot import RobotDescription

BENCH = RobotDescription.load("servo_bench")
LSB = 2 * np.pi / 4096


def recordings(
    missing: Mapping[str, float],
    seed: int = 3,
    noise: float = 0.002,
    late: tuple[float, float] = (0.0, 0.0),
) -> tuple[Recording, ...]:
    """Five motions of four types, 4 s each, one of them done again, simulated in finer steps.

    Args:
      missing: what the nominal model leaves out.
      seed: of the motions, the true parameters and the noise.
      noise: of readings, rad.
      late: how late commands arrive: mean and standard deviation, s.
    """
    return _recordings(tuple(missing.items()), seed, noise, late)


@cache
def _recordings(
    told: tuple[tuple[str, float], ...], seed: int, noise: float, late: tuple[float, float]
) -> tuple[Recording, ...]:
    missing = dict(told)
    rng = np.random.default_rng(seed)
    levels = rng.uniform(-0.6, 0.6, 8)

    def steps(t: np.ndarray) -> np.ndarray:
        return np.where(t < 0.5, 0, levels[(2 * t).astype(int) % 8])

    motions = (
        ("step", steps),
        ("step", steps),
        ("chirp", lambda t: 0.3 * np.sin(2 * np.pi * (0.3 * t + 0.4 * t**2))),
        ("triangle", lambda t: 0.4 * np.abs((t / 2) % 2 - 1) * 2 - 0.4),
        ("hold", lambda t: np.where(t < 0.5, 0, np.repeat(levels[:2], 2)[t.astype(int) % 4])),
    )
    plans = []
    for number, (motion, command) in enumerate(motions):
        time = np.cumsum(rng.uniform(1 / 33, 1 / 25, 120))
        if number == 1:
            time = plans[0].time
        target = np.asarray(command(time))[:, None]
        plans.append(
            Recording(
                id=f"{motion}_{number}",
                robot=BENCH.name,
                motion=motion,
                support="bench",
                source="unknown",
                joints=BENCH.joint_names,
                time=time,
                target=target,
                position=target,
                repeat_of=plans[0].id if number == 1 else None,
            )
        )
    space = robot_space(BENCH, "pd")
    truth = dict(zip(space.names, space.nominal * np.exp(0.15 * rng.normal(size=4)), strict=True))
    whole = union(space, [truth | missing]).at(truth | missing)
    arrived = [_arrived(plan, late, rng) if any(late) else plan for plan in plans]
    fine = MujocoSimulator(replace(BENCH, timestep=BENCH.timestep / 4), arrived, "pd")
    told = fine.replay(whole.candidates()).position[0]
    read = np.round((told + noise * rng.normal(size=told.shape)) / LSB) * LSB
    return tuple(
        replace(plan, position=read[part][np.isin(came.time, plan.time)])
        for plan, came, part in zip(plans, arrived, fine.ticks, strict=True)
    )


def _arrived(plan: Recording, late: tuple[float, float], rng: np.random.Generator) -> Recording:
    """A recording as its servo sees it, with a tick more where each command arrives."""
    mean, spread = late
    come = plan.time + np.maximum(mean + spread * rng.normal(size=len(plan.time)), 0.0005)
    come[0] = plan.time[0]
    time = np.unique(np.concatenate([plan.time, come]))
    order = np.argsort(come, kind="stable")
    newest = np.maximum.accumulate(order)  # one that is overtaken is never obeyed
    target = plan.target[newest[np.searchsorted(come[order], time, side="right") - 1]]
    return replace(plan, time=time, target=target, position=target)
