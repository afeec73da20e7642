"""Gears against closed forms: play, give, rotors and stops."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from terms import (
    AT,
    BENCH,
    INERTIA,
    KP,
    LEVER,
    SERVO,
    STEP,
    Array,
    G,
    Row,
    bench,
    held,
    play,
    ramp,
    sizes,
    steps,
)
from test_simulator import recording

from pup.physics.terms import Place
from pup.physics.terms.transmission import RELAXATION
from pup.robot import RobotDescription


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


@pytest.mark.parametrize("drag", [0.0, 0.002, 0.02])
def test_what_is_loose_takes_its_motor_along_by_the_drag_in_its_play(drag: float) -> None:
    """A pendulum that never reaches the end of its play, and a rotor that nothing else holds."""
    time = np.arange(1500) * STEP
    off = {"torque_enabled": np.zeros(len(time))}
    run = recording(BENCH, time, np.zeros(len(time)), 0.05, extras=off)
    (swing,) = bench(run, {f"backlash/gap{AT}": 1.0, f"backlash/drag{AT}": drag})
    rotor = SERVO["armature"]
    link = INERTIA - rotor

    def law(_: float, state: Array) -> list[float]:
        angle, speed, own = state
        held = drag * (speed - own)
        return [speed, -(LEVER * G * np.sin(angle) + held) / link, held / rotor]

    way = solve_ivp(law, (0, time[-1]), [0.05, 0.0, 0.0], t_eval=time, rtol=1e-9, atol=1e-12)
    assert swing == pytest.approx(way.y[0], abs=3e-4)


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


@pytest.mark.parametrize("loss", [0.001, 0.003, 0.01])
def test_what_a_stop_gives_back_of_the_speed_falls_with_its_loss(loss: float) -> None:
    """As of a damped spring that never pulls, which is left before it has sprung back."""
    time = np.arange(600) * STEP
    off = {"torque_enabled": np.zeros(len(time))}
    run = recording(BENCH, time, np.zeros(len(time)), 0.3, extras=off)
    there, k = Place("joint", "servo"), 30.0
    (swing,) = bench(
        run, sizes("joint_stop", there, stiffness=k, angle=-0.02, side=-1.0, loss=loss)
    )
    speed = np.diff(swing) / STEP
    struck = int(np.argmin(speed))
    kept = float(speed[struck : struck + 60].max()) / -speed[struck]
    share = (loss + RELAXATION) * np.sqrt(k / INERTIA) / 2  # of critical damping
    rest = np.sqrt(1 - share**2)
    left = np.exp(-share / rest * np.arctan2(2 * share * rest, 2 * share**2 - 1))
    assert kept == pytest.approx(left, abs=0.03)


def rolled(rows: list[Row], timestep: float) -> Array:
    """The wrist of the SO-101, 6e-5 kg m² behind a rotor of 0.026, sent off, (n_rows, n_ticks)."""
    arm = replace(RobotDescription.load("so101"), timestep=timestep)
    wrist = arm.joint_names.index("Wrist_Roll")
    time = np.arange(0, 0.6, 0.02)
    target = np.zeros((len(time), len(arm.joints)))
    target[5:, wrist] = 0.3
    told = play(arm, recording(arm, time, target, np.zeros(len(arm.joints))), rows)
    assert not told.diverged.any()
    return np.asarray(told.position[:, :, wrist])


@pytest.mark.parametrize("place", ["joint:Wrist_Roll", "robot"])
def test_a_link_far_lighter_than_its_rotor_follows_it_whatever_gives(place: str) -> None:
    """So it does at sub-steps that can follow how it swings."""
    rows = [{f"joint_compliance/compliance@{place}": give} for give in (3e-4, 2e-3, 8e-3, 0.03)]
    np.testing.assert_allclose(rolled(rows, 0.002), rolled(rows, 0.00025), atol=2e-4)


def test_a_stop_gives_a_link_far_lighter_than_its_rotor_no_energy() -> None:
    """It rattles between what gives and the stop, no further than its motor goes without one."""
    there = Place("joint", "Wrist_Roll")
    rows = [
        {f"joint_compliance/compliance@{there}": give}
        | sizes("joint_stop", there, stiffness=stiffness, angle=0.1)
        for give in (4e-3, 8e-3)
        for stiffness in (100.0, 1000.0)
    ]
    assert np.abs(rolled(rows, 0.002)).max() < 0.4
