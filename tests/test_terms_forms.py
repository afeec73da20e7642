"""Effects against closed forms: what each does that a lab would look for."""

import numpy as np
import pytest
from scipy.optimize import brentq
from terms import (
    BENCH,
    INERTIA,
    LEG,
    LEG_POSE,
    LEVER,
    LIGHT,
    SERVO,
    Array,
    G,
    bench,
    held,
    play,
    ramp,
    sizes,
    solved,
    steps,
)
from test_simulator import recording

from pup.physics.terms import Place
from pup.physics.terms.friction import GRIP

KP, KD, LIMIT = SERVO["kp/servo"], SERVO["kd/servo"], SERVO["tau_max/servo"]
AT = "@joint:servo"
STEP = BENCH.timestep
FREE = 1.3e-6 + SERVO["armature"]  # kg m², without the load


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


@pytest.mark.parametrize("angle", [0.5, -0.5])
def test_play_is_lost_where_the_load_turns_and_where_the_encoder_is_not_behind_it(
    angle: float,
) -> None:
    """Gravity pulls the link to the far side of its play; a motor's encoder does not see it."""
    gap = 0.02
    motor, link, plain = bench(
        held(angle),
        {f"backlash/gap{AT}": gap, f"backlash/behind{AT}": 0.0},
        {f"backlash/gap{AT}": gap, f"backlash/behind{AT}": 1.0},
        {},
    )
    hangs = motor[-1] - np.sign(angle) * gap
    assert KP * (angle - motor[-1]) == pytest.approx(LEVER * G * np.sin(hangs), abs=1e-6)
    assert link[-1] == pytest.approx(plain[-1], abs=1e-6)


def test_an_encoder_behind_the_play_sees_it_rattle_through() -> None:
    """Where gravity changes sides, the motor first runs through the play: the link waits."""
    gap = 0.05
    run = ramp(0.2, -0.3, 3.0)
    behind, plain = bench(run, {f"backlash/gap{AT}": gap}, {})
    late = plain - behind
    rising = run.time > 0.5
    assert np.abs(late[rising & (run.target[:, 0] < -0.05)]).max() < 1e-3
    assert np.abs(late).max() > 2e-3


@pytest.mark.parametrize("effect", ["joint_compliance", "structural_flex"])
def test_what_gives_bends_by_its_torque(effect: str) -> None:
    """The link hangs compliance times torque behind a motor whose encoder does not see it."""
    give = 0.05
    place = "body:arm" if effect == "structural_flex" else "joint:servo"
    row = {f"{effect}/compliance@{place}": give}
    if effect == "joint_compliance":
        row[f"joint_compliance/behind@{place}"] = 0.0
    motor, plain = bench(held(0.5), row, {})
    torque = KP * (0.5 - motor[-1])
    assert torque == pytest.approx(LEVER * G * np.sin(motor[-1] - give * torque), abs=1e-6)
    assert torque < KP * (0.5 - plain[-1]), "hanging lower, it weighs less"


def test_play_and_give_of_one_joint_are_in_series() -> None:
    """Of three in one joint, an encoder at the motor sees none and one behind play sees that."""
    gap, give, flex = 0.02, 0.03, 0.02
    row = {
        f"backlash/gap{AT}": gap,
        f"backlash/behind{AT}": 1.0,
        f"joint_compliance/compliance{AT}": give,
        f"joint_compliance/behind{AT}": 0.0,
        "structural_flex/compliance@body:arm": flex,
    }
    (read,) = bench(held(0.5), row)
    torque = KP * (0.5 - read[-1])
    link = read[-1] - (give + flex) * torque
    assert torque == pytest.approx(LEVER * G * np.sin(link), abs=1e-6)


