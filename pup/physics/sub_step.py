"""What happens in a sub-step of robots of one joint, in the order of `servo.Servos`, compiled.

Arrays have one column; the first simulations are active. Terms are the tuples of their parts, empty
where there is none: of dry friction its bristle, its level, then what that depends on.
"""

import math

import numpy as np

from pup.physics import kernels
from pup.physics.kernels import Array, Index, Mask, part
from pup.physics.terms import kernels as laws
from pup.physics.terms.base import Parts

Terms = tuple[Parts, ...]


@part
def there(term: Parts) -> bool:
    """Whether a term is."""
    return len(term[0]) > 0


@part
def differs(values: Array | Mask, usual: float) -> bool:
    """Whether any is not as usual."""
    some = False
    for i in range(len(values)):
        some |= values[i, 0] != usual
    return some


@part
def sense(sensed: Parts, link: Parts, train: Parts, bias: Parts, eccentricity: Parts) -> None:
    """What encoders tell of the links; see Servos.sense."""
    told, felt = sensed
    told[:], felt[:] = link[0], link[1]
    if there(train):
        laws.follow(told, felt, link[0], link[1], *train[:13])
    if there(bias):
        laws.shift(told, *bias)
    if there(eccentricity):
        laws.ripple(told, told, *eccentricity)


@part
def on_time(
    target: Parts, step: int, candidates: int, commands: Parts, found: tuple[Index, ...]
) -> None:
    """Targets that arrive at once; see Commands.on_time.

    Args:
      target: the one at the sub-step's end, the one before, and for which share the first holds;
        written.
      step: the sub-step.
      candidates: of each recording.
      commands: see Commands.tables, like the next.
      found: where they stand.
    """
    now, before, share = target
    flat, _, shares = commands
    for i in range(len(now)):
        recording = i // candidates
        now[i, 0] = flat[found[0][step, recording], 0]
        before[i, 0] = flat[found[1][step, recording], 0]
        share[i, 0] = 1.0 if now[i, 0] == before[i, 0] else shares[step, recording]


@part
def late(
    target: Parts,
    step: int,
    recordings: int,
    timestep: float,
    time: float,
    commands: Parts,
    newest: Index,
    delays: Parts,
) -> None:
    """Targets that arrive late; see Commands.late.

    Args:
      target: see `on_time`.
      step: the sub-step.
      recordings: that have not ended.
      timestep: s.
      time: by which clocks drift, s.
      commands: see Commands.tables.
      newest: see there.
      delays: two of commands, s, and the share by which clocks go slow; empty for none.
    """
    now, before, share = target
    candidates = len(now) // recordings
    held = np.empty((5, recordings, candidates))
    for i in range(len(now)):
        lateness = 0.0
        for delay in delays[:2]:
            lateness += delay[i, 0] if len(delay) > 0 else 0.0
        lateness -= time * delays[2][i, 0] if len(delays[2]) > 0 else 0.0
        row, column = i // candidates, i % candidates
        held[3, row, column] = (step - 0.5) * timestep - lateness
        held[4, row, column] = (step + 0.5) * timestep - lateness
    kernels.look_up(
        held[0],
        held[1],
        held[2],
        held[3],
        held[4],
        commands[0],
        commands[1],
        newest,
        timestep,
    )
    for i in range(len(now)):
        row, column = i // candidates, i % candidates
        now[i, 0], before[i, 0] = held[0, row, column], held[1, row, column]
        share[i, 0] = held[2, row, column]


@part
def switch(on: Array, step: int, shift: float, candidates: int, power: Array, skew: Array) -> None:
    """Share of a sub-step with the torque on; see Servos._on.

    Args:
      on: written.
      step: the sub-step.
      shift: time by which clocks drift, sub-steps.
      candidates: of each recording.
      power: share of the torque, shape (n_steps, n_recordings).
      skew: share by which clocks go slow; empty for none.
    """
    last = len(power) - 1
    for i in range(len(on)):
        recording = i // candidates
        if len(skew) == 0:
            on[i, 0] = power[step, recording]
            continue
        at = step + shift * skew[i, 0]
        cell = math.floor(at)
        now = power[min(max(cell, 0), last), recording]
        after = power[min(max(cell + 1, 0), last), recording]
        on[i, 0] = now + (at - cell) * (after - now)


