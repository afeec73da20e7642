"""Every effect on one joint against an independent integrator with its equation."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from terms import (
    BENCH,
    INERTIA,
    SERVO,
    Array,
    G,
    Law,
    Row,
    bench,
    held,
    servo,
    solved,
    steps,
    weight,
)

from pup.physics.terms.friction import GRIP, RESTED
from pup.physics.terms.transmission import RELAXATION

RUN = steps(BENCH, np.zeros(1), 1.6, "bench")
KP, KD, LIMIT = SERVO["kp/servo"], SERVO["kd/servo"], SERVO["tau_max/servo"]
ROTOR = SERVO["armature"]
FIRST = servo(float(RUN.target[0, 0]), 0.0)
"""Torque that the servo gave before the recording began: it stood, with its first target."""


def bristle(v: float, z: float, length: float = GRIP) -> float:
    """Rate of a bristle's deflection (Dahl)."""
    return v - abs(v) * z / length


def plain(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    return servo(target - x[0], x[1]) + weight(x[0]), ()


def viscous_square(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    q, v = x
    return servo(target - q, v) + weight(q) - 0.04 * v * abs(v), ()


def back_emf(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    q, v = x
    torque = np.clip(KP * (target - q) - KD * v, -LIMIT - 0.3 * v, LIMIT - 0.3 * v)
    return torque + weight(q), ()


def drifting(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    left = 1 - 0.05 * 40 * -np.expm1(-t / 40)
    torque = np.clip(KP * left * (target - x[0]) - KD * x[1], -LIMIT * left, LIMIT * left)
    return torque + weight(x[0]), ()


def lopsided(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    error = target - x[0]
    return servo(error * (1.2 if error > 0 else 0.8), x[1]) + weight(x[0]), ()


def integrating(share: float) -> Law:
    """An integral that winds up as far as a share of the limit."""

    def law(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
        q, v, total = x
        most = share * LIMIT / 15
        asked = KP * (target - q) + 15 * np.clip(total, -most, most) - KD * v
        full = abs(total) >= most and total * (target - q) > 0
        return np.clip(asked, -LIMIT, LIMIT) + weight(q), [0.0 if full else target - q]

    return law


def warming(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    q, v, warmth = x
    left = 1 - 2 * warmth
    torque = np.clip(left * (KP * (target - q) - KD * v), -LIMIT * left, LIMIT * left)
    return torque + weight(q), [abs(torque) / LIMIT - warmth / 5]


def kicked(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    q, v, goal = x
    rate = (target - goal) / 0.02
    return np.clip(KP * (target - q) + 0.05 * rate - KD * v, -LIMIT, LIMIT) + weight(q), [rate]


def dead(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    error = target - x[0]
    return servo(np.sign(error) * max(abs(error) - 0.01, 0), x[1]) + weight(x[0]), ()


def rippling(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    ripple = 0.03 * np.sin(24 * x[0]) + 0.02 * np.cos(24 * x[0])
    return servo(target - x[0], x[1]) + weight(x[0]) + ripple, ()


def sprung(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    return servo(target - x[0], x[1]) + weight(x[0]) + 0.1 - 0.4 * x[0], ()


def stopped(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    q, v = x
    push = max(20 * (q - 0.05 + (RELAXATION + 0.01) * v), 0) if q > 0.05 else 0.0
    return servo(target - q, v) + weight(q) - push, ()


def coulomb(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    q, v, z = x
    return servo(target - q, v) + weight(q) - 0.08 * z / GRIP, [bristle(v, z)]


def stribeck(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    q, v, z = x
    level = 0.05 + 0.06 * np.exp(-abs(v) / 0.5)
    return servo(target - q, v) + weight(q) - level * z / GRIP, [bristle(v, z)]


def rising(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    q, v, z, age = x
    level = 0.05 + 0.06 * age / (age + 0.1)
    rub = level * z / GRIP
    return servo(target - q, v) + weight(q) - rub, [bristle(v, z), 1 - abs(v) * age / 0.03]


def presliding(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    q, v, z = x
    return servo(target - q, v) + weight(q) - 0.08 * z / 0.008, [bristle(v, z, 0.008)]


def one_sided(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    q, v, z = x
    torque = servo(target - q, v) + weight(q) - 0.05 * max(v, 0)
    return torque - 0.04 * max(z, 0) / GRIP, [bristle(v, z)]


def by_load(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    q, v, z = x
    motor, slip = servo(target - q, v), 0.15 * z / GRIP
    # The load is |2 motor - rotor acceleration|, and brakes the acceleration: try either sign.
    for sign in (1, -1):
        torque = (motor + weight(q) - sign * slip * 2 * motor) / (1 - sign * slip * ROTOR / INERTIA)
        if sign * (2 * motor - ROTOR * torque / INERTIA) >= 0:
            break
    return torque, [bristle(v, z)]


def lossy(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    q, v, z = x
    motor = servo(target - q, v)
    return motor + weight(q) - 0.2 * abs(motor) * z / GRIP, [bristle(v, z)]


def lagging(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    q, v, torque = x
    return torque - KD * v + weight(q), [(servo(target - q, v) + KD * v - torque) / 0.008]


def lagging_twice(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    q, v, torque, first = x
    asked = servo(target - q, v) + KD * v
    return torque - KD * v + weight(q), [(first - torque) / 0.004, (asked - first) / 0.004]


def sagging(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    q, v, left = x
    torque = np.clip(KP * left * (target - q) - KD * v, -LIMIT * left, LIMIT * left)
    return torque + weight(q), [(1 / (1 + 0.1 * abs(torque)) - left) / 0.02]


def biased(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    return servo(target - x[0] - 0.03, x[1]) + weight(x[0]), ()


def off(position: float) -> float:
    return float(0.02 * np.sin(position) - 0.01 * np.cos(position))


def eccentric(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    return servo(target - x[0] - off(x[0]), x[1]) + weight(x[0]), ()


def blown(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    """A force along x turns the load about y towards negative angles, along z it lifts it."""
    torque = -0.1 * np.cos(x[0]) * 1.0 + 0.1 * np.sin(x[0]) * 0.5
    return servo(target - x[0], x[1]) + weight(x[0]) + torque, ()


def heavier(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    return servo(target - x[0], x[1]) + weight(x[0]) * (0.3247 + 0.1) / 0.3247, ()


def springy(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    """Of two masses; the encoder is at the link, the servo's damping at the motor."""
    q, v, motor, speed = x
    bend = (motor - q + RELAXATION * (speed - v)) / 0.02
    return bend + weight(q), [speed, (servo(target - q, speed) - bend) / ROTOR]


LINK = INERTIA - ROTOR
AT = "@joint:servo"
# Columns, the law, its further states at the start, the link's inertia, bound on the rms, rad.
CASES: dict[str, tuple[Row, Law, Sequence[float], float, float]] = {
    "nothing": ({}, plain, (), INERTIA, 1e-4),
    "quadratic_damping": ({"coefficient": 0.04}, viscous_square, (), INERTIA, 1e-4),
    "torque_speed_limit": ({"slope": 0.3}, back_emf, (), INERTIA, 1e-4),
    "thermal_drift": ({"rate": 0.05}, drifting, (), INERTIA, 1e-4),
    "gain_asymmetry": ({"share": 0.2}, lopsided, (), INERTIA, 1e-4),
    "integral_action": ({"gain": 15.0}, integrating(0.3), (0.0,), INERTIA, 1e-4),
    "integral_action, all of the limit": (
        {"gain": 15.0, "share": 1.0},
        integrating(1.0),
        (0.0,),
        INERTIA,
        1e-4,
    ),
    "thermal_drift, by load": (
        {"rate": 2.0, "load": 1.0, "time": 5.0},
        warming,
        (0.0,),
        INERTIA,
        2e-4,
    ),
    "derivative_kick": (
        {"gain": 0.05, "time": 0.02},
        kicked,
        (float(RUN.target[0, 0]),),
        INERTIA,
        1e-3,
    ),
    "dead_band": ({"width": 0.01}, dead, (), INERTIA, 1e-4),
    "cogging": ({"sine": 0.03, "cosine": 0.02, "teeth": 24.0}, rippling, (), INERTIA, 1e-4),
    "joint_spring": ({"stiffness": 0.4, "preload": 0.1}, sprung, (), INERTIA, 1e-4),
    "joint_stop": ({"stiffness": 20.0, "angle": 0.05, "loss": 0.01}, stopped, (), INERTIA, 1e-4),
    "coulomb_friction": ({"torque": 0.08}, coulomb, (0.0,), INERTIA, 2e-4),
    "stribeck_friction": (
        {"torque": 0.05, "rest": 0.06, "speed": 0.5},
        stribeck,
        (0.0,),
        INERTIA,
        4e-4,
    ),
    "rising_static_friction": (
        {"torque": 0.05, "rise": 0.06, "time": 0.1, "slip": 0.03},
        rising,
        (0.0, RESTED),
        INERTIA,
        4e-4,
    ),
    "presliding_hysteresis": (
        {"torque": 0.08, "deflection": 0.008},
        presliding,
        (0.0,),
        INERTIA,
        1e-4,
    ),
    "friction_asymmetry": ({"torque": 0.04, "viscous": 0.05}, one_sided, (0.0,), INERTIA, 2e-4),
    "load_dependent_friction": ({"share": 0.15}, by_load, (0.0,), INERTIA, 7e-4),
    "gear_efficiency": ({"loss": 0.2}, lossy, (0.0,), INERTIA, 4e-4),
    "actuator_lag": ({"time": 0.008}, lagging, (FIRST,), INERTIA, 2e-4),
    "actuator_lag, in two stages": (
        {"time": 0.008, "stages": 2.0},
        lagging_twice,
        (FIRST, FIRST),
        INERTIA,
        4e-4,
    ),
    "voltage_sag": ({"drop": 0.1}, sagging, (1.0,), INERTIA, 1e-4),
    "armature": ({"inertia": 0.002}, plain, (), INERTIA + 0.002, 1e-4),
    "payload": ({"mass": 0.1}, heavier, (), INERTIA + 0.1 * 0.01, 1e-4),
    "external_force": ({"x": 1.0, "z": 0.5}, blown, (), INERTIA, 1e-4),
    "joint_compliance": ({"compliance": 0.02}, springy, (0.0, 0.0), LINK, 2e-4),
}
PLACES = {"voltage_sag": "@bus", "payload": "@body:load", "external_force": "@body:load"}


@pytest.fixture(scope="module")
def replayed() -> dict[str, Array]:
    """All cases in one batch: their rows are of no concern to each other."""
    rows = [
        {f"{case.split(',')[0]}/{name}{PLACES.get(case, AT)}": v for name, v in values.items()}
        for case, (values, *_) in CASES.items()
    ]
    return dict(zip(CASES, bench(RUN, *rows), strict=True))


@pytest.mark.parametrize("effect", CASES)
def test_a_joint_moves_as_its_equation_says(effect: str, replayed: dict[str, Array]) -> None:
    _, law, further, inertia, bound = CASES[effect]
    error = replayed[effect] - solved(RUN, law, *further, inertia=inertia)
    assert np.sqrt(np.mean(error**2)) < bound
    moved = np.abs(replayed[effect] - replayed["nothing"]).max()
    assert effect == "nothing" or moved > 1e-3, "a case that shows nothing proves nothing"


def test_encoders_that_are_off_are_off_in_the_loop_and_in_what_is_read() -> None:
    """The robot starts where the first reading says, corrected by what is off."""
    bias, eccentricity = bench(
        RUN,
        {f"encoder_bias/offset{AT}": 0.03},
        {f"encoder_eccentricity/sine{AT}": 0.02, f"encoder_eccentricity/cosine{AT}": -0.01},
    )
    for read, law, wrong in ((bias, biased, lambda q: 0.03), (eccentricity, eccentric, off)):
        assert read[0] == pytest.approx(0.0, abs=1e-5)
        start = 0.0
        for _ in range(5):
            start = -wrong(start)
        true = solved(replace(RUN, position=np.full_like(RUN.position, start)), law)
        told = true + np.array([wrong(q) for q in true])
        assert np.sqrt(np.mean((read - told) ** 2)) < 1e-4


def test_a_centre_of_mass_beside_the_arm_pulls_all_the_time() -> None:
    """Moved along x, gravity's moment has its zero elsewhere: kp e = m g (l sin q + d cos q)."""
    (rest,) = bench(held(0.4), {"com_offset/x@body:load": 0.02})
    pull = 0.3247 * G * (0.1 * np.sin(rest[-1]) - 0.02 * np.cos(rest[-1]))
    assert KP * (0.4 - rest[-1]) == pytest.approx(pull, abs=1e-6)
