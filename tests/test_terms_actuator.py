"""Motors and their laws against closed forms: what each effect does that a lab would look for."""

import numpy as np
import pytest
from terms import (
    AT,
    BENCH,
    FREE,
    KD,
    KP,
    LEG,
    LEG_POSE,
    LEVER,
    LIGHT,
    LIMIT,
    STEP,
    Array,
    G,
    bench,
    held,
    play,
    ramp,
    solved,
)
from test_simulator import recording


def away(**terms: float) -> tuple[Array, Array]:
    """A joint without load driven at its torque limit: time and positions."""
    time = np.arange(0, 0.5, STEP)
    run = recording(BENCH, time, np.full(len(time), 3.1), 0.0, setup=LIGHT)
    strong = {"kp/servo": 20.0, "kd/servo": 0.005, "tau_max/servo": 0.5}
    (read,) = bench(run, strong | {f"{k.replace('__', '/')}{AT}": v for k, v in terms.items()})
    return time, read


def test_the_square_of_the_speed_brakes_up_to_a_terminal_speed() -> None:
    """I v' = tau - c v²: the way is I / c ln cosh(t sqrt(tau c) / I)."""
    time, way = away(quadratic_damping__coefficient=0.03)
    expected = FREE / 0.03 * np.log(np.cosh(time * np.sqrt(0.5 * 0.03) / FREE))
    before = expected < 2.5  # then the limit lets go
    assert way[before] == pytest.approx(expected[before], abs=1e-3)


def test_back_emf_leaves_no_torque_at_a_terminal_speed() -> None:
    """I v' = tau - s v, with time constants of fifteen sub-steps and of one and a half."""
    for slope in (0.1, 1.0):
        time, way = away(torque_speed_limit__slope=slope)
        lag, top = FREE / slope, 0.5 / slope
        expected = top * (time - lag * (1 - np.exp(-time / lag)))
        before = expected < 2.5  # then the limit lets go
        assert way[before] == pytest.approx(expected[before], abs=1e-3)


@pytest.mark.parametrize("ramp", [0.0, 1e-4, 0.02, 0.1])
def test_a_rate_limit_makes_a_step_a_ramp_from_when_it_is_told(ramp: float) -> None:
    """Steady, the joint is late behind the ramp by kd / kp; the step comes between sub-steps."""
    time = np.array([0.0, 0.1003, *np.arange(0.11, 0.5, 0.01)])
    target = np.where(time > 0.05, 1.0, 0.0)
    run = recording(BENCH, time, target, setup=LIGHT)
    gradual = {
        f"target_rate_limit/{name}{AT}": value
        for name, value in (("slowness", 0.5), ("sluggishness", ramp / 2))
    }
    (read,) = bench(run, gradual)
    on = (time > 0.35) & (time < 0.45)
    expected = 2.0 * (time - 0.1003 - ramp / 2 - KD / KP)
    assert read[on] == pytest.approx(expected[on], abs=2e-4)
    assert bench(held(0.3, 2.0, 0.0, setup=LIGHT), {f"target_rate_limit/slowness{AT}": 0.5})[
        0, -1
    ] == pytest.approx(0.3, abs=1e-4)


def test_a_sagging_supply_weakens_all_joints_alike() -> None:
    """At rest torques are what gravity asks for: every error grows by 1 + drop sum |torque|."""
    run = recording(LEG, np.arange(0, 3, 0.02), np.tile(LEG_POSE, (150, 1)), LEG_POSE, "suspended")
    strong = {f"kp/{group}": 60.0 for group in LEG.groups}
    plain, weak = play(LEG, run, [strong, strong | {"voltage_sag/drop@bus": 0.2}]).position
    error, more = LEG_POSE - plain[-1], LEG_POSE - weak[-1]
    torque = 60 * np.abs(error).sum()
    loaded = np.abs(error) > 1e-3
    assert loaded.sum() >= 2 and torque > 0.3
    assert (more / error)[loaded] == pytest.approx(1 + 0.2 * torque, rel=5e-3)


def test_a_drifting_gain_sags_more_and_more() -> None:
    """Kp (1 - rate h) e = m g l sin q with h = T (1 - exp(-t / T)), and the joint follows."""
    run = held(0.5, 20.0)
    (read,) = bench(run, {f"thermal_drift/rate{AT}": 0.02, f"thermal_drift/time{AT}": 30.0})
    for k in (500, -1):
        lost = 0.02 * 30 * (1 - np.exp(-run.time[k] / 30))
        left = KP * (1 - lost) * (0.5 - read[k])
        assert left == pytest.approx(LEVER * G * np.sin(read[k]), rel=3e-3)


def test_a_winding_warms_by_what_it_carries() -> None:
    """The same with dh/dt = |tau| / limit - h / T, where tau is what gravity asks for."""
    run = held(0.5, 20.0)
    terms = {"rate": 0.1, "time": 5.0, "load": 1.0}
    (read,) = bench(run, {f"thermal_drift/{name}{AT}": value for name, value in terms.items()})
    carried = LEVER * G * np.sin(read[-1])
    left = KP * (1 - 0.1 * 5 * carried / LIMIT) * (0.5 - read[-1])
    assert left == pytest.approx(carried, rel=5e-3)


