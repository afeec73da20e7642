"""How far a replay is from its recordings, pooled in the ways people ask for."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from pup.physics.model import compile_model
from pup.physics.simulator import Trajectories
from pup.recording import Recording
from pup.robot import RobotDescription
from pup.sysid.loss import LOST_POSITION, ReplayLoss
from pup.sysid.wording import thousandths

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Accuracy:
    """Root mean square errors of one candidate.

    Every recording and joint counts the same, however long. For a sliding joint read m where rad
    stands.

    Attributes:
      cells: per recording and joint, shape (n_recordings, n_joints), rad.
      per_recording: shape (n_recordings,), rad.
      per_joint: shape (n_joints,), rad.
      total: over everything, rad.
      tilt: torso roll and pitch per recording, shape (n_recordings, 2), rad; NaN unless the
        recording is on the ground and has the angle.
      diverged: whether the simulation broke down, shape (n_recordings,).
    """

    cells: Array
    per_recording: Array
    per_joint: Array
    total: float
    tilt: Array
    diverged: NDArray[np.bool_]


def accuracy(loss: ReplayLoss, trajectories: Trajectories, row: int = 0) -> Accuracy:
    """Measure one candidate's replay.

    Args:
      loss: holds the measurements.
      trajectories: the replay of the same recordings.
      row: which candidate.
    """
    cells = loss.rmse(trajectories)[row]
    return Accuracy(
        cells=cells,
        per_recording=np.sqrt((cells**2).mean(axis=1)),
        per_joint=np.sqrt((cells**2).mean(axis=0)),
        total=float(np.sqrt((cells**2).mean())),
        tilt=np.stack([_tilt(loss, trajectories, row, i) for i in range(len(loss.recordings))]),
        diverged=trajectories.diverged[row],
    )


def _tilt(loss: ReplayLoss, trajectories: Trajectories, row: int, i: int) -> Array:
    if loss.recordings[i].support != "ground":
        return np.full(2, np.nan)
    measured, simulated = loss.tilt[loss.ticks[i]], trajectories.tilt[row, loss.ticks[i]]
    short = (simulated - measured + np.pi) % (2 * np.pi) - np.pi  # the short way round the circle
    error = np.where(np.isnan(simulated), LOST_POSITION, short)
    known = ~np.isnan(measured)
    with np.errstate(invalid="ignore"):  # an angle that was never read gives NaN
        return np.asarray(np.sqrt((error**2).sum(axis=0, where=known) / known.sum(axis=0)))


@dataclass(frozen=True)
class JointUnits:
    """Names of the units of joint positions: some robots slide where others turn.

    Attributes:
      position: of a position, such as `rad`.
      small: of a thousandth of it, such as `mrad`.
      turning: whether every joint turns, so that degrees mean something.
    """

    position: str
    small: str
    turning: bool

    @classmethod
    def of(cls, robot: RobotDescription, recordings: Sequence[Recording]) -> "JointUnits":
        """The units of a robot's joints."""
        model = compile_model(robot, recordings[0].support).compiled
        kinds = [model.joint(name).type[0] for name in robot.joint_names]
        sliding = [kind == mujoco.mjtJoint.mjJNT_SLIDE for kind in kinds]
        if all(sliding):
            return cls("m", "mm", False)
        if any(sliding):
            return cls("rad or m", "mrad or mm", False)
        return cls("rad", "mrad", True)

    def words(self, value: float) -> str:
        """An error in words, such as `40.1 mrad (2.30°)`."""
        degrees = f" ({np.degrees(value):.2f}°)" if self.turning else ""
        return f"{thousandths(value)} {self.small}{degrees}"
