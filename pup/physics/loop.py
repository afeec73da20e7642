"""Robots of one joint from their second sub-step to the last, in one compiled loop.

Where no engine is needed (`one_joint`) all of a sub-step is arithmetic, and of a few simulations
nearly all of its time is Python's. Here is what `servo.Servos` does, in the same order and by the
same kernels. What simulations begin with is left to it: the first sub-step comes before.
"""

import functools
import threading
from collections.abc import Callable, Sequence
from typing import Self

import numba
import numpy as np
from numpy.typing import NDArray

from pup.physics import kernels, one_joint, sub_step
from pup.physics.actuators import PD
from pup.physics.commands import Commands
from pup.physics.encoders import Readings, aged
from pup.physics.kernels import Array, Ids, Index, Mask, assembled, digest
from pup.physics.one_joint import OneJoint
from pup.physics.servo import Servos
from pup.physics.sub_step import Terms
from pup.physics.terms import kernels as laws
from pup.physics.terms.base import Parts, Term

HOOKS = ("lateness", "command", "sense", "error", "drive", "settle", "flow")
"""What terms do in a sub-step."""
PARTS = {
    "command_delay": 1,
    "clock_skew": 1,
    "target_rate_limit": 6,
    "derivative_kick": 5,
    "dead_band": 1,
    "gain_asymmetry": 1,
    "integral_action": 6,
    "thermal_drift": 6,
    "voltage_sag": 3,
    "torque_speed_limit": 1,
    "actuator_lag": 12,
    "gear_efficiency": 6,
    "load_dependent_friction": 8,
    "coulomb_friction": 5,
    "stribeck_friction": 8,
    "rising_static_friction": 11,
    "presliding_hysteresis": 5,
    "friction_asymmetry": 7,
    "quadratic_damping": 1,
    "cogging": 3,
    "drivetrain": 22,
    "joint_spring": 2,
    "joint_stop": 7,
    "encoder_bias": 1,
    "encoder_eccentricity": 3,
}
"""Terms that can be in the loop, in the order in which it names them; numbers of their parts."""
NONE = np.empty((0, 1))
"""Stands for each part of a term that is not there."""


class Loop:
    """Moves the simulations of a robot of one joint to the end of their recordings.

    Args:
      servos: what drives them.
      engine: what moves them.
      terms: that act in their sub-steps.
      running: recordings that have not ended at each sub-step, shape (n_steps,).

    Attributes:
      told: what encoders tell before each sub-step and after the last, rad (m), shape
        (n_steps + 2, n_simulations); the last row is of readings that look ahead of it.
    """

    def __init__(
        self, servos: Servos, engine: OneJoint, terms: Sequence[Term], running: NDArray[np.int64]
    ) -> None:
        assert isinstance(servos.law, PD)
        assert isinstance(servos.commands, Commands)
        self.servos, self.engine = servos, engine
        self.running = running[:, None]
        self.told = np.zeros((len(running) + 2, len(engine.ids)))
        self.terms = tuple(_parts(terms, effect) for effect in PARTS)
        self.law = (servos.law.kp, servos.law.kd, *servos.limited.parts())
        self.commands, self.found = servos.commands.tables()
        self.delay = NONE if servos.delay is None else servos.delay
        self.power = NONE if servos.power is None else servos.power
        off = np.zeros(0, dtype=np.bool_) if servos.partly is None else servos.partly
        self.off = off[:, None]

    @classmethod
    def of(
        cls, servos: Servos, engine: object, terms: Sequence[Term], running: NDArray[np.int64]
    ) -> Self | None:
        """The loop of some simulations; None where it does not have all that acts in them."""
        acting = [term for term in terms if any(term.answers(hook) for hook in HOOKS)]
        if not isinstance(engine, OneJoint) or not isinstance(servos.law, PD):
            return None
        if any(term.effect not in PARTS for term in acting):
            return None
        return cls(servos, engine, acting, running)

    def move(self, first: int) -> int:
        """Move all from a sub-step, the second or a later one, to the end.

        Returns:
          The sub-step in which those that `engine.left` tells are still to be moved, by MuJoCo; the
          number of sub-steps where there is none.
        """
        own, servos = self.engine, self.servos
        if servos.before is None:
            servos.before = np.zeros_like(own.inertia)
        return _compiled()(
            first,
            self.told,
            self.running,
            servos.candidates,
            own.timestep,
            servos.lead,
            (own.qpos, own.qvel, own.force, own.damping),
            (own.forces, own.inertia, own.ranges),
            own.ids,
            own.left,
            self.commands,
            self.found,
            self.delay,
            self.power,
            self.off,
            self.law,
            servos.before,
            self.terms,
        )

    def read(self, ticks: Readings, rows: NDArray[np.int64], age: Array | None) -> Array:
        """What is read of the simulations; see History.read.

        Args:
          ticks: when.
          rows: of which simulations, shape (n_ticks, n_candidates).
          age: how old readings are, sub-steps, shape (n_simulations, 1); None where none is.

        Returns:
          Of the shape of the rows, rad or m.
        """
        whole, share = ticks.step[:, None], ticks.fraction[:, None]
        if age is not None:
            whole, share = aged(whole, share, age[rows, 0])
        before, after = self.told[whole, rows], self.told[whole + 1, rows]
        return np.asarray(before + share * (after - before))


def _parts(terms: Sequence[Term], effect: str) -> Parts:
    """The parts of one of some terms, or what stands for them."""
    for term in terms:
        if term.effect == effect:
            return term.parts()
    return (NONE,) * PARTS[effect]


def _arrays(number: int) -> numba.types.Type:
    return numba.types.UniTuple(kernels.ARRAY, number)


