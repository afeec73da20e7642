"""The paper's loss between recordings and their replay (equation 1)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pup.physics.model import joint_units
from pup.physics.rest import Units, ticks_at_rest
from pup.physics.simulator import Trajectories, tick_slices
from pup.recording import Recording
from pup.robot import RobotDescription

Array = NDArray[np.float64]

TILT_WEIGHT = 10.0
FEET_WEIGHT = 20.0
STANDING = frozenset(("stand", "standup"))
"""Motion types whose feet stay where they are: the set D_s of the paper."""
FALLING = frozenset(("fall",))

LOST_POSITION = np.pi
"""Error counted per joint or angle of a simulation that broke down, rad; of a slide its range."""
LOST_FOOT = 1.0
"""The same along each axis of a foot, m, from tick to tick."""


@dataclass(frozen=True)
class Terms:
    """The three sums over time, per candidate and recording.

    Attributes:
      position: sum over ticks of the norm of the joint position error in the joints' units, shape
        (n_candidates, n_recordings).
      tilt: the same of the torso's roll and pitch; 0 where a recording has none.
      feet: the length of the path of the feet; 0 unless standing, m.
    """

    position: Array
    tilt: Array
    feet: Array

    @staticmethod
    def joined(parts: Sequence["Terms"], axis: int = 0) -> "Terms":
        """Those of some candidates after those of others, or along axis 1 of some recordings."""
        sums = zip(*((part.position, part.tilt, part.feet) for part in parts), strict=True)
        return Terms(*(np.concatenate(values, axis) for values in sums))


class ReplayLoss:
    """Compares trajectories with the recordings they replay.

    Args:
      robot: gives the order of the joints, and what stands for a radian in each (`joint_units`):
        a norm of radians and metres would say next to nothing of what slides.
      recordings: the measurements, in the order of the trajectories.
    """

    def __init__(self, robot: RobotDescription, recordings: Sequence[Recording]) -> None:
        self.recordings = tuple(recordings)
        self.units, self.feet = joint_units(robot), len(robot.feet)
        self.ticks = tick_slices(recordings)
        self.position = np.concatenate(
            [r.position[:, [r.joints.index(n) for n in robot.joint_names]] for r in recordings]
        )
        self.tilt = np.concatenate([_tilt(r) for r in recordings])
        motions = [r.motion for r in recordings]
        ground = np.array([r.support == "ground" for r in recordings])
        on_feet = [self.feet > 0 and m in STANDING for m in motions]
        self.standing = ground & np.array(on_feet)
        moving = np.array([m in STANDING | FALLING for m in motions])
        measured = [not np.isnan(self.tilt[part]).all() for part in self.ticks]
        self.tilting = ground & moving & np.array(measured)
        self.starts = np.array([part.start for part in self.ticks])
        named = dict(zip(robot.joint_names, self.units, strict=True))
        self.rests = tuple(
            _rest(r, part.start, named) for r, part in zip(recordings, self.ticks, strict=True)
        )

    @property
    def numbers(self) -> int:
        """Errors of a tick that equation 1 weighs."""
        tilt, feet = bool(self.tilting.any()), bool(self.standing.any())
        return len(self.units) + 2 * tilt + 3 * self.feet * feet

    def terms(self, trajectories: Trajectories) -> Terms:
        """The three sums, per candidate and recording."""
        return Terms(
            self._sum(_length(self._joint_error(trajectories) / self.units)),
            self._sum(_length(self._tilt_error(trajectories))) * self.tilting,
            self._sum(_length(self._feet_error(trajectories))) * self.standing,
        )

    def weighted_errors(self, trajectories: Trajectories) -> tuple[Array, NDArray[np.int64]]:
        """Errors with their weights in equation 1, in blocks whose norms add up to it.

        Returns:
          The errors, shape (n_candidates, n_errors), zero where nothing was measured, and where
          each block begins, shape (n_blocks,).
        """
        parts, widths = [], []
        for error, weight in (
            (self.errors(trajectories)[0], np.ones(len(self.ticks))),
            (self._tilt_error(trajectories), TILT_WEIGHT * self.tilting),
            (self._feet_error(trajectories), FEET_WEIGHT * self.standing),
        ):
            if weight.any():
                scale = self._per_tick(weight / np.count_nonzero(weight))
                parts.append(np.nan_to_num(error) * scale[:, None])
                widths += [error.shape[2]] * error.shape[1]
        blocks = np.cumsum([0, *widths[:-1]])
        return np.concatenate([p.reshape(len(p), -1) for p in parts], axis=1), blocks

    def total(self, terms: Terms, subset: Sequence[int] | None = None) -> Array:
        """Equation 1 over all recordings or a subset of them, shape (n_candidates,)."""
        chosen = np.arange(len(self.recordings)) if subset is None else np.asarray(subset)
        tilting, standing = chosen[self.tilting[chosen]], chosen[self.standing[chosen]]
        loss = _mean(terms.position[:, chosen])
        if len(tilting):
            loss = loss + TILT_WEIGHT * _mean(terms.tilt[:, tilting])
        if len(standing):
            loss = loss + FEET_WEIGHT * _mean(terms.feet[:, standing])
        return np.asarray(loss)

    def shares(self, terms: Terms) -> Array:
        """What each recording adds to equation 1, which is their mean.

        Shape (n_candidates, n_recordings).
        """
        count = len(self.recordings)
        tilt = TILT_WEIGHT * count / max(int(self.tilting.sum()), 1)
        feet = FEET_WEIGHT * count / max(int(self.standing.sum()), 1)
        return np.asarray(terms.position + tilt * terms.tilt + feet * terms.feet)

    def omitted(self) -> list[str]:
        """What the recordings lack of equation 1, in words."""
        lines = []
        wanted = [
            r for r in self.recordings if r.support == "ground" and r.motion in STANDING | FALLING
        ]
        without = [
            r.id
            for r, has in zip(self.recordings, self.tilting, strict=True)
            if r in wanted and not has
        ]
        if without:
            lines.append(
                f"no torso roll and pitch in {', '.join(without)}: tilt term left out there"
            )
        if not wanted:
            lines.append("no standing or falling recording: tilt and foot terms left out")
        elif not self.feet:
            lines.append("the robot is described without feet: foot term left out")
        elif not self.standing.any():
            lines.append("no standing recording: foot term left out")
        return lines

    def rmse(self, trajectories: Trajectories) -> Array:
        """Root mean square joint error per candidate, recording and joint, rad (m for a slide).

        Shape (n_candidates, n_recordings, n_joints); NaN for a joint that was never read.
        """
        error = self._joint_error(trajectories)
        square = [np.nanmean(error[:, part] ** 2, axis=1) for part in self.ticks]
        return np.asarray(np.sqrt(np.stack(square, axis=1)))

    def errors(self, trajectories: Trajectories) -> tuple[Array, Array]:
        """Joint errors (n, n_ticks, n_joints) and tilt errors (n, n_ticks, 2), rad.

        Those of a slide are in its unit. Zero where nothing was measured.
        """
        position = self._joint_error(trajectories) / self.units
        tilt = self._tilt_error(trajectories)
        counts = self._per_tick(self.tilting)
        return np.nan_to_num(position), np.where(counts[:, None], np.nan_to_num(tilt), 0.0)

    def _joint_error(self, trajectories: Trajectories) -> Array:
        """Errors of the joints, (n, n_ticks, n_joints), rad (m for a slide); NaN: not measured."""
        lost = LOST_POSITION * self.units
        return _difference(trajectories.position, self.position, lost)

    def _tilt_error(self, trajectories: Trajectories) -> Array:
        """Errors of roll and pitch, the short way round the circle; from the rest on, if there is.

        A robot leans where its IMU or the zeros of its encoders are a degree off. With the soles on
        the floor that says nothing of its dynamics, and would outweigh all that does.
        """
        away = _short_way(trajectories.tilt - self.tilt)
        for part, rest in zip(self.ticks, self.rests, strict=True):
            if rest is not None:
                away[:, part] = _short_way(away[:, part] - _known_mean(away[:, rest]))
        return np.where(np.isnan(away) & ~np.isnan(self.tilt), LOST_POSITION, away)

    def _feet_error(self, trajectories: Trajectories) -> Array:
        """How far the feet moved since the tick before, (n_candidates, n_ticks, 3 n_feet), m.

        Summed, that is the length of their path: it does not grow with the number of ticks, and a
        foot that settles by a millimetre at the start counts that millimetre once.
        """
        feet = _flat(trajectories.feet)
        flat = np.diff(feet, axis=1, prepend=feet[:, :1])
        flat[:, self.starts] = 0.0 * feet[:, self.starts]  # no step from the recording before
        return _difference(flat, np.zeros(flat.shape[2]), LOST_FOOT)

    def _per_tick(self, values: NDArray[Any]) -> NDArray[Any]:
        """Values per recording, repeated for each of its ticks."""
        return np.repeat(values, [p.stop - p.start for p in self.ticks])

    def _sum(self, values: Array) -> Array:
        return np.asarray(np.add.reduceat(values, self.starts, axis=1))


def _tilt(recording: Recording) -> Array:
    absent = np.full(len(recording.time), np.nan)
    angles = [recording.extras.get(f"imu/{name}", absent) for name in ("roll", "pitch")]
    return np.stack(angles, axis=1)


def _rest(recording: Recording, start: int, units: Units) -> slice | None:
    """Ticks of the second half of a rest at the beginning, when a replay has settled, or None."""
    ticks = ticks_at_rest(recording, units)
    return slice(start + ticks // 2, start + ticks) if ticks > 1 else None


def _flat(values: Array) -> Array:
    return values.reshape(*values.shape[:2], -1)


def _difference(simulated: Array, measured: Array, lost: Array | float) -> Array:
    """Error where measured, `lost` where the simulation broke down, NaN where not measured."""
    error = simulated - measured
    return np.where(np.isnan(error) & ~np.isnan(measured), lost, error)


def _short_way(angle: Array) -> Array:
    """An angle the short way round the circle, rad."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _length(error: Array) -> Array:
    """Euclidean norm over the last axis; what was not measured counts zero."""
    return np.asarray(np.sqrt(np.nansum(error**2, axis=-1)))


def _known_mean(values: Array) -> Array:
    """Mean over the ticks (n, n_ticks, k) that are known, shape (n, 1, k); 0 where none is."""
    known = (~np.isnan(values)).sum(axis=1, keepdims=True)
    return np.asarray(np.nansum(values, axis=1, keepdims=True) / np.maximum(known, 1))


def _mean(values: Array) -> Array:
    """Mean of each row; in memory order, so that it does not depend on the number of rows."""
    return np.asarray(np.ascontiguousarray(values).mean(axis=1))
