"""What recordings tell by the slopes of equation 1 at a point."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pup.physics.model import named_units
from pup.physics.rest import Units, ticks_at_rest
from pup.recording import Recording
from pup.sysid.gauss_newton import differences
from pup.sysid.polish import STEP
from pup.sysid.problem import Problem

Array = NDArray[np.float64]

READING, TILT_READING = 0.0015, 0.002
"""Noise of a reading: a step of a 12-bit encoder, and an IMU's, rad."""
RIDGE = 1e-12
"""Of the slopes' variance, for parameters that nothing depends on."""


@dataclass(frozen=True, eq=False)
class Told:
    """What recordings tell at a minimum of a sum of norms.

    Attributes:
      error: weighted, shape (n_errors,); zero where nothing was measured.
      jacobian: its slopes, shape (n_errors, n_parameters).
      blocks: where each norm's errors begin, tick after tick for each kind of error.
      ticks: of each recording.
      memory: by how much the variance of a sum of errors exceeds that of independent ones.
    """

    error: Array
    jacobian: Array
    blocks: NDArray[np.int64]
    ticks: Sequence[slice]
    memory: float

    def rows(self, values: NDArray[Any]) -> NDArray[Any]:
        """Values of the norms, for each of their errors."""
        return np.repeat(values, np.diff([*self.blocks, len(self.error)]))

    def of(self, chosen: NDArray[np.bool_]) -> "Told":
        """Of some recordings: the others' errors as if not measured, shape (n_recordings,)."""
        kept = chosen[self.recordings()]
        return replace(self, error=self.error * kept, jacobian=self.jacobian * kept[:, None])

    def recordings(self) -> NDArray[np.int64]:
        """Which recording each error is of."""
        of_tick = np.repeat(np.arange(len(self.ticks)), [t.stop - t.start for t in self.ticks])
        return self.rows(np.resize(of_tick, len(self.blocks)))


@dataclass(frozen=True, eq=False)
class Slopes:
    """A sum of norms around a point, of k parameters.

    Attributes:
      gradient: shape (k,).
      curvature: on average over the noise, shape (k, k).
      scatter: covariance of the gradient, shape (k, k).
    """

    gradient: Array
    curvature: Array
    scatter: Array

    @property
    def information(self) -> Array:
        """Inverse covariance of the minimum (sandwich)."""
        ridge = RIDGE * max(np.trace(self.scatter), RIDGE) * np.eye(len(self.scatter))
        return np.asarray(self.curvature @ np.linalg.solve(self.scatter + ridge, self.curvature))


def slopes(told: Told, starts: Sequence[Array]) -> Slopes:
    """What recordings tell by their slopes at a point that minimises a sum of norms.

    Norms weigh what is noisy by its noise, not by its variance, and equation 1 weighs tilt by ten
    besides: its minimum is not where least squares would put it, and lies further from the truth.
    For errors of d alike Gaussian numbers, the norms' mean curvature has E|e| / E|e|^2 of the
    squared sensitivities (Stein's lemma) and the variance of their slopes 1/d.

    Args:
      told: what the recordings tell.
      starts: what noise in a start's readings does to the errors, one standard deviation of one
        reading of all recordings each, shape (n_errors,).
    """
    lengths = np.sqrt(np.add.reduceat(told.error**2, told.blocks))
    counted = np.add.reduceat((told.error != 0).astype(float), told.blocks)
    kind = np.arange(len(told.blocks)) // told.ticks[-1].stop
    curvature, slope, pull = np.zeros((3, len(told.blocks)))
    for one in np.unique(kind):
        own = (counted > 0) & (kind == one)
        if own.any():
            curvature[own] = lengths[own].mean() / np.mean(lengths[own] ** 2)
    slope[counted > 0] = told.memory / counted[counted > 0]
    pull[counted > 0] = 1 / lengths[counted > 0]
    curved = told.rows(curvature)[:, None] * told.jacobian
    a, b = told.jacobian.T @ curved, told.jacobian.T @ (told.rows(slope)[:, None] * told.jacobian)
    recording = told.recordings()
    for start in starts:
        moved = np.zeros((len(told.ticks), len(a)))
        np.add.at(moved, recording, curved * start[:, None])
        b += moved.T @ moved
    return Slopes(told.jacobian.T @ (told.rows(pull) * told.error), a, b)


def told_at(problem: Problem, unit: Array) -> tuple[Told, list[Array]]:
    """What recordings tell by the slopes at a point, and what the starts' noise does there.

    Residuals of a replay are far from independent, so the information is deflated by the
    (1 + r)/(1 - r) of the lag-one autocorrelation r of the joints' errors; and each replay starts
    from readings, whose noise goes with it all the way.

    Args:
      problem: what is replayed.
      unit: the point on the unit cube, shape (n_free,).
    """

    def weighted(candidates: Array) -> Array:
        return problem.errors(candidates)[0]

    fitted = problem.replay(unit[None])
    error, blocks = problem.loss.weighted_errors(fitted)
    jacobian = differences(weighted, unit, error[0], STEP)
    r = _lag_one(problem.loss.errors(fitted)[0][0], problem)
    told = Told(error[0], jacobian, blocks, problem.loss.ticks, (1 + r) / (1 - r))
    return told, _starts(problem, unit, error[0])


def _starts(problem: Problem, unit: Array, error: Array) -> list[Array]:
    """How the errors change with each reading of a start, by one standard deviation of its noise.

    Recordings do not meet: all of them start otherwise at once.
    """
    robot = problem.robot
    units = named_units(robot)
    noise = {name: READING * units[name] for name in robot.joint_names}
    if problem.loss.tilting.any():
        noise |= {name: TILT_READING for name in ("imu/roll", "imu/pitch")}
    told = []
    for name, sd in noise.items():
        moved = tuple(_moved(recording, name, sd, units) for recording in problem.recordings)
        changed = replace(problem, recordings=moved).errors(unit[None])[0][0]
        told.append(changed - error)
    return told


def _moved(recording: Recording, name: str, by: float, units: Units) -> Recording:
    """A recording with the reading of a joint or of the IMU moved that its replay starts from."""
    ticks = ticks_at_rest(recording, units)
    by /= np.sqrt(ticks)
    if name in recording.joints:
        position = recording.position.copy()
        position[:ticks, recording.joints.index(name)] += by
        return replace(recording, position=position)
    if name not in recording.extras:
        return recording
    values = recording.extras[name].copy()
    values[:ticks] += by
    return replace(recording, extras={**recording.extras, name: values})


def _lag_one(error: Array, problem: Problem) -> float:
    """Lag-one autocorrelation of the joints' errors, at most 1 - 2/n_readings of the longest.

    From reading to reading within a recording: rows without one, as of a command alone, may stand
    between any two.
    """
    products, squares, longest = 0.0, 0.0, 2
    for part in problem.loss.ticks:
        for own in error[part].T:
            read = own[own != 0]  # an error of exactly zero was not measured
            now, before = read[1:], read[:-1]
            products += float(now @ before)
            squares += float(now @ now + before @ before) / 2
            longest = max(longest, len(read))
    return float(np.clip(products / max(squares, 1e-300), 0.0, 1 - 2 / longest))
