"""The arithmetic of a sub-step, compiled.

A call of NumPy costs more than all arithmetic of a few simulations; each function here does in one
loop over simulations and joints what would take tens of calls.

Arrays have a row for each simulation and a column for each joint; those of timesteps have one
column. The first simulations are active, as many as `velocity` or else the first argument has rows:
other arrays may have more, which are left alone. What is computed for a simulation depends on its
own row only.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, ParamSpec, get_type_hints

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Index = NDArray[np.int64]
P = ParamSpec("P")

FIRMEST = 2.0
"""Squared phase of a joint that swings on its bristle, in a sub-step, from which it is softened."""
HARDLY = 1e-4
"""Slip, as a share of a bristle's length, that bends it in proportion."""
LEAST = 1e-30
"""Slip that is none."""

_TYPES = {
    Array: numba.float64[:, :],
    Mask: numba.boolean[:, :],
    Index: numba.int64[:, :],
    float: numba.float64,
}
"""Strides of any kind, so that a function is compiled once whatever arrays are views of."""


def _compile(make: Callable[..., Any], function: Callable[..., Any], *types: object) -> Any:
    """Compile, and keep the outcome for the next process where some folder can be written."""
    try:
        return make(*types, cache=True)(function)
    except (RuntimeError, OSError, EOFError):  # there is none, it is full, or was cut short
        return make(*types)(function)


def kernel(function: Callable[P, None]) -> Callable[P, None]:
    """Compile a function for the types that it names; divisions by zero are as in NumPy."""
    hints = get_type_hints(function)
    names = function.__code__.co_varnames[: function.__code__.co_argcount]
    signature = numba.void(*(_TYPES[hints[name]] for name in names))
    make = functools.partial(numba.njit, nogil=True, error_model="numpy")
    compiled: Callable[P, None] = _compile(make, function, signature)
    return compiled


def _implicit_share(damping: float, inertia: float, timestep: float) -> float:
    x = max(damping * (timestep / inertia), 1e-6)
    return -1 / math.expm1(-x) - 1 / x


implicit_share: np.ufunc = _compile(numba.vectorize, _implicit_share, ["f8(f8, f8, f8)"])
"""See `implicit.implicit_share`; of numbers, in the functions below, and of arrays."""


@kernel
def limit(
    torque: Array,
    damping: Array,
    velocity: Array,
    upper: Array,
    lower: Array,
    slope: Array,
    before: Array,
    acted: Array,
    damped: Array,
    share: Array,
    inertia: Array,
) -> None:
    """Keep servos within their limits; what falls with speed at a limit damps there.

    Whether a servo is at its limit is decided by the velocity that its damping meets in the
    sub-step, by each joint's own inertia and the torque from outside that the last one showed.
    Decided by the velocity that is, a servo would leave its limit with a jump of its torque, by
    what a sub-step changes of the damping, and trajectories would jump with whatever moves that
    moment past a sub-step's end. Stiff damping brakes within the sub-step: velocities that only go
    on as they did would mislead.

    Args:
      torque: of the law, N m; changed in place.
      damping: its viscous coefficient, N m s/rad; changed in place.
      velocity: rad/s.
      upper: largest torque, N m.
      lower: smallest one, N m.
      slope: by how much both fall with the velocity at the sub-step's end, N m s/rad.
      before: velocity at the last sub-step, rad/s.
      acted: torque over it, N m; NaN where there was none yet.
      damped: viscous coefficient over it, N m s/rad.
      share: of the law's damping that a sub-step takes implicitly.
      inertia: what a joint's torque accelerates, over the timestep, kg m²/s.
    """
    for i in range(velocity.shape[0]):
        for j in range(velocity.shape[1]):
            now, reach = velocity[i, j], share[i, j] / inertia[i, j]
            gained = now - before[i, j]
            met = gained * share[i, j] + before[i, j]  # by what was taken implicitly
            outside = gained * inertia[i, j] + damped[i, j] * met - acted[i, j]
            ahead = ((torque[i, j] + outside) * reach + now) / (reach * damping[i, j] + 1)
            if math.isnan(ahead):  # it starts: nothing is known of what is to come
                ahead = now
            total = torque[i, j] - damping[i, j] * ahead
            if not total < upper[i, j]:
                torque[i, j] = upper[i, j] + slope[i, j] * now
                damping[i, j] = slope[i, j]
            if not total > lower[i, j]:
                torque[i, j] = lower[i, j] + slope[i, j] * now
                damping[i, j] = slope[i, j]


