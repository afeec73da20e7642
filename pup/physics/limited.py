"""A torque law as sub-steps apply it: within the servo's limit, its damping taken implicitly."""

import numpy as np
from numpy.typing import NDArray

from pup.physics.actuators import TorqueLaw
from pup.physics.implicit import implicit_share
from pup.physics.terms.base import begin

Array = NDArray[np.float64]

_KEPT = ("velocity", "torque", "damping")


class LimitedLaw:
    """A torque law with what its last sub-step left, which decides on the servo's limit.

    Args:
      law: the torque law.
      inertia: what a joint's torque accelerates, shape (n_simulations, n_joints), kg m².
      viscous: damping outside the servos, same shape, N m s/rad.
      timestep: s; one for all, or one each, shape (n_simulations, 1).
    """

    def __init__(
        self, law: TorqueLaw, inertia: Array, viscous: Array, timestep: float | Array
    ) -> None:
        self.law = law
        self.inertia = inertia
        self.viscous = viscous
        self.timestep = np.broadcast_to(timestep, (len(inertia), 1)).copy()
        self._last: tuple[Array, Array, Array] | None = None
        self._starting = False
        self.derive()

    def derive(self) -> None:
        """Compute anew what follows from the law, the inertia, the damping and the sub-step."""
        self._inertia = self.inertia / self.timestep
        still = np.zeros_like(self.inertia)
        self._share = np.ones_like(still)
        if self.law.steady:
            own = self.law.unlimited(still, still)[1]
            self._share = implicit_share(own, self.inertia, self.timestep)
            self._free, self._held = self._damped(own), self._damped(still)
        self._reach = self._share / self._inertia

    def _damped(self, servo: Array) -> tuple[Array, Array]:
        """All damping with some of the servos, and the share that a sub-step takes implicitly."""
        total = servo + self.viscous
        return total, implicit_share(total, self.inertia, self.timestep)

    def torque(self, error: Array, velocity: Array) -> tuple[Array, Array]:
        """What reaches the links in one sub-step, with nothing between servo and link.

        Args:
          error: target minus position, shape (n_simulations, n_joints), rad.
          velocity: joint velocity, same shape, rad/s.

        Returns:
          The applied torque (N m) and the viscous coefficient that the engine shall take
          implicitly (N m s/rad), both of that shape.
        """
        torque, damping = self.answer(error, velocity, self.outside(velocity))
        self.keep(velocity, torque, damping)
        damping = damping + self.viscous
        share = self.implicit(damping)
        if share is not None:
            torque = torque - (1 - share) * (damping * velocity)
            damping *= share
        return torque, damping

    def answer(self, error: Array, velocity: Array, outside: Array | None) -> tuple[Array, Array]:
        """The law's torque and viscous coefficient, clipped; `outside` as `outside` tells it."""
        torque, damping = self.law.unlimited(error, velocity)
        limit = self.law.limit[: len(error)]
        clip(torque, damping, self.ahead(torque, damping, velocity, outside), limit)
        return torque, damping

    def keep(self, velocity: Array, torque: Array, damping: Array) -> None:
        """Note what a sub-step applies, for the next one."""
        self._last = velocity.copy(), torque, damping
        self._starting = False

    def begin(self) -> None:
        """Let all simulations start: nothing is known of what has acted before."""
        self._last = None

    def renew(
        self,
        rows: NDArray[np.int64],
        law: TorqueLaw,
        inertia: Array,
        viscous: Array,
        timestep: float | Array,
    ) -> None:
        """Give some simulations what another law was made of, one row for each."""
        self.law.renew(rows, law)
        self.inertia[rows], self.viscous[rows], self.timestep[rows] = inertia, viscous, timestep
        self.derive()

    def forget(self, rows: NDArray[np.int64], velocity: Array, torque: float = 0.0) -> None:
        """Let some simulations start from a velocity.

        Args:
          rows: which.
          velocity: of their joints, shape (n_rows, n_joints), rad/s.
          torque: that has acted before, N m; NaN as in a replay, where nothing is known of it.
        """
        if self._last is None:
            still = np.zeros_like(self.inertia)
            self._last = still, still.copy(), still.copy()
        before, acted, damping = self._last
        before[rows], acted[rows], damping[rows] = velocity, torque, 0.0
        self._starting = True

    def state(self) -> dict[str, Array]:
        """What the next sub-step depends on: velocity, torque and damping of the last one."""
        assert self._last is not None
        return {name: a.copy() for name, a in zip(_KEPT, self._last, strict=True)}

    def restore(self, state: dict[str, Array]) -> None:
        """Take up a state."""
        before, torque, damping = (state[name].copy() for name in _KEPT)
        self._last = before, torque, damping
        self._starting = True

    def acted(self, velocity: Array) -> Array:
        """The servos' torques over the last sub-step, N m, which ended at a velocity."""
        assert self._last is not None
        _, torque, damping = self._last
        return np.asarray(torque - damping * velocity)

    def outside(self, velocity: Array) -> Array | None:
        """Torque beside the servos', N m, by what the last sub-step did; None before the first."""
        if self._last is None:
            return None
        n = len(velocity)
        before, torque, damping = (a[:n] for a in self._last)
        gained = velocity - before
        met = velocity  # by what is taken implicitly
        if self.law.steady:
            met = gained * self._share[:n]
            met += before
        braked = damping * met
        gained *= self._inertia[:n]
        gained += braked
        gained -= torque
        return gained

    def ahead(self, torque: Array, damping: Array, velocity: Array, outside: Array | None) -> Array:
        """The velocity that damping meets in a sub-step, by each joint's own inertia.

        Whether a servo is at its limit is decided by it. Decided by the velocity that is, a servo
        would leave its limit with a jump of its torque, by what a sub-step changes of the damping,
        and trajectories would jump with whatever moves that moment past a sub-step's end. Stiff
        damping brakes within the sub-step: velocities that only go on as they did would mislead.
        """
        if outside is None:
            return velocity
        reach = self._reach[: len(velocity)]
        ahead = torque + outside
        ahead *= reach
        ahead += velocity
        slower = reach * damping
        slower += 1
        ahead /= slower
        if self._starting:
            begin(ahead, velocity)
        return ahead

    def implicit(self, damping: Array) -> Array | None:
        """Share of a damping that the engine takes implicitly; None where it takes all of it."""
        if not self.law.steady:
            return None
        n = len(damping)
        free, held = self._free[0][:n], self._held[0][:n]
        off_limit = damping == free
        if (off_limit | (damping == held)).all():  # as it mostly is, without exponentials
            return np.where(off_limit, self._free[1][:n], self._held[1][:n])
        return implicit_share(damping, self.inertia[:n], self.timestep[:n])


def clip(torque: Array, damping: Array, ahead: Array, limit: Array) -> None:
    """Clip `torque - damping * ahead` to ±limit, in place; clipped, nothing is left to damp."""
    total = torque - damping * ahead
    clipped = ~(np.abs(total) < limit)
    np.copysign(limit, total, out=torque, where=clipped)
    np.copyto(damping, 0.0, where=clipped)
