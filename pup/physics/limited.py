"""A torque law as sub-steps apply it: within the servo's limit, its damping taken implicitly."""

import numpy as np
from numpy.typing import NDArray

from pup.physics import kernels
from pup.physics.actuators import TorqueLaw
from pup.physics.implicit import implicit_share

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
        # Velocity, torque and damping; a torque that is NaN has not acted yet.
        still = np.zeros_like(inertia)
        self._last = still.copy(), np.full_like(inertia, np.nan), still.copy()
        self._level = still
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
        self._most = np.broadcast_to(self.law.limit, self.inertia.shape).copy()
        self._least = -self._most

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
        torque, damping = self.answer(error, velocity)
        self.keep(velocity, torque, damping)
        brake, viscous = self.split(torque, damping, velocity)
        return torque - brake, damping + viscous

    def answer(self, error: Array, velocity: Array) -> tuple[Array, Array]:
        """The law's torque and viscous coefficient, clipped; clipped, nothing is left to damp."""
        torque, damping = self.law.unlimited(error, velocity)
        self.limit(torque, damping, velocity, self._most, self._least, self._level)
        return torque, damping

    def limits(self, n: int) -> tuple[Array, Array, Array]:
        """Largest and smallest torque of the first n simulations and their slope, to be changed."""
        return self._most[:n].copy(), self._least[:n].copy(), self._level[:n].copy()

    def limit(
        self,
        torque: Array,
        damping: Array,
        velocity: Array,
        upper: Array,
        lower: Array,
        slope: Array,
    ) -> None:
        """Keep a torque and its damping within limits, in place; see kernels.limit."""
        kernels.limit(
            torque, damping, velocity, upper, lower, slope, *self._last, self._share, self._inertia
        )

    def keep(self, velocity: Array, torque: Array, damping: Array) -> None:
        """Note what a sub-step applies, for the next one."""
        n = len(velocity)
        before, acted, damped = self._last
        before[:n], acted[:n], damped[:n] = velocity, torque, damping

    def parts(self) -> tuple[Array, ...]:
        """What the compiled loop needs of a steady law; see `pup.physics.loop`.

        Returns:
          Largest and smallest torque; what the last sub-step left; what `limit` takes beside; the
          damping outside the servos; and what `split` takes beside.
        """
        assert self.law.steady
        limit = (*self._last, self._share, self._inertia)
        split = (*self._free, *self._held, self.inertia, self.timestep)
        return (self._most, self._least, *limit, self.viscous, *split)

    def begin(self) -> None:
        """Let all simulations start: nothing is known of what has acted before."""
        self._last[1][:] = np.nan

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
        before, acted, damped = self._last
        before[rows], acted[rows], damped[rows] = velocity, torque, 0.0

    def state(self) -> dict[str, Array]:
        """What the next sub-step depends on: velocity, torque and damping of the last one."""
        return {name: a.copy() for name, a in zip(_KEPT, self._last, strict=True)}

    def restore(self, state: dict[str, Array]) -> None:
        """Take up a state."""
        for kept, name in zip(self._last, _KEPT, strict=True):
            kept[:] = state[name]

    def acted(self, velocity: Array) -> Array:
        """The servos' torques over the last sub-step, N m, which ended at a velocity."""
        _, torque, damping = self._last
        return np.asarray(torque - damping * velocity)

    def split(
        self, torque: Array, damping: Array, velocity: Array, still: bool = False
    ) -> tuple[Array, Array]:
        """Apply as it is what of the damping a sub-step does not take implicitly.

        Args:
          torque: of the servos, N m; changed in place.
          damping: of the servos, N m s/rad; to what is taken implicitly, in place.
          velocity: of the joints, rad/s.
          still: take nothing implicitly.

        Returns:
          The same of the damping outside the servos: torque against theirs, and what is implicit.
        """
        viscous = self.viscous[: len(velocity)].copy()
        brake = np.zeros(viscous.shape)
        if still:
            torque -= damping * velocity
            brake += viscous * velocity
            damping[:], viscous[:] = 0.0, 0.0
        elif self.law.steady:
            kernels.split(
                torque,
                damping,
                brake,
                viscous,
                velocity,
                *self._free,
                *self._held,
                self.inertia,
                self.timestep,
            )
        return brake, viscous
