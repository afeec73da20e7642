"""The torque that the nominal model lacks, as inverse dynamics has it: positions differentiated.

This is what rivals regress on that do not simulate. Each joint's positions are smoothed by a spline
of the fifth degree with as many knots as its noise floor allows; what the smoothed motion needs,
less what the nominal servo gives, is missing.
"""

import warnings
from dataclasses import dataclass

import mujoco
import mujoco.batch
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import UnivariateSpline

from benchmarks.rivals.case import Case
from pup.physics.actuators import PD
from pup.physics.fields import apply_fields, scaled
from pup.physics.model import compile_model
from pup.physics.parameters import Candidates
from pup.physics.simulator import Schedule, schedule
from pup.physics.writer import FieldWriter
from pup.recording import Recording

Array = NDArray[np.float64]

DEGREE = 5
EDGE = 3
"""Ticks at either end of a recording where a spline's second derivative tells nothing."""


@dataclass(frozen=True, eq=False)
class Seen:
    """What is known of all joints at the ticks of one recording; arrays (n_ticks, n_joints).

    Attributes:
      time: since its start, shape (n_ticks,), s.
      plan: its commands.
      position: smoothed, rad.
      velocity: rad/s.
      acceleration: rad/s².
      error: command minus position, rad.
      kp: gain of each joint under the recording's setup, shape (n_joints,), N m/rad.
      torque: of the nominal servo, N m.
      free: 1 where that is within its limit and the servo is on, else 0.
      gravity: torque that holds the joint against gravity, N m.
      turning: how that changes with the joint's angle, N m/rad.
      missing: what the motion needs beyond the servo's torque, N m.
      usable: ticks that a regression may use, shape (n_ticks,).
    """

    time: Array
    plan: Schedule
    position: Array
    velocity: Array
    acceleration: Array
    error: Array
    kp: Array
    torque: Array
    free: Array
    gravity: Array
    turning: Array
    missing: Array
    usable: NDArray[np.bool_]


def seen(case: Case) -> list[Seen]:
    """What is known of each recording."""
    row = case.replays.space.at(case.nominal.fit.values).candidates()
    return [_seen(case, recording, row) for recording in case.measured.recordings]


def _seen(case: Case, recording: Recording, row: Candidates) -> Seen:
    robot = case.robot
    plan = schedule(recording, robot.joint_names, robot.timestep)
    order = [recording.joints.index(name) for name in robot.joint_names]
    read = recording.position[:, order]
    motion = np.stack(
        [
            _smoothed(plan.time, read[:, joint], float(case.noise.sigma[joint]))
            for joint in range(len(robot.joints))
        ],
        axis=2,
    )
    position, velocity, acceleration = motion
    setup = [robot.setup(recording.setup)]
    own = scaled(robot, row, setup)
    law = PD(robot, own)
    error = plan.held - position
    wanted = law.kp * error - law.kd * velocity
    on = recording.extras.get("torque_enabled", np.ones(len(plan.time)))[:, None] > 0
    torque = np.where(on, np.clip(wanted, -law.limit, law.limit), 0.0)
    dynamics = _Dynamics(case, recording, own, setup)
    needed = dynamics.inverse(position, velocity, acceleration)
    still = np.zeros_like(position)
    gravity = dynamics.inverse(position, still, still)
    usable = ~np.isnan(read).any(axis=1)
    usable[:EDGE] = usable[-EDGE:] = False
    return Seen(
        time=plan.time,
        plan=plan,
        position=position,
        velocity=velocity,
        acceleration=acceleration,
        error=error,
        kp=law.kp[0],
        torque=torque,
        free=(on & (np.abs(wanted) < law.limit)).astype(float),
        gravity=gravity,
        turning=dynamics.turning(position),
        missing=needed - torque,
        usable=usable,
    )


def _smoothed(time: Array, values: Array, sigma: float) -> Array:
    """Position, velocity and acceleration at all ticks, shape (3, n_ticks)."""
    known = np.flatnonzero(~np.isnan(values))
    if len(known) <= DEGREE:
        return np.zeros((3, len(time)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it tells when it has tried long enough
        spline = UnivariateSpline(
            time[known], values[known], w=np.full(len(known), 1 / sigma), k=DEGREE
        )
    return np.stack([spline(time, nu) for nu in range(3)])


class _Dynamics:
    """Inverse dynamics of a recording's robot: its nominal parameters, its setup."""

    def __init__(
        self, case: Case, recording: Recording, own: Candidates, setup: list[dict[str, float]]
    ) -> None:
        self.model = compile_model(case.robot, recording.support)
        batch = mujoco.batch.Batch(self.model.compiled, 1, 1)
        writer = FieldWriter(batch, self.model.compiled)
        armature = PD(case.robot, own).armature
        apply_fields(writer, case.robot, self.model, own, setup, armature)
        writer.done()
        self.compiled = batch.get_model(0)
        self.data = mujoco.MjData(self.compiled)

    def inverse(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """Torques of the joints that motions need, shape (n, n_joints), N m."""
        out = np.empty_like(position)
        qpos, dofs = self.model.qpos, self.model.dofs
        for row in range(len(position)):
            self.data.qpos[qpos] = position[row]
            self.data.qvel[dofs], self.data.qacc[dofs] = velocity[row], acceleration[row]
            mujoco.mj_inverse(self.compiled, self.data)
            out[row] = self.data.qfrc_inverse[dofs]
        return out

    def turning(self, position: Array, step: float = 0.01) -> Array:
        """How each joint's torque against gravity changes with its own angle, N m/rad."""
        still, out = np.zeros_like(position), np.empty_like(position)
        for joint in range(position.shape[1]):
            moved = np.zeros(position.shape[1])
            moved[joint] = step
            ends = (self.inverse(position + s * moved, still, still) for s in (1, -1))
            ahead, behind = (told[:, joint] for told in ends)
            out[:, joint] = (ahead - behind) / (2 * step)
        return out
