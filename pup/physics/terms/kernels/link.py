"""What lies between motor and link, and what is beside them, in a sub-step."""

import math

from pup.physics.kernels import Array, kernel


@kernel
def follow(
    told: Array,
    felt: Array,
    position: Array,
    velocity: Array,
    own: Array,
    speed: Array,
    free: Array,
    heft: Array,
    torque: Array,
    damping: Array,
    first: Array,
    start: Array,
    active: Array,
    gap: Array,
    play_seen: Array,
    bend_seen: Array,
    timestep: Array,
) -> None:
    """Move motors behind play and give on, and tell what their encoders see.

    See `terms.transmission.Drivetrain`.

    Args:
      told: what the encoder sees, rad; written.
      felt: velocity of the motor, or of the link where it has none of its own, rad/s; written.
      position: of the link, rad.
      velocity: of the link, rad/s.
      own: position of the motor, rad; NaN where it starts; changed in place.
      speed: its velocity, rad/s; written.
      free: what its velocity would be without the link, rad/s.
      heft: torque that changes its velocity, N m s/rad.
      torque: that has reached the link, N m.
      damping: the same times the link's velocity, N m s/rad.
      first: velocity with which a motor starts, rad/s; NaN for the link's.
      start: by how much it starts ahead of the link, rad.
      active: 1 where there is a motor of its own, else 0.
      gap: half of the play, rad.
      play_seen: share of the play that the encoder sees.
      bend_seen: share of the give that it sees.
      timestep: s.
    """
    for i in range(velocity.shape[0]):
        for j in range(velocity.shape[1]):
            pulled = torque[i, j] - damping[i, j] * velocity[i, j]
            now = free[i, j] - pulled / heft[i, j]
            if math.isnan(own[i, j]):
                now = first[i, j]
            if math.isnan(now):
                now = velocity[i, j]
            speed[i, j] = now
            own[i, j] += timestep[i, 0] * now
            if math.isnan(own[i, j]):
                own[i, j] = position[i, j] + start[i, j]
            told[i, j], felt[i, j] = position[i, j], velocity[i, j]
            if active[i, j] != 0:
                ahead = own[i, j] - position[i, j]
                play = min(max(ahead, -gap[i, j]), gap[i, j])
                told[i, j] += play_seen[i, j] * play + bend_seen[i, j] * (ahead - play)
                felt[i, j] = now


@kernel
def engage(
    torque: Array,
    damping: Array,
    brake: Array,
    viscous: Array,
    position: Array,
    velocity: Array,
    own: Array,
    speed: Array,
    free: Array,
    heft: Array,
    reached: Array,
    reached_damping: Array,
    active: Array,
    gap: Array,
    drag: Array,
    give: Array,
    rotor: Array,
    reach: Array,
    past: Array,
    timestep: Array,
) -> None:
    """What of servos' torques reaches links behind play and give.

    See `terms.transmission.Drivetrain`.

    Args:
      torque: on its way to the link, N m; changed in place.
      damping: applied times the velocity at the end, N m s/rad; changed in place.
      brake: against the torque, by damping outside the servo, N m; changed in place.
      viscous: the part of that damping applied at the end, N m s/rad; changed in place.
      position: of the link, rad.
      velocity: of the link, rad/s.
      own: position of the motor, rad.
      speed: its velocity, rad/s.
      free: what it would be without the link, rad/s; written.
      heft: torque that changes its velocity, N m s/rad; written.
      reached: torque that reaches the link, N m; written.
      reached_damping: the same times the link's velocity, N m s/rad; written.
      active: 1 where there is a motor of its own, else 0.
      gap: half of the play, rad.
      drag: within the play, N m s/rad.
      give: compliance, rad/(N m).
      rotor: its inertia over the timestep, kg m²/s.
      reach: time by which the velocity at the end bends the give, s.
      past: time by which the velocity before does, s.
      timestep: s.
    """
    for i in range(velocity.shape[0]):
        for j in range(velocity.shape[1]):
            heavy = rotor[i, j] + damping[i, j] + viscous[i, j]
            alone = (rotor[i, j] * speed[i, j] + torque[i, j] - brake[i, j]) / heavy
            ahead = own[i, j] - position[i, j]
            coming = ahead + timestep[i, 0] * (alone - velocity[i, j])
            # Where they do not meet, the drag pulls by the velocities at the sub-step's end.
            grip = drag[i, j] / (1 + drag[i, j] / heavy)
            through = grip * alone
            if abs(coming) >= gap[i, j]:
                grip = reach[i, j] / (give[i, j] + reach[i, j] / heavy)
                beyond = ahead - math.copysign(gap[i, j], coming)
                beyond += past[i, j] * (speed[i, j] - velocity[i, j])
                through = grip * (beyond / reach[i, j] + alone)
            heft[i, j], free[i, j] = heavy, alone
            reached[i, j], reached_damping[i, j] = through, grip
            if active[i, j] != 0:
                torque[i, j], damping[i, j] = through, grip
                brake[i, j], viscous[i, j] = 0.0, 0.0


@kernel
def pull(torque: Array, position: Array, stiffness: Array, preload: Array) -> None:
    """Add a spring beside the servo; see `terms.transmission.JointSpring`.

    Args:
      torque: on its way to the link, N m; changed in place.
      position: rad.
      stiffness: N m/rad.
      preload: N m.
    """
    for i in range(torque.shape[0]):
        for j in range(torque.shape[1]):
            torque[i, j] += preload[i, j] - stiffness[i, j] * position[i, j]


@kernel
def block(
    torque: Array,
    damping: Array,
    position: Array,
    velocity: Array,
    side: Array,
    angle: Array,
    stiffness: Array,
    soon: Array,
    later: Array,
    past: Array,
    reach: Array,
) -> None:
    """Push back where something is in the way; see `terms.transmission.JointStop`.

    Args:
      torque: on its way to the link, N m; changed in place.
      damping: applied times the velocity at the end, N m s/rad; changed in place.
      position: rad.
      velocity: rad/s.
      side: where it is in the way, 1 for larger angles and -1 for smaller ones.
      angle: from which on, rad.
      stiffness: N m/rad.
      soon: how far ahead of the velocity it has to touch, s.
      later: the same once more, s.
      past: time by which the velocity before presses, s.
      reach: time by which the one at the end does, s.
    """
    for i in range(torque.shape[0]):
        for j in range(torque.shape[1]):
            into = side[i, j] * (position[i, j] - angle[i, j])
            speed = side[i, j] * velocity[i, j]
            if into + soon[i, j] * speed > 0 and into + later[i, j] * speed > 0:
                firm = stiffness[i, j]
                torque[i, j] -= side[i, j] * firm * (into + past[i, j] * speed)
                damping[i, j] += firm * reach[i, j]


@kernel
def shift(position: Array, offset: Array) -> None:
    """Tell positions from another zero; see `terms.sensing.EncoderBias`.

    Args:
      position: rad; changed in place.
      offset: rad.
    """
    for i in range(position.shape[0]):
        for j in range(position.shape[1]):
            position[i, j] += offset[i, j]
