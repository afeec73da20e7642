"""The export job: recordings, and what the simulator makes of them, for other programs."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pup.exporters import Take, export_takes, require
from pup.physics.mujoco_batch import MujocoSimulator
from pup.recording import Recording, load_recordings
from pup.robot import RobotDescription
from services.replay import model_of


def export(
    format: str,
    paths: Sequence[Path],
    robot: RobotDescription | None,
    bounds: Path | None,
    rate: int | None,
    out: Path,
    threads: int,
) -> dict[str, Any]:
    """Export recordings, with a robot also their replays.

    Args:
      format: `lerobot`, `mcap` or `rrd`.
      paths: recordings and folders of them.
      robot: that they are of.
      bounds: what it is like, see `model_of`.
      rate: frames per second of `lerobot`.
      out: folder for the files.
      threads: cores to use.

    Returns:
      `files`, and what else the format tells.
    """
    require(format, rate)
    recordings = load_recordings(paths, robot)
    takes = [Take(recording) for recording in recordings]
    if robot is not None:
        takes = replayed(robot, recordings, bounds, threads)
    return export_takes(format, takes, out, robot, rate)


def replayed(
    robot: RobotDescription, recordings: Sequence[Recording], bounds: Path | None, threads: int
) -> list[Take]:
    """Recordings with their replays.

    Args:
      robot: that they are of.
      recordings: what is replayed.
      bounds: what the robot is like, see `model_of`.
      threads: cores to use.
    """
    actuator, space, _ = model_of(robot, bounds)
    seen = MujocoSimulator(robot, recordings, actuator, threads).replay(space.candidates())
    takes = []
    for recording, ticks in zip(recordings, seen.ticks, strict=True):
        position, tilt = seen.position[0, ticks], seen.tilt[0, ticks]
        columns = {f"position/{name}": position[:, j] for j, name in enumerate(robot.joint_names)}
        if not np.isnan(tilt).all():
            columns |= {"imu/roll": tilt[:, 0], "imu/pitch": tilt[:, 1]}
        takes.append(Take(recording, columns))
    return takes