@pytest.mark.parametrize("behind", [0.0, 1.0])
@pytest.mark.parametrize(
    ("effect", "size"), [("backlash", "gap"), ("joint_compliance", "compliance")]
)
def test_next_to_no_play_or_give_is_none(effect: str, size: str, behind: float) -> None:
    """The rotor's inertia goes back to the link."""
    run = steps(BENCH, np.zeros(1), 1.5, "bench")
    row = {f"{effect}/{size}{AT}": 1e-6, f"{effect}/behind{AT}": behind}
    read, plain = bench(run, row, {})
    assert np.abs(read - plain).max() < 2e-4


def test_more_rotor_swings_slower_and_a_stop_stops() -> None:
    time = np.arange(2500) * STEP
    off = {"torque_enabled": np.zeros(len(time))}
    run = recording(BENCH, time, np.zeros(len(time)), 0.05, extras=off)
    swing, stop = bench(
        run,
        {f"armature/inertia{AT}": 0.004},
        sizes("joint_stop", Place("joint", "servo"), stiffness=300.0, angle=-0.02, side=-1.0),
    )
    period = 2 * np.pi * np.sqrt((INERTIA + 0.004) / (LEVER * G)) * (1 + 0.05**2 / 16)
    downward = np.flatnonzero((swing[:-1] > 0) & (swing[1:] <= 0))
    crossing = time[downward] + STEP * swing[downward] / (swing[downward] - swing[downward + 1])
    assert np.diff(crossing) == pytest.approx(period, rel=3e-4)
    assert -0.026 < stop.min() < -0.02


def test_late_commands_and_late_readings_are_shifts() -> None:
    """By any time: of commands the run is that of later ones, of readings that of earlier times."""
    time = np.arange(0, 1, STEP)
    target = np.where(time > 0.3, 0.4, 0.0)
    run = recording(BENCH, time, target)
    late, read, plain, read_late = bench(
        run,
        {f"command_delay/time{AT}": 0.0073},
        {f"measurement_delay/time{AT}": 0.0073},
        {},
        {f"measurement_delay/time{AT}": 5 * STEP},
    )
    switch = time[target > 0][0] + 0.0073
    at = int(np.searchsorted(time, switch))
    with_switch = np.insert(time, at, switch)
    shifted = bench(recording(BENCH, with_switch, np.where(with_switch >= switch, 0.4, 0.0)), {})
    assert late == pytest.approx(np.delete(shifted[0], at), abs=1e-9)
    assert read == pytest.approx(np.interp(time - 0.0073, time, plain), abs=1e-12)
    assert read_late[5:] == pytest.approx(plain[:-5], abs=1e-12)


def test_a_clock_that_goes_slow_meets_commands_early_and_ever_more_so() -> None:
    """A command told at t comes at t / (1 + share) by the encoders' clock."""
    time = np.arange(0, 10, 0.03)
    target = 0.3 * np.sign(np.sin(2.1 * time))
    skewed, plain = bench(recording(BENCH, time, target), {"clock_skew/share@robot": 0.005}, {})
    both, where = np.unique(np.concatenate([time, time / 1.005]), return_inverse=True)
    told = target[np.searchsorted(time / 1.005, both, side="right") - 1]
    early = bench(recording(BENCH, both, told), {})[0]
    assert skewed == pytest.approx(early[where[: len(time)]], abs=1e-4)
    moved = np.abs(skewed - plain)
    assert moved[time > 7].max() > 3 * moved[time < 2].max()


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


def test_torque_is_switched_by_the_clock_of_the_commands() -> None:
    """Let go at 4 s by a clock that is a hundredth fast, the arm falls after 4 / 1.01 s."""
    time = np.arange(0, 5.0, 0.02)
    enabled = (time < 4.0).astype(float)
    run = recording(BENCH, time, np.full(len(time), 0.5), 0.5, extras={"torque_enabled": enabled})
    late, early = bench(run, {}, {"clock_skew/share@robot": 0.01})
    falling = (time > 4.0) & (time < 4.9)
    expected = np.interp(time[falling] + 4 - 4 / 1.01, time, late)
    assert np.abs(early - late)[falling].max() > 0.03
    np.testing.assert_allclose(early[falling], expected, atol=2e-3)