def test_an_asymmetric_gain_holds_one_side_stiffer() -> None:
    """Errors hold loads of either sign: kp (1 ± share) e = m g l sin q."""
    for angle, factor in ((0.5, 1.1), (-0.5, 0.9)):
        (read,) = bench(held(angle), {f"gain_asymmetry/share{AT}": 0.1})
        assert KP * factor * (angle - read[-1]) == pytest.approx(LEVER * G * np.sin(read[-1]))


def test_integral_action_creeps_to_no_error() -> None:
    """Slowly: what is left decays at gain / (kp + m g l cos q)."""
    run = held(0.5, 8.0)
    (read,) = bench(run, {f"integral_action/gain{AT}": 5.0})
    assert abs(0.5 - read[-1]) < 5e-3 * abs(0.5 - read[25])
    rate = -np.log((0.5 - read[150]) / (0.5 - read[100])) / 1.0
    assert rate == pytest.approx(5.0 / (KP + LEVER * G * np.cos(0.5)), rel=0.05)


def test_an_integral_that_has_held_a_load_starts_with_it() -> None:
    """A joint that a recording finds at rest stays; one that is sent off at once starts empty."""
    gain = {f"integral_action/gain{AT}": 5.0}
    stays, sags = bench(held(0.5), gain, {})
    assert np.abs(stays - 0.5).max() < 0.02 * np.abs(sags - 0.5).max()
    sagged = float(sags[-1])
    (halfway,) = bench(held(0.5, start=(0.5 + sagged) / 2), gain)
    assert abs(halfway[2] - halfway[0]) < 0.02 * abs(0.5 - sagged)
    sent, plain = bench(held(0.5, 0.2, start=0.0), gain, {})
    assert sent[1] == pytest.approx(plain[1], abs=1e-3)


def test_an_integral_does_not_wind_up_while_the_torque_is_off() -> None:
    """A joint that hangs down is sent off in the same way at once and after a second without."""
    gain = {f"integral_action/gain{AT}": 15.0}
    (at_once,) = bench(held(0.5, 1.0, 0.0), gain)
    off = {"torque_enabled": (np.arange(100) >= 50).astype(float)}
    (later,) = bench(held(0.5, 2.0, 0.0, extras=off), gain)
    assert np.abs(later[50:] - at_once).max() < 1e-3


def test_a_lasting_integral_does() -> None:
    """The joint is sent off with all that a second of errors has made of it."""
    lasting = f"integral_action/lasting{AT}"
    row = {f"integral_action/gain{AT}": 1.0, lasting: 1.0}
    off = {"torque_enabled": (np.arange(100) >= 50).astype(float)}
    forgets, lasts = bench(held(0.5, 2.0, 0.0, extras=off), {**row, lasting: 0.0}, row)
    assert (lasts[53:60] > forgets[53:60] + 0.01).all()
    assert np.abs(lasts[:50] - forgets[:50]).max() == 0.0


def test_a_dead_band_adds_its_width_to_every_error() -> None:
    for angle in (0.5, -0.5):
        (read,) = bench(held(angle), {f"dead_band/width{AT}": 0.01})
        error = abs(angle - read[-1])
        assert KP * (error - 0.01) == pytest.approx(LEVER * G * np.sin(abs(read[-1])), abs=1e-6)


def test_cogging_has_its_period() -> None:
    """On a slow ramp, by position: of 24 teeth the ripple comes every 2 pi / 24."""
    run = ramp(0.2, 0.0, 5.0, setup=LIGHT)
    (read,) = bench(run, {f"cogging/sine{AT}": 0.03, f"cogging/teeth{AT}": 24.0})
    ripple = KP * (run.target[:, 0] - read) - KD * np.gradient(read, STEP)
    late = run.time > 0.5
    fit = np.stack([np.sin(24 * read[late]), np.cos(24 * read[late])], axis=1)
    (sine, cosine), *_ = np.linalg.lstsq(fit, ripple[late], rcond=None)
    assert (sine, cosine) == (pytest.approx(-0.03, rel=0.02), pytest.approx(0.0, abs=2e-3))


@pytest.mark.parametrize("time", [0.004, 0.008, 0.03])
def test_a_lag_behind_a_stiff_law_at_its_limit_moves_as_its_equation_says(time: float) -> None:
    """Its damping stops the joint within a sub-step, and goes on doing so at the torque limit."""
    kp, kd, limit, rotor = 20.0, 0.5, 1.2, 3e-4
    run = held(3.0, 0.6, 0.0, setup=LIGHT)
    own = {"kp/servo": kp, "kd/servo": kd, "tau_max/servo": limit, "armature": rotor}
    read = play(BENCH, run, [own | {f"actuator_lag/time{AT}": time}]).position[0, :, 0]

    def lagging(t: float, x: Array, target: float) -> tuple[float, list[float]]:
        q, v, driven = x
        asked = np.clip(kp * (target - q) - kd * v, -limit, limit) + kd * v
        return driven - kd * v, [(asked - driven) / time]

    known = solved(run, lagging, limit, inertia=rotor + 1e-7)
    before = known < 2.5  # then the joint's own end holds it
    assert np.isfinite(read).all() and before.sum() > 4
    assert np.abs(read - known)[before].max() < 0.05
