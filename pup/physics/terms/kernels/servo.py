"""What a servo makes of its commands and its error in a sub-step."""

import math

from pup.physics.kernels import Array, implicit_share, kernel


@kernel
def travel(
    now: Array,
    before: Array,
    share: Array,
    timestep: Array,
    rate: Array,
    acceleration: Array,
    limited: Array,
    goal: Array,
    speed: Array,
) -> None:
    """Move a controller's goals towards its commands; see `terms.actuator.TargetRateLimit`.

    Args:
      now: the command at the sub-step's end, rad; to the goal's mean while it holds, in place.
      before: the one at its beginning, rad; the same.
      share: of the sub-step for which `now` holds; a single row or column stands for all.
      timestep: s.
      rate: largest speed of a goal, rad/s.
      acceleration: at which that speed changes, rad/s².
      limited: 1 where there is such a limit, else 0.
      goal: rad; NaN where it starts; changed in place.
      speed: of the goal, rad/s; changed in place.
    """
    for i in range(now.shape[0]):
        step = timestep[i, 0]
        for j in range(now.shape[1]):
            if limited[i, j] == 0:
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
def differ(
    now: Array,
    before: Array,
    share: Array,
    timestep: Array,
    goal: Array,
    rate: Array,
    pace: Array,
) -> None:
    """Take note of how fast commands change; see `terms.actuator.DerivativeKick`.

    Args:
      now: the command at the sub-step's end, rad.
      before: the one at its beginning, rad.
      share: of the sub-step for which `now` holds; a single row or column stands for all.
      timestep: s.
      goal: the filtered command, rad; NaN where it starts; changed in place.
      rate: of it, rad/s; written.
      pace: logarithm of what a filter forgets over a sub-step.
    """
    for i in range(now.shape[0]):
        for j in range(now.shape[1]):
            if math.isnan(goal[i, j]):
                goal[i, j] = before[i, j]
            part = share[min(i, share.shape[0] - 1), min(j, share.shape[1] - 1)]
            fading = math.exp(pace[i, j] * (1 - part))
            at_change = before[i, j] + fading * (goal[i, j] - before[i, j])
            later = now[i, j] + math.exp(pace[i, j] * part) * (at_change - now[i, j])
            rate[i, j] = (later - goal[i, j]) / timestep[i, 0]
            goal[i, j] = later


@kernel
def kick(torque: Array, gain: Array, rate: Array) -> None:
    """Add a derivative part; see `terms.actuator.DerivativeKick`.

    Args:
      torque: N m; changed in place.
      gain: N m s/rad.
      rate: of the filtered command, rad/s.
    """
    for i in range(torque.shape[0]):
        for j in range(torque.shape[1]):
            torque[i, j] += gain[i, j] * rate[i, j]


@kernel
def forgive(error: Array, width: Array) -> None:
    """Let small errors count as none; see `terms.actuator.DeadBand`.

    Args:
      error: rad; changed in place.
      width: below which it is none, rad.
    """
    for i in range(error.shape[0]):
        for j in range(error.shape[1]):
            left = max(abs(error[i, j]) - width[i, j], 0.0)
            error[i, j] = math.copysign(left, error[i, j])


@kernel
def favour(torque: Array, error: Array, share: Array) -> None:
    """Pull stiffer in one direction; see `terms.actuator.GainAsymmetry`.

    Args:
      torque: N m; changed in place.
      error: rad.
      share: by which it is stiffer for positive errors.
    """
    for i in range(torque.shape[0]):
        for j in range(torque.shape[1]):
            torque[i, j] *= 1 + share[i, j] if error[i, j] > 0 else 1 - share[i, j]


@kernel
def integrate(
    torque: Array,
    error: Array,
    gain: Array,
    total: Array,
    least: Array,
    most: Array,
    timestep: Array,
) -> None:
    """Add an integral part, in the middle of a sub-step; see `terms.actuator.IntegralAction`.

    Args:
      torque: N m; changed in place.
      error: rad.
      gain: N m/(rad s).
      total: of the errors, rad s.
      least: to which it is kept.
      most: the same.
      timestep: s.
    """
    for i in range(torque.shape[0]):
        for j in range(torque.shape[1]):
            after = total[i, j] + timestep[i, 0] / 2 * error[i, j]
            torque[i, j] += gain[i, j] * max(min(after, most[i, j]), least[i, j])


@kernel
def add_up(
    total: Array,
    error: Array,
    on: Array,
    lasting: Array,
    least: Array,
    most: Array,
    timestep: Array,
) -> None:
    """Add an error to an integral; see `terms.actuator.IntegralAction`.

    Args:
      total: of the errors, rad s; changed in place.
      error: rad.
      on: share of the sub-step with the torque on; a single row or column stands for all.
      lasting: share that a servo keeps whose torque is off.
      least: to which it is kept.
      most: the same.
      timestep: s.
    """
    for i in range(error.shape[0]):
        for j in range(error.shape[1]):
            after = total[i, j] + timestep[i, 0] * error[i, j]
            kept = max(on[min(i, on.shape[0] - 1), min(j, on.shape[1] - 1)], lasting[i, j])
            total[i, j] = max(min(after, most[i, j]), least[i, j]) * kept


