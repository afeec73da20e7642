"""Many simulations of one model on JAX: Brax's MJX pipeline, a sub-step at a time.

Only what the Brax engine is made of imports this module, and only it imports JAX. MuJoCo compiles
the model and prepares the parameters of each simulation, as it does for its own engine; from there
on everything is on JAX's device. Whoever calls says how precisely: `jax.enable_x64`.
"""

import copy
import os
import warnings
from contextlib import redirect_stdout
from io import StringIO
from typing import Any, NamedTuple

import mujoco
import mujoco.batch
import numpy as np

from pup.errors import InputError
from pup.physics.model import Extension, Model, compile_model
from pup.physics.parameters import ParameterSpace
from pup.robot import RobotDescription

os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # PyTorch needs some of it too
with redirect_stdout(StringIO()):  # MJX prints that it goes without Warp
    import jax
    from brax.base import System
    from brax.io import mjcf
    from brax.mjx import pipeline
    from brax.mjx.base import State
    from jax import numpy as jnp
    from mujoco import mjx

__all__ = ["Bodies", "Fields", "System", "fields_of", "jax", "jnp", "move", "put_system"]

Fields = dict[str, Any]

CONTACTS = 24
"""Points of contact that a simulation keeps, the deepest ones; all shapes on JAX are fixed."""
_IGNORED = (
    "dof_dampingpoly",
    "jnt_stiffnesspoly",
    "geom_surfacevel",
    "geom_adhesion",
    "pair_adhesion",
    "opt.noslip_iterations",
)
"""What of a model MJX passes over in silence, where it is not 0."""
_LARGEST = 1e10
"""MuJoCo's mjMAXVAL: whatever exceeds it has broken down."""


class Bodies(NamedTuple):
    """The mechanical state of simulations, a row each.

    Attributes:
      qpos: shape (n, nq).
      qvel: shape (n, nv).
      warmstart: accelerations that the constraint solver begins with, shape (n, nv).
    """

    qpos: Any
    qvel: Any
    warmstart: Any

    def sound(self) -> Any:
        """Which have not broken down, shape (n,)."""
        return jnp.all(jnp.stack([jnp.all(abs(a) < _LARGEST, axis=1) for a in self]), axis=0)


def put_system(
    robot: RobotDescription,
    support: str,
    space: ParameterSpace | None = None,
    extend: Extension | None = None,
) -> System:
    """A robot's model for Brax.

    Args:
      robot: the robot.
      support: see `compile_model`.
      space: parameters of the simulations: MJX wants to know beforehand of dry friction.
      extend: adds to the model; `limit_contacts` at least.

    Raises:
      InputError: the robot has something that MJX cannot simulate.
    """
    model = copy.copy(compile_model(robot, support, extend or limit_contacts).compiled)
    if space is not None and any(name.startswith("coulomb/") for name in space.names):
        model.dof_frictionloss[compile_model(robot, support).dofs] = 1.0
    for name in _IGNORED:
        owner = model.opt if name.startswith("opt.") else model
        if np.any(getattr(owner, name.removeprefix("opt."))):
            raise _unsupported(robot, f"MJX passes over {name}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Brax has it that MJX is to be used without it
        try:
            system = mjcf.load_model(model)
        except NotImplementedError as error:
            raise _unsupported(robot, f"MJX says: {' '.join(str(error).split())}") from error
    for knob in robot.knobs:
        for edit in knob.edits:
            if not _differs(system, edit.field):
                told = f"knob {knob.name!r}: {edit.field} cannot differ between simulations in MJX"
                raise _unsupported(robot, told)
    return system


def limit_contacts(robot: RobotDescription, spec: mujoco.MjSpec) -> None:
    """Extend a model by what keeps MJX from holding room for all contacts that could be."""
    spec.add_numeric(name="max_contact_points", data=[CONTACTS], size=1)


def fields_of(system: System, batch: mujoco.batch.Batch) -> Fields:
    """The fields that differ between simulations, each shape (n, ...); damping is not among them.

    They are the batch's own arrays. What MuJoCo derives beside, MJX does without.
    """
    told = {name: batch.expanded(name) for name in mujoco.batch.MODEL_FIELDS - {"dof_damping"}}
    return {n: v for n, v in told.items() if v is not None and _differs(system, n)}


def move(
    system: System, model: Model, fields: Fields, bodies: Bodies, torque: Any, damping: Any
) -> tuple[Bodies, State]:
    """One sub-step of all simulations.

    Args:
      system: the model.
      model: says where the joints stand in it.
      fields: of each simulation.
      bodies: their state.
      torque: on the joints, shape (n, n_joints), N m.
      damping: viscous coefficients of the joints, taken implicitly, same shape, N m s/rad.

    Returns:
      Their state after the sub-step, and Brax's, of which all that derives from positions and
      velocities is of before.
    """
    force = jnp.zeros_like(bodies.qvel).at[:, model.dofs].set(torque)
    own = jnp.broadcast_to(system.dof_damping, force.shape).at[:, model.dofs].set(damping)
    state = jax.vmap(_move, in_axes=(None, 0, 0, 0))(
        system, {**fields, "dof_damping": own}, bodies, force
    )
    return Bodies(state.qpos, state.qvel, state.qacc_warmstart), state


def _move(system: System, fields: Fields, bodies: Bodies, force: Any) -> State:
    own = system.tree_replace(fields)
    data = vars(mjx.make_data(own))
    state = State(q=bodies.qpos, qd=bodies.qvel, x=None, xd=None, contact=None, **data)
    state = state.replace(
        qpos=bodies.qpos, qvel=bodies.qvel, qacc_warmstart=bodies.warmstart, qfrc_applied=force
    )
    return pipeline.step(own, state, state.ctrl)


def _differs(system: System, name: str) -> bool:
    """Whether a model's field may differ between the simulations of a system."""
    owner = system.opt if name.startswith("opt.") else system
    return isinstance(getattr(owner, name.removeprefix("opt."), None), jax.Array)


def _unsupported(robot: RobotDescription, why: str) -> InputError:
    return InputError(
        f"robot {robot.name!r} cannot be simulated by the brax engine: {why}; use --engine mujoco"
    )
