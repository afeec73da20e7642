"""From commands to the torques that reach the links: the servos of a batch, with their terms.

What an encoder senses meets the command in the controller; the torque law answers, within the
servo's limits; and what leaves the servo passes the gear on its way to the link. Terms change each
of these. Without any, this is the torque law alone.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from pup.physics import kernels
from pup.physics.commands import HeldCommands, Target
from pup.physics.limited import LimitedLaw
from pup.physics.outfit import Outfit
from pup.physics.terms import Drivetrain
from pup.physics.terms.base import Drive, Flow, Outcome, Term

Array = NDArray[np.float64]


class Servos:
    """All servos of the simulations of one batch.

    Simulations stand recording by recording, candidate by candidate; those running are the first.

    Args:
      outfit: the torque law and what acts beside it.
      commands: of the recordings, or told as the simulations go.
      power: share of each sub-step with the torque on, shape (n_steps, n_recordings); None for 1.
      delay: of the commands, shape (n_simulations,), s; None where there is none.
      candidates: how many there are.
      lead: time that each recording begins with before the time that terms go by, s.
    """

    def __init__(
        self,
        outfit: Outfit,
        commands: HeldCommands,
        power: Array | None,
        delay: Array | None,
        candidates: int,
        lead: float = 0.0,
    ) -> None:
        self.law, self.scene, self.viscous = outfit.law, outfit.scene, outfit.viscous
        self.limited = LimitedLaw(self.law, self.scene.inertia, self.viscous, self.scene.timestep)
        self.commands = commands
        self.power = None if power is None or (power == 1).all() else power
        self.delay = None if delay is None else delay[:, None]
        self.candidates = candidates
        self.lead = lead

        def of(hook: str) -> list[Term]:
            return [term for term in outfit.terms if term.answers(hook)]

        self.late, self.commanding, self.sensing = of("lateness"), of("command"), of("sense")
        self.clocks = of("pace")
        self.partly = None if self.power is None else self._partly(self.power)
        self.erring, self.driving, self.settling = of("error"), of("drive"), of("settle")
        self.flowing = of("flow")
        self.train = next((t for t in outfit.terms if isinstance(t, Drivetrain)), None)
        self.before: Array | None = None
        self.needs_law_damping = any(term.needs_law_damping for term in self.flowing)

    def begin(self) -> None:
        """Let the next sub-step be the first."""
        self.limited.begin()
        self.before = None

    def sense(self, position: Array, velocity: Array) -> tuple[Array, Array]:
        """What the encoders tell of the links' positions and velocities."""
        for term in self.sensing:
            position, velocity = term.sense(position, velocity)
        return position, velocity

    def torque(
        self,
        step: int | Array,
        link: tuple[Array, Array],
        sensed: tuple[Array, Array],
        still: bool = False,
    ) -> tuple[Array, Array]:
        """What reaches the links in one sub-step.

        Args:
          step: the sub-step; where simulations have one each, shape (n_simulations, 1).
          link: positions (rad) and velocities (rad/s) of the links, each (n_active, n_joints).
          sensed: the same as the encoders tell them.
          still: damp by the velocities that are, not by those at the sub-step's end; to try a
            first sub-step, before which nothing has acted.

        Returns:
          The applied torque (N m) and the viscous coefficient (N m s/rad), both of that shape.
        """
        time: float | Array = step * self.scene.timestep - self.lead
        running = len(link[0]) // self.candidates
        target = self._target(step, running, time)
        error, torque, damping, own = self._answer(target.now, sensed)
        if target.before is not None:
            share = self._spread(target.share, running)
            old, was, damped, own_then = self._answer(target.before, sensed)
            kernels.blend(error, torque, damping, old, was, damped, share)
            if own is not None and own_then is not None:
                own = share * own + (1 - share) * own_then
        on = self._on(step, running, time)
        if on is not None:
            torque *= on
            damping *= on
            own = None if own is None else own * on
        self.limited.keep(sensed[1], torque, damping)
        if self.settling:
            outcome = Outcome(time, error, torque - damping * sensed[1], 1.0 if on is None else on)
            for term in self.settling:
                term.settle(outcome)
        brake, viscous = self.limited.split(torque, damping, sensed[1], still)
        if self.flowing:
            now = sensed[1]
            before = now if self.before is None else self.before[: len(now)]
            self.before = now.copy()
            coming = 2 * now - before
            angle = link[0] if self.train is None else self.train.turned(link[0])
            flow = Flow(time, *link, angle, now, coming, own, torque, damping, brake, viscous)
            for term in self.flowing:
                term.flow(flow)
        return torque - brake, damping + viscous

    def _partly(self, power: Array) -> NDArray[np.bool_]:
        """At which sub-steps the torque may be off somewhere, by whatever clock."""
        partly = (power != 1).any(axis=1)
        drift = sum(float(np.abs(term.pace() - 1).max()) for term in self.clocks)
        off = min(np.ceil(drift * len(partly)) + 1, len(partly)) if drift else 0
        return np.asarray(maximum_filter1d(partly, 2 * int(off) + 1, mode="nearest"))

    def _on(self, step: int | Array, running: int, time: float | Array) -> Array | None:
        """Share of a sub-step with the torque on, which is switched by the commands' clock.

        None where it is on in all simulations.
        """
        power = self.power
        if power is None or self.partly is None or not self.partly[step]:
            return None
        if not self.clocks:
            return np.repeat(power[step, :running], self.candidates)[:, None]
        lateness = sum(term.lateness(time, running * self.candidates) for term in self.clocks)
        at = step - np.reshape(lateness, (running, self.candidates)) / self.scene.timestep
        cell = np.floor(at).astype(np.int64)
        recordings, last = np.arange(running)[:, None], len(power) - 1
        now, after = (power[np.clip(cell + i, 0, last), recordings] for i in (0, 1))
        return np.asarray((now + (at - cell) * (after - now)).reshape(-1, 1))

    def _target(self, step: int | Array, running: int, time: float | Array) -> Target:
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
        full = values.repeat(self.candidates // values.shape[1], axis=1)
        return full.reshape(running * self.candidates, -1)

    def _answer(
        self,
        target: Array,
        sensed: tuple[Array, Array],
    ) -> tuple[Array, Array, Array, Array | None]:
        """The law's error, torque and viscous coefficient for one target; see Flow.law_damping."""
        position, velocity = sensed
        if target.ndim == 3:
            by_recording = position.reshape(len(target), self.candidates, -1)
            error = (target - by_recording).reshape(position.shape)
        else:
            error = target - position
        for term in self.erring:
            error = term.error(error)
        if not self.driving and not self.needs_law_damping:
            return error, *self.limited.answer(error, velocity), None
        torque, damping = self.law.unlimited(error, velocity)
        drive = Drive(error, velocity, torque, damping, *self.limited.limits(len(error)))
        for term in self.driving:
            term.drive(drive)
        own = damping.copy() if self.needs_law_damping else None
        self.limited.limit(torque, damping, velocity, drive.upper, drive.lower, drive.slope)
        return error, torque, damping, own
