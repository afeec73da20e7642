"""The replay protocol on JAX: Brax's MJX pipeline, for accelerators."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.physics.actuators import PD, NetworkPD
from pup.physics.brax_engine import Bodies, Fields, System, fields_of, jax, jnp, move, put_system
from pup.physics.brax_servos import Last, Law, Servos, law_of
from pup.physics.commands import Commands
from pup.physics.groups import Group
from pup.physics.model import Model
from pup.physics.mujoco_batch import MujocoSimulator, Run
from pup.physics.parameters import Candidates
from pup.physics.push import Push
from pup.physics.simulator import Trajectories
from pup.physics.terms import split_column
from pup.recording import Recording
from pup.robot import RobotDescription

Array = NDArray[np.float64]

SIMULATIONS = 2048
"""Simulations in a batch."""
STEPS = 64
"""Sub-steps of a call to the device, which sends back where the simulations were in them."""


class _Orders(NamedTuple):
    """What the simulations are told; see `commands.Commands`.

    Attributes:
      time: when the recordings' commands are given, shape (n_recordings, n_commands), s.
      held: the commands, shape (n_recordings, n_commands, n_joints), rad.
      area: what they come to until each, same shape, rad s.
      recording: that each simulation follows, shape (n,).
      delay: by which commands come late to each, shape (n, 1), s.
    """

    time: Any
    held: Any
    area: Any
    recording: Any
    delay: Any

    @classmethod
    def of(cls, commands: Commands, recording: Any, delay: Any) -> "_Orders":
        """The orders of simulations that follow some recordings late."""
        ends = np.where(np.isfinite(commands.time), commands.time, 0.0)
        spans = np.maximum(np.diff(ends), 0.0)[:, :, None]
        area = np.cumsum(commands.held[:, :-1] * spans, axis=1)
        area = np.concatenate([np.zeros_like(area[:, :1]), area], axis=1)
        return cls(commands.time, commands.held, area, recording, delay)

    def between(self, start: Any, end: Any) -> tuple[Any, Any, Any]:
        """What is held at a sub-step's end, (n, n_joints), on the average before, and since when.

        See `kernels.look_up`.
        """
        start, end = start - self.delay, end - self.delay
        (last, since), (first, told) = self._row(end), self._row(start)
        now, then = (self.held[self.recording, row] for row in (last, first))
        whole = self.area[self.recording, last] - self.area[self.recording, first]
        mean = (whole - then * (start - told)) / (since - start)
        return now, jnp.where((last - first > 1)[:, None], mean, then), since + self.delay

    def _row(self, time: Any) -> tuple[Any, Any]:
        """Which commands are held at times (n, 1), shape (n,), and since when, shape (n, 1)."""
        told = self.time[self.recording]
        count = jax.vmap(partial(jnp.searchsorted, side="right"))(told, time)
        row = jnp.maximum(count[:, 0] - 1, 0)
        return row, self.time[self.recording, row][:, None]


class _Course(NamedTuple):
    """Where the simulations of a batch are.

    Attributes:
      bodies: their state.
      last: what the last sub-step left.
      step: the sub-step.
      broken: which have broken down, shape (n,).
    """

    bodies: Bodies
    last: Last
    step: Any
    broken: Any


class _Seen(NamedTuple):
    """What sub-steps came to, a row each.

    Attributes:
      qpos: after the sub-step, shape (n_steps, n, nq).
      places: of all bodies before it, shape (n_steps, n, nbody, 3), m; None where nobody asks.
      broken: which have broken down by then, shape (n_steps, n).
    """

    qpos: Any
    places: Any
    broken: Any


March = Callable[..., tuple[_Course, _Seen]]


class BraxSimulator(MujocoSimulator):
    """Replays recordings on JAX's device, in double precision.

    Models, parameters and starts are prepared as for the MuJoCo engine, by MuJoCo. All simulations
    of a batch go on to the end of its longest recording. There are no terms and no pushes.

    Args:
      robot: the robot.
      recordings: what is replayed, each for exactly this robot.
      actuator: the torque law, `pd` or `nn_pd`.

    Raises:
      InputError: MJX cannot simulate the robot.
    """

    def __init__(
        self, robot: RobotDescription, recordings: Sequence[Recording], actuator: str = "nn_pd"
    ) -> None:
        super().__init__(robot, recordings, actuator)
        self._marches: dict[tuple[str, tuple[str, ...]], tuple[System, Law, March]] = {}
        for support in {r.support for r in self.recordings}:
            put_system(robot, support)

    def replay(self, candidates: Candidates, push: Push | None = None) -> Trajectories:
        """See Simulator.

        Raises:
          InputError: there are terms or pushes.
        """
        terms = [name for name in candidates.space.names if split_column(name) is not None]
        if terms or push is not None:
            what = terms[0] if terms else "pushes"
            raise InputError(f"the brax engine does not simulate {what}; use the mujoco engine")
        with jax.enable_x64(True):
            return super().replay(candidates)

    def _parts(self, group: Group, candidates: int) -> list[slice]:
        most = max(1, SIMULATIONS // len(group.setups))
        return [slice(a, min(a + most, candidates)) for a in range(0, candidates, most)]

    def _run(self, group: Group, candidates: Candidates, push: Push | None) -> Run:
        support = self.recordings[group.members[0]].support
        names = candidates.space.names
        if (support, names) not in self._marches:
            system = put_system(self.robot, support, candidates.space)
            law = law_of(self.law)
            march = jax.jit(partial(_march, system, group.model, law))
            self._marches[support, names] = system, law, march
        return _BraxRun(self.robot, group, candidates, self.law, self._marches[support, names])


class _BraxRun(Run):
    """A batch that is prepared by MuJoCo and moved on JAX's device."""

    def __init__(
        self,
        robot: RobotDescription,
        group: Group,
        candidates: Candidates,
        make: type[PD] | type[NetworkPD],
        on_jax: tuple[System, Law, March],
    ) -> None:
        super().__init__(robot, group, candidates, make)
        system, law, self.march = on_jax
        n, joints = len(self.ids), len(robot.joints)
        self.room = 1 << (n - 1).bit_length()  # one compilation serves many sizes
        each = fields_of(system, self.batch), law.servos(self.servos.limited)
        delay = np.zeros((n, 1)) if self.servos.delay is None else self.servos.delay
        orders = np.arange(len(group.setups)).repeat(self.candidates), delay
        nothing = np.full((n, joints), np.nan)
        bodies = Bodies(self.qpos, self.qvel, np.zeros_like(self.qvel))
        course = bodies, Last(nothing, nothing, nothing), self.broken
        (fields, servos), orders, (bodies, last, broken) = self._spread((each, orders, course))
        told = _Orders.of(group.commands, *orders)
        self.fixed = jax.device_put((fields, servos, told))
        self.course = jax.device_put(_Course(bodies, last, np.array(0), broken))

    def _spread(self, tree: Any) -> Any:
        """Rows of simulations, the last one repeated to fill the room; copies in any case."""
        extra = self.room - len(self.ids)
        return jax.tree.map(lambda a: np.concatenate([a, a[-1:].repeat(extra, axis=0)]), tree)

    def _substep(self, step: int, n: int, sensed: tuple[Array, Array]) -> None:
        at = step % STEPS
        if at == 0:
            power = self.group.power[step : step + STEPS]
            power = np.pad(power, ((0, STEPS - len(power)), (0, 0)), mode="edge")
            shares = self._spread(power.repeat(self.candidates, axis=1).T).T
            self.course, seen = self.march(*self.fixed, self.course, shares)
            self.seen = jax.tree.map(np.asarray, seen)
        count = len(self.ids)
        self.qpos[:], self.broken = self.seen.qpos[at, :count], self.seen.broken[at, :count]
        if self.seen.places is not None:
            self.places = self.seen.places[at, :count]


