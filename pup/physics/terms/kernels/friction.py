"""Friction, ripple and what else brakes a joint, in a sub-step."""

import math

import numpy as np

from pup.physics.kernels import Array, kernel

FIRMEST = 2.0
"""Squared phase of a joint that swings on its bristle, in a sub-step, from which it is softened."""
HARDLY = 1e-4
"""Slip, as a share of a bristle's length, that bends it in proportion."""
LEAST = 1e-30
"""Slip that is none."""
SLIPS = 1e-9
"""Slips of a joint's friction in a second, below which it rests."""


@kernel
def rub(
    torque: Array,
    damping: Array,
    bend: Array,
    velocity: Array,
    coming: Array,
    level: Array,
    length: Array,
    inertia: Array,
    timestep: Array,
) -> None:
    """Dry friction on its bristle for a sub-step; see `terms.friction.Friction`.

    Args:
      torque: on its way to the link, N m; changed in place.
      damping: applied times the velocity at the end, N m s/rad; changed in place.
      bend: of the bristle, as a share of where it slips; changed in place.
      velocity: of what it acts on, rad/s.
      coming: what it will be at the sub-step's end, rad/s.
      level: torque at which the bristle slips, N m.
      length: how far a joint gives before it slips, rad.
      inertia: what a joint's torque accelerates, kg m².
      timestep: s.
    """
    for i in range(velocity.shape[0]):
        step = timestep[i, 0]
        for j in range(velocity.shape[1]):
            firm = level[i, j] * step**2 / (FIRMEST * inertia[i, j])
            half = step / 2 / max(length[i, j], firm)
            way = np.sign(velocity[i, j])
            slip = max(abs(velocity[i, j]) * half, LEAST)
            lost = math.expm1(-slip)
            middle = way + (bend[i, j] - way) * (1 + lost)
            bend[i, j] = way + (middle - way) * (1 + lost)
            then = max(abs(coming[i, j]) * half, HARDLY)
            ahead = -math.expm1(-then) / then
            told = way - (middle - way) * lost / slip + bend[i, j] * ahead
            torque[i, j] -= level[i, j] / 2 * told
            damping[i, j] += level[i, j] / 2 * (1 - ahead) / then * half


@kernel
def stribeck(level: Array, velocity: Array, torque: Array, rest: Array, speed: Array) -> None:
    """Friction that is higher at rest; see `terms.friction.StribeckFriction`.

    Args:
      level: torque at which a joint slips, N m; written.
      velocity: rad/s.
      torque: of a joint that slides fast, N m.
      rest: by how much it is more at rest, N m.
      speed: by which that fades, rad/s.
    """
    for i in range(velocity.shape[0]):
        for j in range(velocity.shape[1]):
            fade = math.exp(-abs(velocity[i, j]) / max(speed[i, j], 1e-9))
            level[i, j] = torque[i, j] + rest[i, j] * fade


@kernel
def rising(
    level: Array,
    age: Array,
    velocity: Array,
    torque: Array,
    rise: Array,
    time: Array,
    slip: Array,
    timestep: Array,
) -> None:
    """Friction that rises at rest; see `terms.friction.RisingStaticFriction`.

    Args:
      level: torque at which a joint slips, N m; written.
      age: for how long it has rested, s; changed in place.
      velocity: rad/s.
      torque: of a joint that slides, N m.
      rise: by how much it is more after long, N m.
      time: in which half of that has risen, s.
      slip: that wears it off, rad.
      timestep: s.
    """
    for i in range(velocity.shape[0]):
        step = timestep[i, 0]
        for j in range(velocity.shape[1]):
            fresh = abs(velocity[i, j]) / max(slip[i, j], 1e-9)
            lost = -math.expm1(-fresh * step)
            grown = lost / fresh if fresh > SLIPS else step
            age[i, j] = age[i, j] * (1 - lost) + grown
            share = age[i, j] / (age[i, j] + max(time[i, j], 1e-9))
            level[i, j] = torque[i, j] + rise[i, j] * share


@kernel
def carried(level: Array, torque: Array, damping: Array, coming: Array, share: Array) -> None:
    """Friction that is a share of what a gear carries; see `terms.friction.GearEfficiency`.

    Args:
      level: torque at which a joint slips, N m; written.
      torque: on its way to the link, N m.
      damping: applied times the velocity at the end, N m s/rad.
      coming: that velocity, rad/s.
      share: that is lost.
    """
    for i in range(coming.shape[0]):
        for j in range(coming.shape[1]):
            level[i, j] = share[i, j] * abs(torque[i, j] - damping[i, j] * coming[i, j])


@kernel
def passed(
    level: Array,
    torque: Array,
    damping: Array,
    velocity: Array,
    coming: Array,
    share: Array,
    rotor: Array,
    timestep: Array,
) -> None:
    """Friction that grows with the load; see `terms.friction.LoadDependentFriction`.

    Args:
      level: torque at which a joint slips, N m; written.
      torque: on its way to the link, N m.
      damping: applied times the velocity at the end, N m s/rad.
      velocity: rad/s.
      coming: what it will be at the sub-step's end, rad/s.
      share: of the motor's torque and of what the gear passes on.
      rotor: its inertia, kg m².
      timestep: s.
    """
    for i in range(velocity.shape[0]):
        for j in range(velocity.shape[1]):
            motor = torque[i, j] - damping[i, j] * coming[i, j]
            turning = rotor[i, j] * (coming[i, j] - velocity[i, j]) / timestep[i, 0]
            level[i, j] = share[i, j] * abs(motor + (motor - turning))


@kernel
def one_way(
    level: Array, damping: Array, velocity: Array, bend: Array, torque: Array, viscous: Array
) -> None:
    """Friction in one direction; see `terms.friction.FrictionAsymmetry`.

    Args:
      level: torque at which a joint slips, N m; written.
      damping: applied times the velocity at the end, N m s/rad; changed in place.
      velocity: rad/s.
      bend: of the bristle.
      torque: dry friction, of the direction that its sign tells, N m.
      viscous: the same of viscous friction, N m s/rad.
    """
    for i in range(velocity.shape[0]):
        for j in range(velocity.shape[1]):
            if viscous[i, j] * velocity[i, j] > 0:
                damping[i, j] += abs(viscous[i, j])
            level[i, j] = abs(torque[i, j]) if torque[i, j] * bend[i, j] >= 0 else 0.0


@kernel
def drag(damping: Array, velocity: Array, coefficient: Array) -> None:
    """Damping that grows with the speed; see `terms.actuator.QuadraticDamping`.

    Args:
      damping: applied times the velocity at the end, N m s/rad; changed in place.
      velocity: rad/s.
      coefficient: N m s²/rad².
    """
    for i in range(velocity.shape[0]):
        for j in range(velocity.shape[1]):
            damping[i, j] += coefficient[i, j] * abs(velocity[i, j])


@kernel
def ripple(values: Array, angle: Array, sine: Array, cosine: Array, periods: Array) -> None:
    """Add what goes up and down with an angle; see `terms.actuator.Cogging`.

    Args:
      values: changed in place.
      angle: rad; may be the values themselves.
      sine: of the values' unit.
      cosine: the same.
      periods: in a turn.
    """
    for i in range(angle.shape[0]):
        for j in range(angle.shape[1]):
            turn = periods[i, j] * angle[i, j]
            values[i, j] += sine[i, j] * math.sin(turn) + cosine[i, j] * math.cos(turn)
