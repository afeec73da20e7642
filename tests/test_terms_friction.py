"""Friction against closed forms: what it does at rest, sliding and under load."""

import numpy as np
import pytest
from scipy.optimize import brentq
from terms import (
    AT,
    BENCH,
    FREE,
    KD,
    KP,
    LIGHT,
    STEP,
    Array,
    G,
    bench,
    held,
    ramp,
)
from test_simulator import recording

from pup.physics.terms.friction import GRIP


def sliding(speed: float) -> Array:
    """A joint that is let go at some speed, without load or torque."""
    time = np.arange(0, 0.6, STEP)
    extras = {
        "torque_enabled": np.zeros(len(time)),
        "velocity/servo": np.full(len(time), speed),
    }
    run = recording(BENCH, time, np.zeros(len(time)), 0.0, extras=extras, setup=LIGHT)
    return bench(run, {f"coulomb_friction/torque{AT}": 0.05})[0]


def test_a_sliding_joint_stops_after_its_energy_is_spent() -> None:
    """Half I v² over the friction torque, and then it stays."""
    way = sliding(2.0)
    assert way[-1] == pytest.approx(FREE * 2.0**2 / 2 / 0.05, abs=2 * GRIP)
    assert np.ptp(way[-100:]) < 1e-5


@pytest.mark.parametrize("speed", [0.2, -0.2])
def test_friction_makes_a_slow_ramp_late_by_its_level(speed: float) -> None:
    """At constant speed, kp e - kd v is friction: Coulomb's, Stribeck's at that speed."""
    run = ramp(speed, 0.0, 1.5, setup=LIGHT)
    coulomb, stribeck, forward = bench(
        run,
        {f"coulomb_friction/torque{AT}": 0.1},
        {
            f"stribeck_friction/torque{AT}": 0.05,
            f"stribeck_friction/rest{AT}": 0.06,
            f"stribeck_friction/speed{AT}": 0.5,
        },
        {f"friction_asymmetry/torque{AT}": 0.04, f"friction_asymmetry/viscous{AT}": 0.1},
    )
    error = run.target[-1, 0]
    for read, level in (
        (coulomb, 0.1),
        (stribeck, 0.05 + 0.06 * np.exp(-0.4)),
        (forward, 0.04 + 0.1 * speed if speed > 0 else 0.0),
    ):
        braked = KP * (error - read[-1]) * np.sign(speed) - KD * abs(speed)
        assert braked == pytest.approx(level, abs=1e-4 + 2e-4 * KP)


def test_friction_holds_up_to_its_level_at_rest() -> None:
    """Steady errors below level / kp stay; of Stribeck friction the level at rest counts."""
    stribeck = {
        f"stribeck_friction/torque{AT}": 0.05,
        f"stribeck_friction/rest{AT}": 0.06,
        f"stribeck_friction/speed{AT}": 0.5,
    }
    for level, row in ((0.1, {f"coulomb_friction/torque{AT}": 0.1}), (0.11, stribeck)):
        for share, stays in ((0.8, True), (1.2, False)):
            start = share * level / KP
            (read,) = bench(held(0.0, 2.0, start, setup=LIGHT), row)
            assert (abs(read[-1] - start) < 8 * GRIP) == stays
            assert abs(read[-1] - read[20]) < 1e-5 or not stays  # no creep
            assert abs(KP * read[-1]) < level


def test_what_holds_a_joint_at_rest_does_not_depend_on_the_batch() -> None:
    """Of several terms that could hold, those that a simulation lacks hold nothing."""
    run = held(0.0, 1.0, 0.016, setup=LIGHT)
    rows = [
        {f"coulomb_friction/torque{AT}": 0.1},
        {f"stribeck_friction/torque{AT}": 0.1},
        {f"integral_action/gain{AT}": 5.0},
        {f"integral_action/gain{AT}": 5.0, f"stribeck_friction/torque{AT}": 0.1},
    ]
    for row, together in zip(rows, bench(run, *rows), strict=True):
        assert np.array_equal(bench(run, row)[0], together)


def test_presliding_is_a_spring_that_yields() -> None:
    """A virgin branch of Dahl's curve: kp (target - q) = level (1 - exp(-q / deflection))."""
    time = np.arange(0, 3, 0.02)
    target = np.minimum(time, 1.0) * 0.02
    row = {
        f"presliding_hysteresis/torque{AT}": 0.1,
        f"presliding_hysteresis/deflection{AT}": 0.01,
    }
    (read,) = bench(recording(BENCH, time, target, setup=LIGHT), row)
    rest = brentq(lambda q: KP * (0.02 - q) - 0.1 * (1 - np.exp(-q / 0.01)), 0, 0.02)
    assert read[-1] == pytest.approx(rest, abs=2e-5)


@pytest.mark.parametrize("mass", [0.2, 0.4])
@pytest.mark.parametrize("speed", [0.05, -0.05])
def test_a_loaded_gear_costs_torque_going_up_and_saves_it_going_down(
    mass: float, speed: float
) -> None:
    """Friction of a share of what the gear takes and passes on, or of the motor's torque alone."""
    run = ramp(speed, 0.6, 2.0, setup={"mass": mass})
    by_load, lossy = bench(
        run, {f"load_dependent_friction/share{AT}": 0.2}, {f"gear_efficiency/loss{AT}": 0.2}
    )
    up = np.sign(speed)
    for read, factor in (
        (by_load, 1 / (1 - up * 0.4)),
        (lossy, 1 / (1 - up * 0.2)),
    ):
        motor = KP * (run.target[-1, 0] - read[-1]) - KD * speed
        load = mass * G * 0.1 * np.sin(read[-1])
        assert motor == pytest.approx(load * factor, abs=5e-3 * load)


@pytest.mark.parametrize(("rested", "holds"), [(0.1, False), (10.0, True)])
def test_friction_that_rises_at_rest_holds_later_what_it_did_not_at_first(
    rested: float, holds: bool
) -> None:
    """It has risen by a / (a + time) after a rest of a: from a third of its rise to 0.79."""
    row = {
        f"rising_static_friction/{name}{AT}": value
        for name, value in (("torque", 0.01), ("rise", 0.016), ("time", 3.0), ("slip", 0.03))
    }
    time = np.arange(0, rested + 1, 0.02)
    target = np.clip((time - rested) / 0.5, 0, 1) * (0.01 + 0.5 * 0.016) / KP
    (read,) = bench(recording(BENCH, time, target, setup=LIGHT), row)
    assert (abs(read[-1]) < 4 * GRIP) == holds
