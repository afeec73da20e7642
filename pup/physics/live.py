"""Servos, encoders and IMU of simulations that are told what to do as they go.

A replay knows its commands beforehand, and its simulations start together. Here each simulation
starts anew when its time has come, has a sub-step of its own, and is told one target after another.
What acts in it is the same: `Servos`, and the terms with their hooks.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.physics.actuators import TorqueLaw
from pup.physics.commands import LiveCommands
from pup.physics.encoders import History
from pup.physics.model import Model
from pup.physics.outfit import Outfit, as_the_imu_tells, longest, scene_of
from pup.physics.parameters import Candidates, ParameterSpace
from pup.physics.servo import Servos
from pup.physics.terms import Scene, Term, bind_terms, split_column
from pup.robot import RobotDescription

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

DELAY = "command_delay"
"""The parameter of the nominal model that delays commands."""


def has_terms(space: ParameterSpace) -> bool:
    """Whether simulations of a space's parameters need `LiveServos`, or a torque law alone does."""
    return any(name == DELAY or split_column(name) is not None for name in space.names)


def paced(terms: Sequence[Term], scene: Scene) -> None:
    """Shorten the sub-steps, in place, where the clock that commands come by goes fast.

    Raises:
      InputError: a clock stands still or goes backwards.
    """
    for term in terms:
        if term.answers("pace"):
            pace = term.pace()
            if not (pace > 0).all():
                raise InputError(
                    f"{term.effect}: a clock at {pace.min():g} of its speed never tells a next "
                    "command; correct its share"
                )
            np.asarray(scene.timestep)[:] /= pace


class LiveServos:
    """All servos of some simulations, with what their encoders and IMU tell.

    Every simulation is started before the first sub-step. A sub-step is `torque`, the engine's
    step, and `moved`.

    Args:
      robot: the robot.
      model: its compiled model.
      law: bound to the simulations.
      candidates: parameters, one row for each simulation, no smaller than any that will come.
      period: shortest time between two targets, s.
      substeps: of that time.
    """

    def __init__(
        self,
        robot: RobotDescription,
        model: Model,
        law: TorqueLaw,
        candidates: Candidates,
        period: float,
        substeps: int,
    ) -> None:
        n, joints = len(candidates), len(robot.joints)
        scene = scene_of(robot, model, law, n, np.full((n, 1), period / substeps))
        self.terms = tuple(bind_terms(candidates, scene, dormant=True))
        acting = tuple(term for term in self.terms if not term.answers("pace"))
        delay = np.zeros(n) if DELAY in candidates else None
        paced(self.terms, scene)
        late = candidates[DELAY].max() if DELAY in candidates else 0.0
        late += sum(term.lateness(0.0, n).max() for term in acting if term.answers("lateness"))
        kept = 2 + int(np.ceil(late / period)) if late > 0 else 1
        self.commands = LiveCommands((n, joints), kept)
        outfit = Outfit(law, scene, np.zeros((n, joints)), acting)
        self.servos = Servos(outfit, self.commands, None, delay, 1)
        self.servos.before = np.zeros((n, joints))
        self.steps = np.zeros((n, 1))
        self.position, self.velocity = np.zeros((n, joints)), np.zeros((n, joints))
        self.joints, self.torso = self._history("delay", joints), self._history("tilt_delay", 4)

    def start(
        self,
        rows: Rows,
        outfit: Outfit,
        candidates: Candidates,
        link: tuple[Array, Array],
        torso: Array,
    ) -> None:
        """Start some simulations anew.

        Args:
          rows: which, shape (k,).
          outfit: what acts in them from now on, k rows; not to be used afterwards.
          candidates: their parameters, k rows.
          link: positions (rad) and velocities (rad/s) of the joints, each (k, n_joints).
          torso: its orientation, shape (k, 4).
        """
        servos, scene = self.servos, outfit.scene
        position, velocity = link
        for fresh in outfit.terms:
            fresh.prepare()  # by the scene that the terms' model fields have changed
            if fresh.answers("sense"):
                position, velocity = fresh.sense(position, velocity)
        for term, fresh in zip(self.terms, outfit.terms, strict=True):
            term.renew(rows, fresh)
        servos.scene.renew(rows, scene)
        servos.limited.renew(rows, outfit.law, scene.inertia, outfit.viscous, scene.timestep)
        servos.limited.forget(rows, velocity, np.nan)
        if servos.delay is not None:
            servos.delay[rows] = candidates[DELAY][:, None]
        assert servos.before is not None
        servos.before[rows] = velocity
        self.commands.renew(rows, np.asarray(scene.timestep))
        self.steps[rows] = 0
        self.position[rows], self.velocity[rows] = position, velocity
        for history, hook, now in (
            (self.joints, "delay", position),
            (self.torso, "tilt_delay", torso),
        ):
            if history is not None:
                ages = longest(outfit.terms, hook)
                assert ages is not None
                history.begin(rows, now, ages / scene.timestep)

    def tell(self, target: Array) -> None:
        """Tell all simulations a target, to be held until the next, (n, n_joints), rad."""
        self.commands.tell(target, self.steps)

    def torque(self, link: tuple[Array, Array]) -> tuple[Array, Array]:
        """What reaches the links in one sub-step; see Servos.torque."""
        return self.servos.torque(self.steps, link, (self.position, self.velocity))

    def moved(self, link: tuple[Array, Array], torso: Array) -> None:
        """Take note of what a sub-step came to, as `start` does of the start."""
        self.steps += 1
        self.position[:], self.velocity[:] = self.servos.sense(*link)
        if self.joints is not None:
            self.joints.push(self.position)
        if self.torso is not None:
            self.torso.push(torso)

    def encoders(self, rows: Rows) -> Array:
        """Positions that are read of some simulations, shape (n_rows, n_joints), rad."""
        if self.joints is None:
            return self.position[rows]
        return self.joints.read(rows, np.ones((len(rows), 1)))

    def imu(self, torso: Array, rows: Rows) -> Array:
        """Orientations of the torso that are read of some simulations, shape (n_rows, 4).

        Args:
          torso: how it is.
          rows: of which simulations.
        """
        if self.torso is not None:
            torso = self.torso.read(rows, np.ones((len(rows), 1)))
        return as_the_imu_tells(self.terms, torso, rows)

    def state(self) -> dict[str, Array]:
        """All that the coming sub-steps depend on beside the parameters, rows of simulations."""
        kept = {name: values.copy() for name, values in self._own().items()}
        histories = {name: history.state() for name, history in self._histories().items()}
        return kept | histories

    def restore(self, state: dict[str, Array]) -> None:
        """Take up a state, after `start` has given all simulations their parameters."""
        for name, values in self._own().items():
            values[:] = state[name]
        for name, history in self._histories().items():
            history.restore(state[name])

    def _history(self, hook: str, width: int) -> History | None:
        """For readings that are old; None where none are."""
        ages = longest(self.terms, hook)
        if ages is None:
            return None
        return History(len(ages), width, ages / self.servos.scene.timestep)

    def _own(self) -> dict[str, Array]:
        """The arrays of the state themselves."""
        assert self.servos.before is not None
        told = {
            "steps": self.steps,
            "sensed_position": self.position,
            "sensed_velocity": self.velocity,
            "before": self.servos.before,
            "held": self.commands.held,
            "told": self.commands.told,
        }
        for term in self.terms:
            told |= {f"{term.effect}/{name.strip('_')}": getattr(term, name) for name in term.state}
        return told

    def _histories(self) -> dict[str, History]:
        both = {"read_position": self.joints, "read_torso": self.torso}
        return {name: history for name, history in both.items() if history is not None}
