"""The replay job: how well does the simulator reproduce recordings."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pup.files import write_json
from pup.physics.engine import Engine, make_simulator
from pup.physics.parameters import ParameterSpace, robot_space
from pup.recording import Recording
from pup.robot import Actuator, RobotDescription
from pup.sysid.accuracy import JointUnits
from pup.sysid.loss import ReplayLoss
from pup.sysid.overlays import write_overlays
from pup.sysid.result import read_fitted


def model_of(robot: RobotDescription, bounds: Path | None) -> tuple[Actuator, ParameterSpace, str]:
    """The torque law and parameters to replay with, and where they come from.

    Args:
      robot: the robot.
      bounds: a bounds file; without one the robot's `identified.json`, without that its nominal
        values.
    """
    source = bounds or robot.identified_path
    if bounds is None and not source.exists():
        return robot.actuator, robot_space(robot, robot.actuator), str(robot.folder / "robot.toml")
    actuator, space = read_fitted(source, robot)
    return actuator, space, str(source)


def replay(
    robot: RobotDescription,
    recordings: Sequence[Recording],
    bounds: Path | None,
    out: Path,
    threads: int,
    engine: Engine = Engine.MUJOCO,
) -> dict[str, Any]:
    """Replay recordings and write `replay.json` and overlay plots.

    Args:
      robot: the robot.
      recordings: of that robot.
      bounds: see `model_of`.
      out: folder for the files.
      threads: cores to use.
      engine: what simulates.

    Returns:
      The document of `replay.json`; errors in its `unit`.
    """
    actuator, space, source = model_of(robot, bounds)
    simulator = make_simulator(engine, robot, recordings, actuator, threads)
    trajectories = simulator.replay(space.candidates())
    loss = ReplayLoss(robot, recordings)
    errors = loss.rmse(trajectories)[0]
    document = {
        "schema": 1,
        "robot": robot.name,
        "actuator": actuator,
        "engine": engine,
        "model": source,
        "unit": JointUnits.of(robot, recordings).position,
        "rmse": _rms(errors),
        "loss": float(loss.total(loss.terms(trajectories))[0]),
        "per_joint": {n: _rms(e) for n, e in zip(robot.joint_names, errors.T, strict=True)},
        "per_recording": {r.id: _rms(e) for r, e in zip(recordings, errors, strict=True)},
        "diverged": [r.id for r, d in zip(recordings, trajectories.diverged[0], strict=True) if d],
        "omitted": loss.omitted(),
    }
    write_overlays(out, robot, recordings, trajectories, loss)
    write_json(out / "replay.json", document)
    return document


def _rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(errors**2)))
