"""What each joint did in a simulation: speed, error, torque, and how old its command was."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.replays import Replays
from pup.diagnosis.residuals import Measured
from pup.physics.actuators import per_joint
from pup.recording import Recording

Array = NDArray[np.float64]

SHORT = 5
"""Readings below which a recording of a joint tells no speed."""


@dataclass(frozen=True)
class Servo:
    """The nominal law of one joint's servo."""

    kp: float
    kd: float
    limit: float

    def torque(self, error: Array, velocity: Array) -> Array:
        """What it gives, N m."""
        return np.asarray(np.clip(self.kp * error - self.kd * velocity, -self.limit, self.limit))


@dataclass(frozen=True)
class Signals:
    """One joint in one recording at some times, all of shape (n,).

    Attributes:
      time: since the recording's start, s.
      position: rad.
      velocity: rad/s.
      error: command minus position, rad.
      torque: of the nominal law, N m.
      age: since the command last changed, s; infinite before it first does.
    """

    time: Array
    position: Array
    velocity: Array
    error: Array
    torque: Array
    age: Array


def servos(replays: Replays, values: Mapping[str, float]) -> list[Servo]:
    """The servos of all joints under given parameters."""
    measured = replays.measured
    row = replays.space.at(values).candidates()
    kp, kd, limit = (per_joint(measured.robot, row, k)[0] for k in ("kp", "kd", "tau_max"))
    return [Servo(*(float(v) for v in told)) for told in zip(kp, kd, limit, strict=True)]


def signals(
    measured: Measured,
    simulated: Array,
    servo: Servo,
    recording: int,
    joint: int,
    time: Array | None = None,
) -> Signals | None:
    """What one joint did; None where too little of it was read.

    Args:
      measured: the samples.
      simulated: theirs, shape (n_samples,), rad.
      servo: the joint's law.
      recording: which recording.
      joint: which joint.
      time: when, s since the recording's start; at the joint's samples when None.
    """
    run = np.flatnonzero((measured.recording == recording) & (measured.channel == joint))
    if len(run) < SHORT:
        return None
    read, path = measured.time[run], np.nan_to_num(simulated[run])
    speed = np.gradient(path, read)
    when = read if time is None else time
    position, velocity = np.interp(when, read, path), np.interp(when, read, speed)
    target, age = command_at(
        measured.recordings[recording], measured.robot.joint_names[joint], when
    )
    error = target - position
    return Signals(when, position, velocity, error, servo.torque(error, velocity), age)


def command_at(recording: Recording, joint: str, time: Array) -> tuple[Array, Array]:
    """The command held at some times, and its age."""
    elapsed = recording.time - recording.time[0]
    held = recording.target[:, recording.joints.index(joint)]
    rows = np.clip(np.searchsorted(elapsed, time, "right") - 1, 0, len(elapsed) - 1)
    moved = np.append(False, np.nan_to_num(np.diff(held)) != 0)
    last = np.maximum.accumulate(np.where(moved, elapsed, -np.inf))
    return held[rows], np.asarray(time - last[rows])