@kernel
def blend(
    error: Array,
    torque: Array,
    damping: Array,
    old_error: Array,
    old_torque: Array,
    old_damping: Array,
    share: Array,
) -> None:
    """Let what a command asks for hold for a share of a sub-step, and what the old one did before.

    Args:
      error: rad; changed in place.
      torque: N m; changed in place.
      damping: N m s/rad; changed in place.
      old_error: by the old command, rad.
      old_torque: by it, N m.
      old_damping: by it, N m s/rad.
      share: of the sub-step.
    """
    for i in range(error.shape[0]):
        for j in range(error.shape[1]):
            now, then = share[i, j], 1 - share[i, j]
            error[i, j] = now * error[i, j] + then * old_error[i, j]
            torque[i, j] = now * torque[i, j] + then * old_torque[i, j]
            damping[i, j] = now * damping[i, j] + then * old_damping[i, j]


@kernel
def split(
    torque: Array,
    damping: Array,
    brake: Array,
    viscous: Array,
    velocity: Array,
    free: Array,
    free_share: Array,
    held: Array,
    held_share: Array,
    inertia: Array,
    timestep: Array,
) -> None:
    """Apply as it is what of a torque by damping a sub-step does not take implicitly.

    Args:
      torque: of the servos, N m; changed in place.
      damping: of the servos, N m s/rad; to what is taken implicitly, in place.
      brake: torque against the servos' by damping outside them, N m; written.
      viscous: damping outside the servos, N m s/rad; to what is taken implicitly, in place.
      velocity: rad/s.
      free: all damping where a servo is off its limit, N m s/rad.
      free_share: of it, to be taken implicitly.
      held: all damping where a servo is at its limit, N m s/rad.
      held_share: of it, to be taken implicitly.
      inertia: what a joint's torque accelerates, kg m².
      timestep: s.
    """
    for i in range(velocity.shape[0]):
        for j in range(velocity.shape[1]):
            total = damping[i, j] + viscous[i, j]
            if total == free[i, j]:  # as it mostly is, or the next, without exponentials
                share = free_share[i, j]
            elif total == held[i, j]:
                share = held_share[i, j]
            else:
                share = implicit_share(total, inertia[i, j], timestep[i, 0])
            rest = (1 - share) * velocity[i, j]
            torque[i, j] -= rest * damping[i, j]
            damping[i, j] *= share
            brake[i, j] = rest * viscous[i, j]
            viscous[i, j] *= share


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
                own[i, j] = position[i, j]
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


@kernel
def look_up(
    held: Array,
    told: Array,
    time: Array,
    commands: Array,
    times: Array,
    newest: Index,
    timestep: float,
) -> None:
    """What commands are held at some times, and since when; a row is a recording here.

    Args:
      held: what is, rad, (n_recordings, n_candidates * n_joints); written.
      told: since when, s; written.
      time: when, s; like `told` as many columns as `held`, or one for all joints of a candidate.
      commands: of all recordings, one after the other, (n_recordings * n_commands, n_joints), rad.
      times: since when they hold, (n_recordings, n_commands), s; infinite behind the last.
      newest: which was the newest at each sub-step, (n_recordings, n_steps).
      timestep: s.
    """
    joints, last = commands.shape[1], newest.shape[1] - 1
    width = held.shape[1] // time.shape[1]
    for i in range(time.shape[0]):
        for k in range(time.shape[1]):
            at = time[i, k]
            row = newest[i, min(max(int(at / timestep), 0), last)]
            if times[i, row + 1] <= at:
                row += 1
            told[i, k] = times[i, row]
            for c in range(k * width, (k + 1) * width):
                held[i, c] = commands[i * times.shape[1] + row, c % joints]
