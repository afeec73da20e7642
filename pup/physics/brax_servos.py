"""The servos of many simulations on JAX: `actuators` and `limited` over again, as pure functions.

The numbers come from the torque laws and limits that the MuJoCo engine has; see there for why they
are what they are.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from pup.physics.actuators import PD, NetworkPD
from pup.physics.brax_engine import jnp
from pup.physics.limited import LimitedLaw

Answer = tuple[Any, Any]


class Servos(NamedTuple):
    """What the servos of simulations are, a row each; see LimitedLaw.

    Attributes:
      weights: of the torque law.
      limit: largest torque, shape (n, n_joints), N m.
      inertia: what a joint's torque accelerates, shape (n, n_joints), kg m².
      viscous: damping outside the servos, same shape, N m s/rad.
      timestep: sub-step, shape (n, 1), s.
    """

    weights: tuple[Any, ...]
    limit: Any
    inertia: Any
    viscous: Any
    timestep: Any


class Last(NamedTuple):
    """What the last sub-step left, each shape (n, n_joints); NaN before the first one.

    Attributes:
      velocity: at its beginning, rad/s.
      torque: that the servos applied as it is, N m.
      damping: that they applied beside, N m s/rad.
    """

    velocity: Any
    torque: Any
    damping: Any

    def acted(self, velocity: Any) -> Any:
        """The servos' torques over the sub-step, which ended at a velocity, N m."""
        return self.torque - self.damping * velocity


@dataclass(frozen=True)
class Law:
    """A torque law on JAX.

    Attributes:
      weights: those of a law bound to simulations, a row each.
      unlimited: weights, error and velocity to torque and damping; see TorqueLaw.
      steady: see TorqueLaw.
    """

    weights: Callable[[Any], tuple[Any, ...]]
    unlimited: Callable[[tuple[Any, ...], Any, Any], Answer]
    steady: bool

    def servos(self, limited: LimitedLaw) -> Servos:
        """Servos as the MuJoCo engine has them: arrays of NumPy, which that goes on to change."""
        weights = self.weights(limited.law)
        limit = np.broadcast_to(limited.law.limit, limited.inertia.shape)
        return Servos(weights, limit, limited.inertia, limited.viscous, limited.timestep)

    def answer(self, servos: Servos, error: Any, velocity: Any, outside: Any) -> Answer:
        """Torque and viscous coefficient within the limit; see LimitedLaw.answer."""
        torque, damping = self.unlimited(servos.weights, error, velocity)
        reach = servos.timestep / servos.inertia * self._share(servos)
        ahead = (velocity + (torque + outside) * reach) / (1 + reach * damping)
        ahead = jnp.where(jnp.isnan(outside), velocity, ahead)
        total = torque - damping * ahead
        free = abs(total) < servos.limit
        limit = jnp.copysign(servos.limit, total)
        return jnp.where(free, torque, limit), jnp.where(free, damping, 0.0)

    def outside(self, servos: Servos, last: Last, velocity: Any) -> Any:
        """Torque beside the servos', N m, NaN before the first sub-step; see kernels.limit."""
        gained = velocity - last.velocity
        met = last.velocity + gained * self._share(servos)
        return gained * servos.inertia / servos.timestep + last.damping * met - last.torque

    def applied(self, servos: Servos, torque: Any, damping: Any, velocity: Any) -> Answer:
        """What the engine applies as it is, and what implicitly; see Servos.torque."""
        damping = damping + servos.viscous
        if not self.steady:
            return torque, damping
        share = _implicit_share(damping, servos)
        return torque - (1 - share) * damping * velocity, share * damping

    def _share(self, servos: Servos) -> Any:
        """Share of the servos' own damping that a sub-step takes implicitly."""
        if not self.steady:
            return 1.0
        still = jnp.zeros_like(servos.inertia)
        return _implicit_share(self.unlimited(servos.weights, still, still)[1], servos)


def law_of(law: type[PD] | type[NetworkPD]) -> Law:
    """The same torque law on JAX."""
    return _LAWS[law]


def _implicit_share(damping: Any, servos: Servos) -> Any:
    """See `implicit.implicit_share`."""
    x = jnp.maximum(damping * (servos.timestep / servos.inertia), 1e-6)
    return -1 / jnp.expm1(-x) - 1 / x


def _pd(weights: tuple[Any, ...], error: Any, velocity: Any) -> Answer:
    kp, kd = weights
    return kp * error, kd


def _network(weights: tuple[Any, ...], error: Any, velocity: Any) -> Answer:
    w_error, w_speed, bias, w_out, b_out, scale = weights
    hidden = jnp.tanh(w_error * abs(error)[:, None] + w_speed * abs(velocity)[:, None] + bias)
    outputs = b_out + (w_out * hidden[:, :, None]).sum(axis=1)
    gains = scale * (1 + jnp.tanh(outputs))
    return gains[:, 0] * error, gains[:, 1]


def _network_weights(law: NetworkPD) -> tuple[Any, ...]:
    """With the simulations in front: they stand last but one in the law's own arrays."""
    parts = law.w_error, law.w_speed, law.bias, law.w_out, law.b_out, law.scale
    return tuple(np.moveaxis(part, -2, 0) for part in parts)


_LAWS = {
    PD: Law(lambda law: (law.kp, law.kd), _pd, steady=True),
    NetworkPD: Law(_network_weights, _network, steady=False),
}
