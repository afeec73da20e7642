"""Torque laws of position servos, for many simulations at once.

A law splits its torque into a part that the engine applies as it is and a viscous coefficient
that the engine integrates implicitly; `servo` keeps their sum within the law's limit. A servo's
damping over a light link's inertia is stiffer than any step worth taking (0.7 N m s/rad on
3e-4 kg m² asks for 0.4 ms); taken implicitly, 2 ms is stable and the small-step limit is the same.
"""

from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.physics.parameters import NETWORK_NAMES, Candidates
from pup.robot import NetworkOptions, RobotDescription

Array = NDArray[np.float64]


class TorqueLaw(Protocol):
    """A servo's torque, bound to the simulations of one batch.

    A law may keep state per simulation; it is made anew for every replay.
    """

    armature: Array | None
    """Rotor inertia at the joint, broadcastable to (n_simulations, n_joints), kg m²; None keeps
    the model's."""
    passive: float
    """Viscous damping that stays when the torque is off, N m s/rad."""
    steady: bool
    """Whether the viscous coefficient stays the same from sub-step to sub-step."""
    limit: Array
    """Largest torque of the servo, broadcastable to (n_simulations, n_joints), N m."""

    def unlimited(self, error: Array, velocity: Array) -> tuple[Array, Array]:
        """Torque of one sub-step, before any limit.

        Args:
          error: target minus position, shape (n_active, n_joints), rad. The active simulations
            are the first ones of those the law was made for.
          velocity: joint velocity, same shape, rad/s.

        Returns:
          The applied torque (N m) and the viscous coefficient (N m s/rad), both of that shape.
        """
        ...

    def renew(self, rows: NDArray[np.int64], other: Self) -> None:
        """Give some simulations the parameters of another law, which has one row for each."""
        ...


class PD:
    """Torque clip(kp (target - q) - kd qdot, ±tau_max), per joint group (docs/physics.md).

    Args:
      robot: gives the groups of the joints.
      candidates: kp, kd, tau_max per group and armature, one row per simulation.
    """

    def __init__(self, robot: RobotDescription, candidates: Candidates) -> None:
        self.kp = per_joint(robot, candidates, "kp")
        self.kd = per_joint(robot, candidates, "kd")
        self.limit = per_joint(robot, candidates, "tau_max")
        self.armature = candidates["armature"][:, None].copy() if "armature" in candidates else None
        self.passive = 0.0
        self.steady = True

    def unlimited(self, error: Array, velocity: Array) -> tuple[Array, Array]:
        """See TorqueLaw."""
        n = len(error)
        return self.kp[:n] * error, self.kd[:n].copy()

    def renew(self, rows: NDArray[np.int64], other: Self) -> None:
        """See TorqueLaw."""
        self.kp[rows], self.kd[rows], self.limit[rows] = other.kp, other.kd, other.limit
        if self.armature is not None:
            self.armature[rows] = other.armature


class NetworkPD:
    """The paper's NN-PD (section III-B), with the authors' input scaling and passive damping.

    A network of five tanh units, shared by all joints, maps (error_scale |target - q|, |qdot|) to
    the two gains through sigmoids; groups scale them by rho and sigma, and the torque is clipped.
    A passive viscous damping outside the clip belongs to the authors' joints.

    Args:
      robot: gives the groups of the joints and the network's options.
      candidates: rho, sigma per group, torque_limit and phi, one row per simulation.
    """

    def __init__(self, robot: RobotDescription, candidates: Candidates) -> None:
        options = robot.network or NetworkOptions()
        rho, sigma = (per_joint(robot, candidates, kind) for kind in ("rho", "sigma"))
        # Every joint gets its own copy of the weights: arrays of one shape multiply twice as fast.
        # So does single precision, whose 1e-7 of a gain is far below what gains are known to.
        phi = candidates.columns(NETWORK_NAMES).T.astype(np.float32)
        weights = np.repeat(phi[:, :, None], rho.shape[1], axis=2)
        self.w_error = weights[0:5] * options.error_scale
        self.w_speed, self.bias = weights[5:10], weights[10:15]
        # Of the outputs first kp, then kd. A sigmoid is (1 + tanh(x/2))/2: the halves are put into
        # the weights once.
        self.w_out = weights[15:25].reshape(5, 2, *rho.shape) / 2
        self.b_out = weights[25:27] / 2
        halves = rho * (options.kp_scale / 2), sigma * (options.kd_scale / 2)
        self.scale = np.stack(halves).astype(np.float32)
        self.limit = candidates["torque_limit"][:, None].copy()
        self.passive = options.passive_damping
        self.steady = False
        self.armature = np.full((1, 1), options.armature) if options.armature else None
        # Room for what every sub-step computes.
        self._hidden = np.empty_like(self.bias)
        self._weighted = np.empty_like(self.w_out)

    def gains(self, error: Array, velocity: Array) -> tuple[Array, Array]:
        """Gains kp (N m/rad) and kd (N m s/rad), shape (n_active, n_joints)."""
        n = len(error)
        hidden, weighted = self._hidden[:, :n], self._weighted[:, :, :n]
        error, velocity = (np.abs(a.astype(np.float32)) for a in (error, velocity))
        np.multiply(self.w_error[:, :n], error, out=hidden)
        hidden += np.multiply(self.w_speed[:, :n], velocity, out=weighted[:, 0])
        hidden += self.bias[:, :n]
        np.tanh(hidden, out=hidden)
        np.multiply(self.w_out[:, :, :n], hidden[:, None], out=weighted)
        gains = self.b_out[:, :n] + weighted[0]
        for unit in weighted[1:]:  # in this order whatever the batch: sum() may choose another
            gains += unit
        np.tanh(gains, out=gains)
        gains += 1
        gains *= self.scale[:, :n]
        return gains[0].astype(np.float64), gains[1].astype(np.float64)

    def unlimited(self, error: Array, velocity: Array) -> tuple[Array, Array]:
        """See TorqueLaw."""
        torque, damping = self.gains(error, velocity)
        torque *= error
        return torque, damping

    def renew(self, rows: NDArray[np.int64], other: Self) -> None:
        """See TorqueLaw; the armature is the same for all."""
        self.w_error[:, rows], self.w_speed[:, rows] = other.w_error, other.w_speed
        self.bias[:, rows] = other.bias
        self.w_out[:, :, rows], self.b_out[:, rows] = other.w_out, other.b_out
        self.scale[:, rows], self.limit[rows] = other.scale, other.limit


def per_joint(robot: RobotDescription, candidates: Candidates, kind: str) -> Array:
    """A parameter given per group, spread to the joints: shape (n_simulations, n_joints)."""
    try:
        columns = candidates.columns([f"{kind}/{group}" for group in robot.groups])
    except KeyError as error:
        raise InputError(
            f"parameter {error.args[0]!r} is missing; the actuator needs {kind} for each group"
        ) from error
    return np.ascontiguousarray(columns[:, robot.group_index])


LAWS: dict[str, type[PD] | type[NetworkPD]] = {"pd": PD, "nn_pd": NetworkPD}