def _march(
    system: System,
    model: Model,
    law: Law,
    fields: Fields,
    servos: Servos,
    orders: _Orders,
    course: _Course,
    power: Any,
) -> tuple[_Course, _Seen]:
    """Some sub-steps; `power`, shape (n_steps, n), is the share of each with the torque on."""
    timestep = model.compiled.opt.timestep

    def substep(course: _Course, on: Any) -> tuple[_Course, _Seen]:
        bodies, on = course.bodies, on[:, None]
        position, velocity = bodies.qpos[:, model.qpos], bodies.qvel[:, model.dofs]
        outside = law.outside(servos, course.last, velocity)
        end = (course.step + 0.5) * timestep
        now, before, since = orders.between(end - timestep, end)
        share = jnp.clip((end - since) / timestep, 0, 1)
        share = jnp.where(now == before, 1.0, share)
        answers = [law.answer(servos, to - position, velocity, outside) for to in (now, before)]
        torque, damping = (
            on * (share * a + (1 - share) * b) for a, b in zip(*answers, strict=True)
        )
        last = Last(velocity, torque, damping)
        applied = law.applied(servos, torque, damping, velocity)
        after, state = move(system, model, fields, bodies, *applied)
        broken = course.broken | ~after.sound()
        places = state.xpos if model.floating else None
        return _Course(after, last, course.step + 1, broken), _Seen(after.qpos, places, broken)

    after, seen = jax.lax.scan(substep, course, power)
    return after, seen
