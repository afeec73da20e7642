"""What acts in a batch of simulations beside the engine: torque law, damping, terms."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pup.physics.actuators import TorqueLaw
from pup.physics.fields import apply_fields
from pup.physics.model import Model, joint_inertia
from pup.physics.model import mount as mount
from pup.physics.parameters import Candidates
from pup.physics.terms import Scene, Term, bind_terms
from pup.physics.writer import FieldWriter
from pup.robot import RobotDescription

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Outfit:
    """What acts in some simulations, one row each.

    Attributes:
      law: the torque law.
      scene: what the terms know of the simulations.
      viscous: damping outside the servos, shape (n_simulations, n_joints), N m s/rad.
      terms: what acts beside the law, in the order in which it acts.
    """

    law: TorqueLaw
    scene: Scene
    viscous: Array
    terms: tuple[Term, ...]


def scene_of(
    robot: RobotDescription, model: Model, law: TorqueLaw, n: int, timestep: float | Array
) -> Scene:
    """What the terms of n simulations know of them, before any term has changed it."""
    shape = n, len(robot.joints)
    own = model.compiled.dof_armature[model.dofs]
    armature = np.broadcast_to(own if law.armature is None else law.armature, shape).copy()
    inertia = joint_inertia(model, law.armature, shape)
    return Scene(robot, model, timestep, inertia, armature, np.broadcast_to(law.limit, shape))


def fit_out(
    robot: RobotDescription,
    model: Model,
    law: TorqueLaw,
    candidates: Candidates,
    setups: Sequence[dict[str, float]],
    writer: FieldWriter,
    timestep: float | Array,
    dormant: bool = False,
) -> Outfit:
    """Write the model fields of simulations and bind all else that acts in them.

    Args:
      robot: the robot.
      model: its compiled model.
      law: bound to the simulations.
      candidates: their parameters, one row each.
      setups: the knobs of each recording; the simulations stand recording by recording.
      writer: of their fields; the caller is to call `done`.
      timestep: see Scene.
      dormant: whether terms count that act in none of the simulations.
    """
    scene = scene_of(robot, model, law, len(candidates), timestep)
    fields = apply_fields(writer, robot, model, candidates, setups, law.armature)
    terms = tuple(bind_terms(candidates, scene, dormant))
    for term in terms:
        term.fields(writer)
    return Outfit(law, scene, law.passive + fields, terms)


def longest(terms: Sequence[Term], hook: str) -> Array | None:
    """How old readings are by all terms together, s; None where none says."""
    ages: list[Array] = [getattr(term, hook)() for term in terms if term.answers(hook)]
    return np.asarray(sum(ages)) if ages else None


def as_the_imu_tells(terms: Sequence[Term], torso: Array, rows: NDArray[np.int64]) -> Array:
    """The torso's orientations (n_rows, 4), maybe interpolated, of some simulations, as it tells.

    What the IMU's site adds is the same for all.
    """
    torso = torso / np.linalg.norm(torso, axis=1, keepdims=True)
    for term in terms:
        if term.answers("tilt"):
            torso = term.tilt(torso, rows)
    return torso