_SIGNATURE = numba.int64(
    numba.int64,
    kernels.ARRAY,
    kernels.INDEX,
    numba.int64,
    numba.float64,
    numba.float64,
    _arrays(4),
    _arrays(3),
    kernels.IDS,
    kernels.MASK,
    _arrays(3),
    numba.types.UniTuple(kernels.INDEX, 3),
    kernels.ARRAY,
    kernels.ARRAY,
    kernels.MASK,
    _arrays(16),
    kernels.ARRAY,
    numba.types.Tuple([_arrays(number) for number in PARTS.values()]),
)


def _move(
    first: int,
    trace: Array,
    running: Index,
    candidates: int,
    timestep: float,
    lead: float,
    state: Parts,
    fixed: Parts,
    ids: Ids,
    left: Mask,
    commands: Parts,
    found: tuple[Index, ...],
    delay: Array,
    power: Array,
    off: Mask,
    law: Parts,
    last: Array,
    terms: Terms,
) -> int:
    """See Loop.move."""
    late, skew, goals, kick, band, asymmetry, integral, drift, supply, speed = terms[:10]
    train, bias, eccentricity = terms[20], terms[23], terms[24]
    driving = (band, asymmetry, integral, kick, drift, supply, speed)
    settling, flowing = (integral, drift, supply), terms[10:23]
    _, _, _, _, was, acted, braked, _, _, outside = law[:10]  # see LimitedLaw.parts
    motor, has_motor = train[0], train[8]  # see Drivetrain.parts
    qpos, qvel, force, damped = state
    forces, inertia, ranges = fixed
    room, step, n = np.empty((22, len(ids), 1)), first, running[first - 1, 0] * candidates
    link, sensed = (qpos[:n], qvel[:n]), (room[0, :n], room[1, :n])
    sub_step.sense(sensed, link, train, bias, eccentricity)
    trace[step, :n] = sensed[0][:, 0]
    while step < len(running):
        recordings = running[step, 0]
        n = recordings * candidates
        link, active, still = (qpos[:n], qvel[:n]), ids[:n], left[:n]
        told, felt, now, before = room[0, :n], room[1, :n], room[2, :n], room[3, :n]
        share, error, torque, damping = room[4, :n], room[5, :n], room[6, :n], room[7, :n]
        own, on, net, brake = room[8, :n], room[9, :n], room[10, :n], room[11, :n]
        viscous, angle, coming = room[12, :n], room[13, :n], room[14, :n]
        then = (room[15, :n], room[16, :n], room[17, :n], room[18, :n])
        limits = (room[19, :n], room[20, :n], room[21, :n])
        target, sensed = (now, before, share), (told, felt)
        while step < len(running) and running[step, 0] == recordings:
            time = step * timestep - lead
            if len(delay) + len(late[0]) + len(skew[0]) > 0:
                delays = (delay, late[0], skew[0])
                sub_step.late(target, step, recordings, timestep, time, commands, found[2], delays)
            else:
                sub_step.on_time(target, step, candidates, commands, found)
            changes = sub_step.differs(share, 1.0)
            if sub_step.there(goals):
                laws.travel(now, before, share, *goals)
            if sub_step.there(kick):
                laws.differ(now, before, share, *kick[1:])
            sub_step.answer((error, torque, damping, own), limits, now, sensed, law, driving)
            if changes:
                sub_step.answer(then, limits, before, sensed, law, driving)
                kernels.blend(error, torque, damping, then[0], then[1], then[2], share)
                for i in range(n):
                    own[i, 0] = share[i, 0] * own[i, 0] + (1 - share[i, 0]) * then[3][i, 0]
            on[:] = 1.0
            if len(off) > 0 and off[step, 0]:
                sub_step.switch(on, step, time / timestep, candidates, power, skew[0])
                for i in range(n):
                    torque[i, 0] *= on[i, 0]
                    damping[i, 0] *= on[i, 0]
                    own[i, 0] *= on[i, 0]
            for i in range(n):
                was[i, 0], acted[i, 0], braked[i, 0] = felt[i, 0], torque[i, 0], damping[i, 0]
                net[i, 0] = torque[i, 0] - damping[i, 0] * felt[i, 0]
                viscous[i, 0] = outside[i, 0]
            sub_step.settle(error, net, on, time, settling)
            kernels.split(torque, damping, brake, viscous, felt, *law[10:])
            for i in range(n):
                turned = sub_step.there(train) and has_motor[i, 0] != 0
                angle[i, 0] = motor[i, 0] if turned else link[0][i, 0]
                coming[i, 0] = 2 * felt[i, 0] - last[i, 0]
                last[i, 0] = felt[i, 0]
            acts = (torque, damping, brake, viscous)
            sub_step.flow(acts, (angle, felt, coming), link, own, flowing)
            for i in range(n):
                force[i, 0] = torque[i, 0] - brake[i, 0]
                damped[i, 0] = damping[i, 0] + viscous[i, 0]
            one_joint.advance(
                qpos, qvel, force, damped, forces, inertia, ranges, active, still, timestep
            )
            if sub_step.differs(still, False):
                return step
            step += 1
            sub_step.sense(sensed, link, train, bias, eccentricity)
            trace[step, :n] = told[:, 0]
    return step


_MODULES = kernels, one_joint, sub_step, laws.friction, laws.link, laws.servo
_MADE_OF = digest(*(module.__file__ for module in _MODULES))
_COMPILING = threading.Lock()


@functools.cache
def _compile() -> Callable[..., int]:
    return assembled(_move, _SIGNATURE, _MADE_OF)


def _compiled() -> Callable[..., int]:
    """`_move` compiled, by the first who needs it: that takes some twenty seconds."""
    with _COMPILING:
        return _compile()
