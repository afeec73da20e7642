"""Walking robots on JAX: the simulations of `simulations`, moved by Brax's MJX pipeline."""

from functools import partial
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.locomotion.simulations import FASTEST, Motion, Part, Pose, Rows, may_touch, sense_drift
from pup.physics.actuators import LAWS
from pup.physics.brax_engine import (
    Bodies,
    Fields,
    System,
    fields_of,
    jax,
    jnp,
    limit_contacts,
    move,
    put_system,
)
from pup.physics.brax_servos import Last, Law, Servos, law_of
from pup.physics.live import DELAY, has_terms
from pup.physics.model import Model
from pup.physics.parameters import Candidates
from pup.robot import RobotDescription

Array = NDArray[np.float64]


class BraxSimulations(Part):
    """n walking robots on JAX's device, each with parameters and a time step of its own.

    Episodes start as in the MuJoCo engine, which keeps everybody's parameters; control steps are
    taken on the device, in single precision: where feet meet a floor, the last digits decide soon
    in any. There are no terms and no delays.

    Args:
      robot: has a free torso, a floor under it and a gait.
      largest: see Simulations.
      actuator: `nn_pd` or `pd`.
      n: simulations.
      substeps: per control step.
      period: shortest of a control step, s.

    Raises:
      InputError: MJX cannot simulate the robot, or there are terms or delays.
    """

    def __init__(
        self,
        robot: RobotDescription,
        largest: Candidates,
        actuator: str,
        n: int,
        substeps: int,
        period: float,
    ) -> None:
        if has_terms(largest.space):
            raise InputError(
                f"the brax engine lets no robot walk with terms or {DELAY}; use --engine mujoco"
            )
        super().__init__(robot, largest, actuator, n, substeps, period)
        with jax.enable_x64(False):
            self.system = put_system(robot, "ground", largest.space, _sense)
        self.law = law_of(LAWS[actuator])
        stride = partial(_stride, self.system, self.model, self.law, may_touch(robot, self.model))
        self.stride = jax.jit(partial(stride, substeps))
        joints = np.zeros((n, len(robot.joints)))
        velocity = np.zeros_like(self.qvel)
        self.bodies: Any = Bodies(np.zeros_like(self.qpos), velocity, velocity)
        self.last: Any = Last(joints, joints, joints)

    def start(
        self, rows: Rows, candidates: Candidates, timestep: Array, qpos: Array, qvel: Array
    ) -> Pose:
        """See Simulations.start."""
        pose = super().start(rows, candidates, timestep, qpos, qvel)
        bodies, last = jax.tree.map(np.array, (self.bodies, self.last))
        bodies.qpos[rows], bodies.qvel[rows] = self.qpos[rows], self.qvel[rows]
        bodies.warmstart[rows] = 0.0
        last.velocity[rows] = self.qvel[rows][:, self.model.dofs]
        last.torque[rows], last.damping[rows] = 0.0, 0.0
        fixed = fields_of(self.system, self.batch), self.law.servos(self.limited)
        with jax.enable_x64(False):
            # Copies: MuJoCo's arrays change with the next start.
            self.fixed = jax.device_put(jax.tree.map(np.array, fixed))
            self.bodies, self.last = jax.device_put((bodies, last))
        return pose

    def step(self, target: Array, running: NDArray[np.bool_]) -> Motion:
        """See Simulations.step."""
        with jax.enable_x64(False):
            told = self.stride(*self.fixed, self.bodies, self.last, target, running)
        self.bodies, self.last, seen = told
        qpos, qvel, torque, drift = (np.array(part, dtype=np.float64) for part in seen[:4])
        position, root = qpos[:, self.model.qpos], qpos[:, :7]
        return Motion(
            root=root,
            encoders=position,
            imu=root[:, 3:],
            position=position,
            velocity=qvel[:, self.model.dofs],
            torque=torque,
            drift=drift,
            touching=np.array(seen[4]),
            lost=np.array(seen[5]),
        )

    def state(self) -> dict[str, Array]:
        """See Simulations.state."""
        parts = {**self.bodies._asdict(), **self.last._asdict()}
        return {name: np.array(values) for name, values in parts.items()}

    def restore(self, state: dict[str, Array]) -> None:
        """See Simulations.restore."""
        with jax.enable_x64(False):
            bodies = Bodies(*(np.array(state[name]) for name in Bodies._fields))
            last = Last(*(np.array(state[name]) for name in Last._fields))
            self.bodies, self.last = jax.device_put((bodies, last))


def _stride(
    system: System,
    model: Model,
    law: Law,
    allowed: NDArray[np.bool_],
    substeps: int,
    fields: Fields,
    servos: Servos,
    bodies: Bodies,
    last: Last,
    target: Any,
    running: Any,
) -> tuple[Bodies, Last, tuple[Any, ...]]:
    """A control step: states afterwards, then what `Motion` is made of."""
    may = jnp.array(allowed)

    def substep(now: tuple[Bodies, Last], _: None) -> tuple[tuple[Bodies, Last], tuple[Any, Any]]:
        bodies, last = now
        position, velocity = bodies.qpos[:, model.qpos], bodies.qvel[:, model.dofs]
        outside = law.outside(servos, last, velocity)
        torque, damping = law.answer(servos, target - position, velocity, outside)
        last = Last(velocity, torque, damping)
        applied = law.applied(servos, torque, damping, velocity)
        bodies, state = move(system, model, fields, bodies, *applied)
        contact = state.contact
        meets = (contact.dist < contact.includemargin) & ~may[contact.geom1, contact.geom2]
        return (bodies, last), (state.sensordata, meets.any(axis=1))

    moved, (drift, touching) = jax.lax.scan(substep, (bodies, last), None, length=substeps)
    moved, last = jax.tree.map(
        lambda new, old: jnp.where(running[:, None], new, old), moved, (bodies, last)
    )
    lost = ~(moved.sound() & (abs(moved.qvel).max(axis=1) < FASTEST))
    origin = Bodies(system.qpos0, jnp.zeros(system.nv), jnp.zeros(system.nv))
    moved = jax.tree.map(lambda there, here: jnp.where(lost[:, None], there, here), origin, moved)
    torque = last.acted(moved.qvel[:, model.dofs])
    seen = moved.qpos, moved.qvel, torque, drift[-1], touching[-1], lost
    return moved, last, seen


def _sense(robot: RobotDescription, spec: mujoco.MjSpec) -> None:
    """A sensor for the centre of mass's velocity; MJX has none for what `simulations` counts."""
    sense_drift(robot, spec)
    limit_contacts(robot, spec)