@kernel
def weaken(
    torque: Array,
    damping: Array,
    upper: Array,
    lower: Array,
    warmth: Array,
    rate: Array,
    load: Array,
) -> None:
    """Let a servo be weaker; see `terms.actuator.ThermalDrift`.

    Args:
      torque: N m; changed in place.
      damping: N m s/rad; changed in place.
      upper: largest torque, N m; changed in place.
      lower: smallest one, N m; changed in place.
      warmth: how long it has run, or how warm it is, s.
      rate: by which that weakens it, 1/s.
      load: whether it is warmed by what it carries.
    """
    for i in range(torque.shape[0]):
        for j in range(torque.shape[1]):
            left = max(1 - rate[i, j] * warmth[i, j], 0.05)
            torque[i, j] *= left
            upper[i, j] *= left
            lower[i, j] *= left
            damping[i, j] *= 1 - load[i, j] * (1 - left)


@kernel
def warm(
    warmth: Array, torque: Array, load: Array, heat: Array, cooling: Array, timestep: Array
) -> None:
    """Let a servo grow warmer; see `terms.actuator.ThermalDrift`.

    Args:
      warmth: s; changed in place.
      torque: N m.
      load: whether it is warmed by what it carries.
      heat: by how much, 1/(N m).
      cooling: share that a sub-step takes.
      timestep: s.
    """
    for i in range(torque.shape[0]):
        for j in range(torque.shape[1]):
            gained = 1 - load[i, j] + heat[i, j] * abs(torque[i, j])
            warmth[i, j] += timestep[i, 0] * gained - cooling[i, j] * warmth[i, j]


@kernel
def dim(torque: Array, upper: Array, lower: Array, left: Array) -> None:
    """Let a supply that sags leave less; see `terms.actuator.VoltageSag`.

    Args:
      torque: N m; changed in place.
      upper: largest torque, N m; changed in place.
      lower: smallest one, N m; changed in place.
      left: share of them that the supply leaves.
    """
    for i in range(torque.shape[0]):
        for j in range(torque.shape[1]):
            torque[i, j] *= left[i, j]
            upper[i, j] *= left[i, j]
            lower[i, j] *= left[i, j]


@kernel
def sag(left: Array, torque: Array, drop: Array, kept: Array) -> None:
    """Let a supply sag under the torque of all joints; see `terms.actuator.VoltageSag`.

    Args:
      left: share that it leaves; changed in place.
      torque: N m.
      drop: 1/(N m).
      kept: of what its capacitors hold, over a sub-step.
    """
    for i in range(torque.shape[0]):
        whole = 0.0
        for j in range(torque.shape[1]):
            whole += abs(torque[i, j])
        for j in range(torque.shape[1]):
            goal = 1 / (1 + drop[i, j] * whole)  # its own resistance also limits what it gives
            left[i, j] = goal + kept[i, j] * (left[i, j] - goal)


@kernel
def outrun(upper: Array, lower: Array, fall: Array, velocity: Array, slope: Array) -> None:
    """Let limits fall with the speed; see `terms.actuator.TorqueSpeedLimit`.

    Args:
      upper: largest torque, N m; changed in place.
      lower: smallest one, N m; changed in place.
      fall: by how much both fall with the velocity at the end, N m s/rad; changed in place.
      velocity: rad/s.
      slope: N m s/rad.
    """
    for i in range(velocity.shape[0]):
        for j in range(velocity.shape[1]):
            upper[i, j] -= slope[i, j] * velocity[i, j]
            lower[i, j] -= slope[i, j] * velocity[i, j]
            fall[i, j] += slope[i, j]


@kernel
def lag(
    torque: Array,
    damping: Array,
    velocity: Array,
    law: Array,
    inertia: Array,
    timestep: Array,
    kept: Array,
    weight: Array,
    time: Array,
    lagging: Array,
    asked: Array,
    ahead: Array,
) -> None:
    """Let a servo's torque follow what is asked for; see `terms.actuator.ActuatorLag`.

    Args:
      torque: on its way to the link, N m; changed in place.
      damping: applied times the velocity at the end, N m s/rad; changed in place.
      velocity: of what it acts on, rad/s.
      law: the law's own damping, which does not wait, N m s/rad.
      inertia: what a joint's torque accelerates, kg m².
      timestep: s.
      kept: of what lags, over a sub-step.
      weight: of what is asked for now, in the mean over a sub-step.
      time: constant of the lag, s; 0 for none.
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
            share = implicit_share(law[i, j], inertia[i, j], timestep[i, 0])
            own = (1 - share) * law[i, j] * velocity[i, j]
            asked[i, j] = torque[i, j] + own
            ahead[i, j] = share * law[i, j] - damping[i, j]
            if math.isnan(lagging[i, j]):
                # It stood; velocities begin half a sub-step before, which a limit does not see.
                lagging[i, j] = asked[i, j] if damping[i, j] > 0 else torque[i, j]
            if time[i, j] > 0:
                now, then = weight[i, j], 1 - weight[i, j]
                torque[i, j] = now * torque[i, j] + then * (lagging[i, j] - own)
                damping[i, j] = now * damping[i, j] + then * share * law[i, j]
