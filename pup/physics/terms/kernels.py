"""The arithmetic of terms in a sub-step, compiled; see `pup.physics.kernels` for the arrays."""

import math

import numpy as np

from pup.physics.kernels import Array, Mask, kernel

FIRMEST = 2.0
"""Squared phase of a joint that swings on its bristle, in a sub-step, from which it is softened."""
HARDLY = 1e-4
"""Slip, as a share of a bristle's length, that bends it in proportion."""
LEAST = 1e-30
"""Slip that is none."""


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
      velocity: of the link, rad/s.
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
def travel(
    now: Array,
    before: Array,
    share: Array,
    timestep: Array,
    rate: Array,
    acceleration: Array,
    limited: Mask,
    goal: Array,
    speed: Array,
) -> None:
    """Move a controller's goals towards its commands; see `terms.actuator.TargetRateLimit`.

    Args:
      now: the command at the sub-step's end, rad; to the goal's mean while it holds, in place.
      before: the one at its beginning, rad; the same.
      share: of the sub-step for which `now` holds; a single row or column stands for all.
      timestep: s; a single row stands for all.
      rate: largest speed of a goal, rad/s.
      acceleration: at which that speed changes, rad/s².
      limited: where there is such a limit.
      goal: rad; NaN where it starts; changed in place.
      speed: of the goal, rad/s; changed in place.
    """
    for i in range(now.shape[0]):
        step = timestep[min(i, timestep.shape[0] - 1), 0]
        for j in range(now.shape[1]):
            if not limited[i, j]:
                goal[i, j], speed[i, j] = now[i, j], 0.0
                continue
            if math.isnan(goal[i, j]):
                goal[i, j] = before[i, j]
            part = share[min(i, share.shape[0] - 1), min(j, share.shape[1] - 1)]
            for later in range(2):
                target = now[i, j] if later else before[i, j]
                time = step * part if later else step * (1 - part)
                away, gained = target - goal[i, j], acceleration[i, j] * time
                far = abs(away)
                wanted = min(rate[i, j], math.sqrt(2 * acceleration[i, j] * far))
                wanted = math.copysign(wanted, away)
                fast = min(max(wanted, speed[i, j] - gained), speed[i, j] + gained)
                more = fast - speed[i, j]
                way, took = fast * time - more * abs(more) / (2 * acceleration[i, j]), 1.0
                if abs(way) >= far and way * away >= 0:  # it arrives
                    took, way, fast = far / max(abs(way), 1e-12), away, 0.0
                goal[i, j] += way
                speed[i, j] = fast
                if later:
                    now[i, j] = goal[i, j] - way * took / 2
                else:
                    before[i, j] = goal[i, j] - way * took / 2


@kernel
def lag(
    torque: Array,
    damping: Array,
    velocity: Array,
    law: Array,
    implicit: Array,
    time: Array,
    kept: Array,
    weight: Array,
    lagging: Array,
    asked: Array,
    ahead: Array,
) -> None:
    """Let a servo's torque follow what is asked for; see `terms.actuator.ActuatorLag`.

    Args:
      torque: on its way to the link, N m; changed in place.
      damping: applied times the velocity at the end, N m s/rad; changed in place.
      velocity: of the link, rad/s.
      law: the law's own damping, which does not wait, N m s/rad.
      implicit: the share of it that a sub-step takes implicitly.
      time: constant of the lag, s; 0 for none.
      kept: of what lags, over a sub-step.
      weight: of what is asked for now, in the mean over a sub-step.
      lagging: torque, N m; NaN where it starts; changed in place.
      asked: at the last sub-step, N m; changed in place.
      ahead: by how much that changes with the velocity it came to, N m s/rad; changed in place.
    """
    for i in range(velocity.shape[0]):
        for j in range(velocity.shape[1]):
            if torque[i, j] == 0 and damping[i, j] == 0:
                lagging[i, j] = math.nan  # it is off
                continue
            last = asked[i, j] + ahead[i, j] * velocity[i, j]
            lagging[i, j] = last + kept[i, j] * (lagging[i, j] - last)
            own = (1 - implicit[i, j]) * law[i, j] * velocity[i, j]
            asked[i, j] = torque[i, j] + own
            ahead[i, j] = implicit[i, j] * law[i, j] - damping[i, j]
            if math.isnan(lagging[i, j]):
                # It stood; velocities begin half a sub-step before, which a limit does not see.
                lagging[i, j] = asked[i, j] if damping[i, j] > 0 else torque[i, j]
            if time[i, j] > 0:
                now, then = weight[i, j], 1 - weight[i, j]
                torque[i, j] = now * torque[i, j] + then * (lagging[i, j] - own)
                damping[i, j] = now * damping[i, j] + then * implicit[i, j] * law[i, j]


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
    active: Mask,
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
      active: where there is a motor of its own.
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
            if active[i, j]:
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
    active: Mask,
    gap: Array,
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
      active: where there is a motor of its own.
      gap: half of the play, rad.
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
            through, grip = 0.0, 0.0
            if abs(coming) >= gap[i, j]:
                grip = reach[i, j] / (give[i, j] + reach[i, j] / heavy)
                beyond = ahead - math.copysign(gap[i, j], coming)
                beyond += past[i, j] * (speed[i, j] - velocity[i, j])
                through = grip * (beyond / reach[i, j] + alone)
            heft[i, j], free[i, j] = heavy, alone
            reached[i, j], reached_damping[i, j] = through, grip
            if active[i, j]:
                torque[i, j], damping[i, j] = through, grip
                brake[i, j], viscous[i, j] = 0.0, 0.0
