"""Parameters and setup knobs as per-simulation fields of a batch."""

from collections.abc import Sequence
from fnmatch import fnmatchcase

import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.physics.model import Model
from pup.physics.parameters import Candidates
from pup.physics.terms import split_column
from pup.physics.writer import FieldWriter
from pup.robot import RobotDescription

Array = NDArray[np.float64]

_AXES = ("x", "y", "z")


def scaled(
    robot: RobotDescription, candidates: Candidates, setups: Sequence[dict[str, float]]
) -> Candidates:
    """One row per simulation, recording by recording, scaled as each recording's knobs say.

    Args:
      robot: says which knob scales which parameters.
      candidates: n candidates.
      setups: the knobs of each of the m recordings.

    Returns:
      m n rows, recording by recording.
    """
    blocks = []
    for setup in setups:
        values = candidates.values.copy()
        for knob in robot.knobs:
            for scaling in knob.scalings:
                factor = setup[knob.name] / scaling.reference
                if factor != 1.0:
                    names = candidates.space.names
                    values[:, [fnmatchcase(n, scaling.parameter) for n in names]] *= factor
        blocks.append(values)
    return Candidates(candidates.space, np.concatenate(blocks))


def apply_fields(
    writer: FieldWriter,
    robot: RobotDescription,
    model: Model,
    parameters: Candidates,
    setups: Sequence[dict[str, float]],
    armature: Array | None,
) -> Array:
    """Write the model fields of every simulation.

    Args:
      writer: of the simulations' fields.
      robot: the robot.
      model: its compiled model.
      parameters: one row per simulation.
      setups: the knobs of each recording; the simulations stand recording by recording.
      armature: rotor inertia, broadcastable to (n_simulations, n_joints), kg m²; None keeps the
        model's.

    Returns:
      Viscous damping outside the servo, shape (n_simulations, n_joints), N m s/rad.
    """
    each = len(parameters) // len(setups)
    for knob in robot.knobs:
        values = np.repeat([setup[knob.name] for setup in setups], each)
        turned = values != knob.default  # the MJCF is written at the knobs' defaults
        if not turned.any():
            continue
        for edit in knob.edits:
            field = writer.element(edit.field, edit.element)
            rows = turned if edit.index is None else (turned, edit.index)
            field[rows] = edit.scale * values[turned] + edit.offset
    viscous = np.tile(model.compiled.dof_damping[model.dofs], (len(parameters), 1))
    if armature is not None:
        writer.field("dof_armature")[:, model.dofs] = armature
    for name in parameters.space.names:
        _apply(writer, robot, model, name, parameters[name], viscous)
    return viscous


def _apply(
    writer: FieldWriter,
    robot: RobotDescription,
    model: Model,
    name: str,
    values: Array,
    viscous: Array,
) -> None:
    """Write one parameter; those of the torque law, which it reads itself, pass."""
    kind, _, place = name.partition("/")
    if split_column(name) is not None:
        return  # an effect beside the nominal model
    if kind == "torso_com" and robot.torso:
        writer.element("body_ipos", robot.torso)[:, _AXES.index(place)] += values
    elif kind == "com":
        body, _, axis = place.rpartition("/")
        writer.element("body_ipos", body)[:, _AXES.index(axis)] += values
    elif kind == "mass":
        # Of the body alone: what a knob adds to it is known.
        own = model.compiled.body(place)
        writer.element("body_mass", place)[:] += (values - 1) * own.mass
        writer.element("body_inertia", place)[:] += (values - 1)[:, None] * own.inertia
    elif kind == "ground_friction":
        if model.floating:
            friction = writer.field("geom_friction")
            for geom, _ in model.contacts:
                friction[:, geom, 0] = values
    elif kind == "damping":
        viscous[:, _of_group(robot, place)] += values[:, None]
    elif kind == "coulomb":
        dofs = np.arange(model.compiled.nv)[model.dofs][_of_group(robot, place)]
        writer.field("dof_frictionloss")[:, dofs] += values[:, None]
    elif kind not in _LAW_PARAMETERS:
        raise InputError(
            f"{robot.folder / 'robot.toml'}: parameter {name!r} means nothing to the physics; "
            "see docs for the names it knows"
        )


_LAW_PARAMETERS = frozenset(
    ("rho", "sigma", "torque_limit", "phi", "kp", "kd", "tau_max", "armature", "command_delay")
)


def _of_group(robot: RobotDescription, group: str) -> NDArray[np.bool_]:
    return np.array([joint.group == group for joint in robot.joints])
