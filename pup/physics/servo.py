"""From commands to the torques that reach the links: the servos of a batch, with their terms.

What an encoder senses meets the command in the controller; the torque law answers, within the
servo's limits; and what leaves the servo passes the gear on its way to the link. Terms change each
of these. Without any, this is the torque law alone.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pup.physics.actuators import TorqueLaw
from pup.physics.commands import Commands, Target
from pup.physics.limited import LimitedLaw
from pup.physics.terms.base import Drive, Flow, Scene, Term

Array = NDArray[np.float64]


class Servos:
    """All servos of the simulations of one batch.

    Simulations stand recording by recording, candidate by candidate; those running are the first.

    Args:
      law: the torque law.
      commands: of the recordings.
      power: share of each sub-step with the torque on, shape (n_steps, n_recordings).
      terms: what acts beside the law.
      scene: what the simulations have in common.
      viscous: damping outside the servos, shape (n_simulations, n_joints), N m s/rad.
      delay: of the commands, shape (n_simulations,), s; None where there is none.
      candidates: how many there are.
    """

    def __init__(
        self,
        law: TorqueLaw,
        commands: Commands,
        power: Array,
        terms: Sequence[Term],
        scene: Scene,
        viscous: Array,
        delay: Array | None,
        candidates: int,
    ) -> None:
        self.law = law
        self.limited = LimitedLaw(law, scene.inertia, viscous, scene.timestep)
        self.commands = commands
        self.power = None if (power == 1).all() else power
        self.scene = scene
        self.viscous = viscous
        self.delay = None if delay is None else delay[:, None]
        self.candidates = candidates

        def of(hook: str) -> list[Term]:
            return [term for term in terms if term.answers(hook)]

        self.late, self.commanding, self.sensing = of("lateness"), of("command"), of("sense")
        self.erring, self.driving, self.settling = of("error"), of("drive"), of("settle")
        self.flowing = of("flow")
        self._before: Array | None = None
        self.loaded = any(term.loaded for term in self.flowing)

    def sense(self, position: Array, velocity: Array) -> tuple[Array, Array]:
        """What the encoders tell of the links' positions and velocities."""
        for term in self.sensing:
            position, velocity = term.sense(position, velocity)
        return position, velocity

    def torque(
        self,
        step: int,
        link: tuple[Array, Array],
        sensed: tuple[Array, Array],
        bias: Array | None,
        still: bool = False,
    ) -> tuple[Array, Array]:
        """What reaches the links in one sub-step.

        Args:
          step: the sub-step.
          link: positions (rad) and velocities (rad/s) of the links, each (n_active, n_joints).
          sensed: the same as the encoders tell them.
          bias: torques of gravity and motion, same shape, N m; None where no term asks for them.
          still: damp by the velocities that are, not by those at the sub-step's end.

        Returns:
          The applied torque (N m) and the viscous coefficient (N m s/rad), both of that shape.
        """
        time = step * self.scene.timestep
        running = len(link[0]) // self.candidates
        target = self._target(step, running, time)
        outside = None if still or step == 0 else self.limited.outside(sensed[1])
        error, torque, damping = self._answer(target.now, sensed, outside, time)
        if target.before is not None:
            share = self._spread(target.share, running)
            old, was, damped = self._answer(target.before, sensed, outside, time)
            error = share * error + (1 - share) * old
            torque = share * torque + (1 - share) * was
            damping = share * damping + (1 - share) * damped
        if self.power is not None:
            on = np.repeat(self.power[step, :running], self.candidates)[:, None]
            torque *= on
            damping *= on
        if not still:
            self.limited.keep(sensed[1], torque, damping)
        for term in self.settling:
            term.settle(error, torque - damping * sensed[1])
        if self.flowing:
            return self._through_gears(step, link, sensed[1], bias, (torque, damping), still)
        damping = damping + self.viscous[: len(damping)]
        implicit = self._implicit(damping, still)
        if implicit is not None:
            torque = torque - (1 - implicit) * (damping * sensed[1])
            damping *= implicit
        return torque, damping

    def _implicit(self, damping: Array, still: bool) -> Array | None:
        """Share of a damping that the engine takes implicitly; None where it takes all of it."""
        if still:
            return np.zeros_like(damping)
        return self.limited.implicit(damping)

    def _through_gears(
        self,
        step: int,
        link: tuple[Array, Array],
        sensed: Array,
        bias: Array | None,
        driven: tuple[Array, Array],
        still: bool,
    ) -> tuple[Array, Array]:
        """What of the torque and damping of a servo reaches the links; see `torque`."""
        torque, damping = (a.copy() for a in driven)  # gears change them in place
        viscous, brake = self.viscous[: len(damping)], np.zeros_like(torque)
        share = self._implicit(damping + viscous, still)
        if share is not None:
            torque -= (1 - share) * (damping * sensed)
            damping *= share
            brake = (1 - share) * (viscous * sensed)
            viscous = share * viscous
        now = link[1]
        before = now if step == 0 or self._before is None else self._before[: len(now)]
        self._before = now.copy()
        time = step * self.scene.timestep
        flow = Flow(time, *link, 2 * now - before, bias, torque, damping, brake, viscous)
        for term in self.flowing:
            term.flow(flow)
        return flow.torque - flow.brake, flow.damping + flow.viscous

    def _target(self, step: int, running: int, time: float) -> Target:
        n = running * self.candidates
        if self.delay is None and not self.late:
            target = self.commands.on_time(step, running)
        else:
            lateness = 0.0 if self.delay is None else self.delay[:n]
            for term in self.late:
                lateness = lateness + term.lateness(time, n)
            shaped = np.asarray(lateness).reshape(running, self.candidates, -1)
            target = self.commands.late(step, shaped)
        if self.commanding:
            now = self._spread(target.now, running)
            before = now if target.before is None else self._spread(target.before, running)
            share = self._spread(target.share, running)
            for term in self.commanding:
                now, before = term.command(now, before, share)
            target = Target(now, None if target.before is None else before, share)
        return target

    def _spread(self, values: Array, running: int) -> Array:
        """Values per recording and candidate or for all candidates, for each simulation."""
        if values.ndim != 3:
            return values
        full = np.broadcast_to(values, (running, self.candidates, values.shape[2]))
        return full.reshape(running * self.candidates, -1)

    def _answer(
        self, target: Array, sensed: tuple[Array, Array], outside: Array | None, time: float
    ) -> tuple[Array, Array, Array]:
        """The law's error, torque and viscous coefficient for one target."""
        position, velocity = sensed
        if target.ndim == 3:
            by_recording = position.reshape(len(target), self.candidates, -1)
            error = (target - by_recording).reshape(position.shape)
        else:
            error = target - position
        for term in self.erring:
            error = term.error(error)
        if not self.driving:
            return error, *self.limited.answer(error, velocity, outside)
        torque, damping = self.law.unlimited(error, velocity)
        limit = self.law.limit[: len(error)]
        upper = np.broadcast_to(limit, error.shape).copy()
        drive = Drive(time, error, velocity, torque, upper, -upper, np.zeros_like(upper))
        for term in self.driving:
            term.drive(drive)
        ahead = self.limited.ahead(drive.torque, damping, velocity, outside)
        _clip_between(drive, damping, ahead)
        return error, drive.torque, damping


def _clip_between(drive: Drive, damping: Array, ahead: Array) -> None:
    """The same between two limits of their own; what falls with speed at a limit damps there."""
    total = drive.torque - damping * ahead
    above, below = ~(total < drive.upper), ~(total > drive.lower)
    for limit, beyond in ((drive.upper, above), (drive.lower, below)):
        falls = (limit != 0) & (limit * drive.velocity >= 0)
        slope = np.where(falls, drive.slope, 0.0)
        np.copyto(drive.torque, limit + slope * drive.velocity, where=beyond)
        np.copyto(damping, slope, where=beyond)
