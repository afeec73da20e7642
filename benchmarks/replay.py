"""Throughput of a replay against the bare engine, and what a candidate costs in large batches.

Against the engine: the same number of simulations of the same model, over the same sub-steps,
those of ended recordings left out in the same way, on the same number of threads. The bare loop is
one `mujoco.batch.Batch` on all threads with no torque law and no bookkeeping; its making is not
counted, while the replay's time has everything in it.

Suspended, the bare loop's controls are constant (none; springs hold each recording's first pose)
and all its simulations share one model. On the ground the engine's time hangs on what touches: limp
or held, a robot has other contacts than in the replay. There the bare loop is given the replay's
own torques, known beforehand, and goes through the same motion.
"""

import copy
import resource
import sys
from collections.abc import Callable
from dataclasses import asdict
from typing import Any
from unittest.mock import patch

import mujoco.batch
import numpy as np

from benchmarks.paired import ROBOT, Cost, Report, in_turn, parser, ratio, shipped
from pup.physics.actuators import LAWS, Array
from pup.physics.fields import apply_fields, scaled
from pup.physics.mujoco_batch import MujocoSimulator
from pup.physics.parameters import Candidates, robot_space
from pup.physics.servo import Servos
from pup.physics.writer import FieldWriter
from pup.robot import RobotDescription

BATCHES = (16, 64, 256)
SIZES = (16, 64, 256, 1024, 4096)
SPREAD = 0.02  # of the candidates around the nominal values
SPRING, DAMPER = 15.0, 1.0  # N m/rad, N m s/rad