@part
def answer(
    answered: Parts, room: Parts, target: Array, sensed: Parts, law: Parts, terms: Terms
) -> None:
    """The law's answer to one target; see Servos._answer.

    Args:
      answered: error, torque, viscous coefficient and the law's own; written.
      room: for the limits.
      target: rad.
      sensed: positions and velocities.
      law: see Loop.
      terms: that act on it.
    """
    error, torque, damping, own = answered
    upper, lower, slope = room
    told, felt = sensed
    band, asymmetry, integral, kick, drift, supply, speed = terms
    for i in range(len(error)):
        error[i, 0] = target[i, 0] - told[i, 0]
    if there(band):
        laws.forgive(error, *band)
    for i in range(len(error)):
        torque[i, 0], damping[i, 0] = law[0][i, 0] * error[i, 0], law[1][i, 0]
        upper[i, 0], lower[i, 0], slope[i, 0] = law[2][i, 0], law[3][i, 0], 0.0
    if there(asymmetry):
        laws.favour(torque, error, *asymmetry)
    if there(integral):
        gain, total, _, least, most, step = integral
        laws.integrate(torque, error, gain, total, least, most, step)
    if there(kick):
        laws.kick(torque, kick[0], kick[3])
    if there(drift):
        laws.weaken(torque, damping, upper, lower, *drift[:3])
    if there(supply):
        laws.dim(torque, upper, lower, supply[0])
    if there(speed):
        laws.outrun(upper, lower, slope, felt, *speed)
    own[:] = damping
    kernels.limit(torque, damping, felt, upper, lower, slope, *law[4:9])


@part
def settle(error: Array, torque: Array, on: Array, time: float, terms: Terms) -> None:
    """Let terms take note of what a sub-step has come to; see Term.settle."""
    integral, drift, supply = terms
    if there(integral):
        _, total, lasting, least, most, step = integral
        laws.add_up(total, error, on, lasting, least, most, step)
    if there(drift) and time >= 0:
        warmth, _, load, heat, cooling, step = drift
        laws.warm(warmth, torque, load, heat, cooling, step)
    if there(supply):
        left, drop, kept = supply
        laws.sag(left, torque, drop, kept)


@part
def rub(acted: Parts, motion: Parts, friction: Parts) -> None:
    """Dry friction, whose level has been told; see terms.friction.Friction."""
    bend, length, inertia, step, level = friction[:5]
    laws.rub(acted[0], acted[1], bend, motion[1], motion[2], level, length, inertia, step)


@part
def flow(acted: Parts, motion: Parts, link: Parts, own: Array, terms: Terms) -> None:
    """What reaches the link; see Term.flow.

    Args:
      acted: torque, damping, brake and viscous coefficient; changed in place.
      motion: angle, velocity and coming velocity of what they move; changed in place.
      link: position and velocity of it.
      own: the law's own damping.
      terms: that act on them.
    """
    torque, damping, brake, viscous = acted
    angle, velocity, coming = motion
    position, speed = link
    lag, gear, load, coulomb, stribeck, rising, presliding, one_way, drag, cogging = terms[:10]
    train, spring, stop = terms[10:]
    if there(lag):
        laws.lag(torque, damping, velocity, own, *lag[:8])
        laws.lag(torque, damping, velocity, own, *lag[:4], *lag[8:])
    if there(gear):
        laws.carried(gear[4], torque, damping, coming, gear[5])
        rub(acted, motion, gear)
    if there(load):
        laws.passed(load[4], torque, damping, velocity, coming, *load[5:])
        rub(acted, motion, load)
    if there(coulomb):
        rub(acted, motion, coulomb)
    if there(stribeck):
        laws.stribeck(stribeck[4], velocity, *stribeck[5:])
        rub(acted, motion, stribeck)
    if there(rising):
        laws.rising(rising[4], rising[5], velocity, *rising[6:])
        rub(acted, motion, rising)
    if there(presliding):
        rub(acted, motion, presliding)
    if there(one_way):
        laws.one_way(one_way[4], damping, velocity, one_way[0], *one_way[5:])
        rub(acted, motion, one_way)
    if there(drag):
        laws.drag(damping, velocity, *drag)
    if there(cogging):
        laws.ripple(torque, angle, *cogging)
    if there(train):
        before = train[21]
        for i in range(len(position)):
            now = speed[i, 0]
            angle[i, 0], velocity[i, 0], coming[i, 0] = position[i, 0], now, 2 * now - before[i, 0]
            before[i, 0] = now
        laws.engage(torque, damping, brake, viscous, position, speed, *train[:6], *train[13:21])
    if there(spring):
        laws.pull(torque, position, *spring)
    if there(stop):
        laws.block(torque, damping, position, velocity, *stop)