def main() -> None:
    options = parser(__doc__, rounds=7)
    options.add_argument("--largest", type=int, default=SIZES[-1], help="largest batch of part two")
    given = options.parse_args()
    report = Report("replay", given.json)
    robot = RobotDescription.load(ROBOT)
    report.say("bare engine's time over the replay's, median (range) of pairs; bar 0.80")
    against = []
    for support in ("suspended", "ground"):
        for actuator in ("nn_pd", "pd"):
            simulator = MujocoSimulator(robot, shipped(robot, support), actuator, given.threads)
            for count in BATCHES:
                against.append(_against_engine(simulator, actuator, count, given.rounds))
                report.say(_line(against[-1]))
    report.add("against_engine", against)
    sizes = [size for size in SIZES if size <= given.largest]
    report.say("suspended steps, NN-PD: milliseconds per candidate; bar: all within 25 % of mean")
    scaling = _scaling(robot, sizes, given.threads, max(1, given.rounds // 3), report)
    report.add("scaling", scaling)
    report.finish()


def _against_engine(
    simulator: MujocoSimulator, actuator: str, count: int, rounds: int
) -> dict[str, object]:
    candidates = _candidates(simulator.robot, actuator, count)
    ground = simulator.recordings[0].support == "ground"
    bare = _bare_informed(simulator, actuator, candidates) if ground else _bare(simulator, count)
    replays, bares = in_turn([lambda: simulator.replay(candidates), bare], rounds)
    return {
        "support": simulator.recordings[0].support,
        "actuator": actuator,
        "candidates": count,
        "simulations": count * len(simulator.recordings),
        "substeps_per_second": simulator.steps * count / float(np.median(_walls(replays))),
        "wall": asdict(ratio(_walls(bares), _walls(replays))),
        "processor": asdict(ratio(_processor(bares), _processor(replays))),
    }


def _line(row: dict[str, Any]) -> str:
    wall, processor = (
        "{median:.2f} ({lowest:.2f} to {highest:.2f})".format(**row[key])
        for key in ("wall", "processor")
    )
    return (
        f"  {row['support']:<9} {row['actuator']:<5} {row['candidates']:>3} candidates: "
        f"{wall} on the clock, {processor} of the processor, "
        f"{row['substeps_per_second']:,.0f} sub-steps/s"
    )


def _bare(simulator: MujocoSimulator, count: int) -> Callable[[], None]:
    """A loop of the engine with constant controls."""
    (group,) = simulator.groups
    model = copy.copy(group.model.compiled)
    joints = [model.joint(name).id for name in simulator.robot.joint_names]
    model.jnt_stiffness[joints] = SPRING
    model.dof_damping[group.model.dofs] = DAMPER
    start = np.repeat(group.start, count, axis=0)
    batch = mujoco.batch.Batch(model, len(start), simulator.threads)
    batch.expand("qpos_spring")[:] = start
    batch.qpos[:] = start
    state, ids = batch.state.copy(), np.arange(len(start), dtype=np.int32)

    def run() -> None:
        batch.state[:] = state
        for running in group.running:
            batch.step(ids=ids[: running * count])

    return run


def _bare_informed(
    simulator: MujocoSimulator, actuator: str, candidates: Candidates
) -> Callable[[], None]:
    """A loop of the engine through the motion of a replay."""
    (group,) = simulator.groups
    robot, dofs = simulator.robot, group.model.dofs
    torques: list[tuple[Array, Array]] = []
    usual = Servos.torque

    def kept(*given: Any, **more: Any) -> tuple[Array, Array]:
        torque, damping = usual(*given, **more)
        torques.append((torque.copy(), damping.copy()))
        return torque, damping

    with patch.object(Servos, "torque", kept):  # one thread: one batch
        MujocoSimulator(robot, simulator.recordings, actuator).replay(candidates)
    del torques[0]  # that of the start
    per_simulation = scaled(robot, candidates, group.setups)
    batch = mujoco.batch.Batch(group.model.compiled, len(per_simulation), simulator.threads)
    law = LAWS[actuator](robot, per_simulation)
    writer = FieldWriter(batch, group.model.compiled)
    apply_fields(writer, robot, group.model, per_simulation, group.setups, law.armature)
    writer.done()
    batch.qpos[:] = np.repeat(group.start, len(candidates), axis=0)
    force, damper = batch.bind("qfrc_applied"), batch.expand("dof_damping")
    state, ids = batch.state.copy(), np.arange(len(per_simulation), dtype=np.int32)

    def run() -> None:
        batch.state[:] = state
        for torque, damping in torques:
            n = len(torque)
            force[:n, dofs], damper[:n, dofs] = torque, damping
            batch.step(ids=ids[:n])

    return run


def _scaling(
    robot: RobotDescription, sizes: list[int], threads: int, rounds: int, report: Report
) -> dict[str, object]:
    recordings = shipped(robot, "suspended", "step")
    simulator = MujocoSimulator(robot, recordings, "nn_pd", threads)
    memory: list[float] = []

    def replayer(count: int) -> Callable[[], None]:
        candidates = _candidates(robot, "nn_pd", count)

        def run() -> None:
            simulator.replay(candidates)
            memory.append(_peak_megabytes())

        return run

    costs = in_turn([replayer(count) for count in sizes], rounds)
    each = [1e3 * np.array(_walls(of)) / n for of, n in zip(costs, sizes, strict=True)]
    busy = [1e3 * np.array(_processor(of)) / n for of, n in zip(costs, sizes, strict=True)]
    rows = [
        {
            "candidates": count,
            "milliseconds": float(np.median(wall)),
            "processor_milliseconds": float(np.median(processor)),
            "peak_megabytes": peak,  # of the first round, where the batches grow
        }
        for count, wall, processor, peak in zip(sizes, each, busy, memory, strict=False)
    ]
    for row in rows:
        report.say(
            f"  {row['candidates']:>4} candidates: {row['milliseconds']:.1f} on the clock, "
            f"{row['processor_milliseconds']:.1f} of the processor; "
            f"peak memory {row['peak_megabytes']:.0f} MB"
        )
    found: dict[str, object] = {"recordings": len(recordings), "rows": rows}
    for key in ("milliseconds", "processor_milliseconds"):
        values = np.array([row[key] for row in rows])
        off = float(np.abs(values / values.mean() - 1).max())
        found[f"{key}_furthest_from_mean"] = off
        report.say(f"  {key}: furthest from the mean {100 * off:.0f} %")
    return found


def _candidates(robot: RobotDescription, actuator: str, count: int) -> Candidates:
    space = robot_space(robot, actuator)
    noise = np.random.default_rng(0).normal(size=(count, len(space)))
    values = space.nominal + SPREAD * (space.upper - space.lower) * noise
    return space.candidates(np.clip(values, space.lower, space.upper))


def _walls(costs: list[Cost]) -> list[float]:
    return [c.wall for c in costs]


def _processor(costs: list[Cost]) -> list[float]:
    return [c.processor for c in costs]


def _peak_megabytes() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1 << 20 if sys.platform == "darwin" else 1 << 10)


if __name__ == "__main__":
    main()
