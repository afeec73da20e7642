"""Effects that act on each other, on one joint against an independent integrator."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from terms import BENCH, SERVO, Array, Law, Row, play, servo, solved, weight, with_terms
from test_terms_solved import AT, FIRST, KD, KP, LIMIT, LINK, ROTOR, RUN, bristle

from pup.physics.mujoco_batch import MujocoSimulator
from pup.physics.parameters import ParameterSpace
from pup.physics.terms.friction import GRIP
from pup.physics.terms.transmission import RELAXATION

GIVE = 0.008
SOFT = {f"joint_compliance/compliance{AT}": GIVE}


def bend(q: float, v: float, motor: float, speed: float) -> float:
    """Torque of what gives between a motor and its link, which its encoder is at, N m."""
    return (motor - q + RELAXATION * (speed - v)) / GIVE


def lagging(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    q, v, motor, speed, torque = x
    passed = bend(q, v, motor, speed)
    follows = (servo(target - q, speed) + KD * speed - torque) / 0.008
    return passed + weight(q), [speed, (torque - KD * speed - passed) / ROTOR, follows]


def lossy(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    q, v, motor, speed, z = x
    passed, torque = bend(q, v, motor, speed), servo(target - q, speed)
    left = torque - 0.2 * abs(torque) * z / GRIP
    return passed + weight(q), [speed, (left - passed) / ROTOR, bristle(speed, z)]


def by_load(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    q, v, motor, speed, z = x
    passed, torque = bend(q, v, motor, speed), servo(target - q, speed)
    # What is passed on is the motor's torque less what turns its rotor, before it rubs.
    share = 0.15 * z / GRIP * np.sign(torque + passed)
    friction = share * (torque + passed) / (1 - share)
    return passed + weight(q), [speed, (torque - friction - passed) / ROTOR, bristle(speed, z)]


def rippling(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    q, v, motor, speed = x
    passed, torque = bend(q, v, motor, speed), servo(target - q, speed)
    ripple = 0.05 * np.sin(40 * motor)
    return passed + weight(q), [speed, (torque + ripple - passed) / ROTOR]


def rubbing(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    q, v, motor, speed, z = x
    passed, torque = bend(q, v, motor, speed), servo(target - q, speed)
    rub = 0.08 * z / GRIP
    return passed + weight(q), [speed, (torque - rub - passed) / ROTOR, bristle(speed, z)]


BEHIND: dict[str, tuple[Row, Law, Sequence[float]]] = {
    "actuator_lag": ({f"actuator_lag/time{AT}": 0.008}, lagging, (0.0, 0.0, FIRST)),
    "gear_efficiency": ({f"gear_efficiency/loss{AT}": 0.2}, lossy, (0.0, 0.0, 0.0)),
    "load_dependent_friction": (
        {f"load_dependent_friction/share{AT}": 0.15},
        by_load,
        (0.0, 0.0, 0.0),
    ),
    "cogging": (
        {f"cogging/sine{AT}": 0.05, f"cogging/teeth{AT}": 40.0},
        rippling,
        (0.0, 0.0),
    ),
    "coulomb_friction": ({f"coulomb_friction/torque{AT}": 0.08}, rubbing, (0.0, 0.0, 0.0)),
}


@pytest.fixture(scope="module", params=[0.002, 0.0005])
def behind(request: pytest.FixtureRequest) -> dict[str, Array]:
    """Each with a motor that reaches its link through a give, and that alone."""
    rows = [SERVO | SOFT | dict(row) for row, *_ in BEHIND.values()]
    seen = play(replace(BENCH, timestep=request.param), RUN, [*rows, SERVO | SOFT])
    return dict(zip([*BEHIND, "nothing"], seen.position[:, :, 0], strict=True))


@pytest.mark.parametrize("effect", BEHIND)
def test_what_acts_on_a_motor_goes_by_its_speed_not_by_the_link_s(
    effect: str, behind: dict[str, Array]
) -> None:
    _, law, further = BEHIND[effect]
    error = behind[effect] - solved(RUN, law, *further, inertia=LINK)
    stale = effect == "load_dependent_friction"  # a load is known from the sub-step before
    assert np.sqrt(np.mean(error**2)) < (7e-4 if stale else 4e-4)
    assert np.abs(behind[effect] - behind["nothing"]).max() > 1e-2


def warm(t: float, x: Array, target: float) -> tuple[float, Sequence[float]]:
    q, v, warmth, torque = x
    left = 1 - 0.3 * warmth
    asked = left * np.clip(KP * (target - q) - KD * v, -LIMIT, LIMIT)
    rates = [abs(asked) / LIMIT - warmth / 40, (asked + left * KD * v - torque) / 0.008]
    return torque - left * KD * v + weight(q), rates


@pytest.mark.parametrize("timestep", [0.002, 0.0005])
def test_the_damping_of_a_warm_winding_is_what_does_not_lag(timestep: float) -> None:
    lag = {f"actuator_lag/time{AT}": 0.008}
    drift = {f"thermal_drift/{name}{AT}": v for name, v in (("rate", 0.3), ("load", 1.0))}
    both, cold = play(
        replace(BENCH, timestep=timestep), RUN, [SERVO | lag | drift, SERVO | lag]
    ).position[:, :, 0]
    error = both - solved(RUN, warm, 0.0, FIRST)
    assert np.sqrt(np.mean(error**2)) < 1e-4
    assert np.abs(both - cold).max() > 3e-3


@pytest.mark.parametrize("damping", [0.0, 0.2])
def test_load_is_the_same_behind_next_to_no_play(damping: float) -> None:
    """Of the joint's damping, too, which acts on the motor where it has its own."""
    size, gap = f"load_dependent_friction/share{AT}", f"backlash/gap{AT}"
    given = with_terms(BENCH, [SERVO | {size: 0.15, gap: play} for play in (1e-6, 0.0)])
    space = given.space.plus(
        ParameterSpace(("damping/servo",), ("N m s/rad",), *np.full((3, 1), damping))
    )
    values = np.hstack([given.values, np.full((2, 1), damping)])
    loose, firm = MujocoSimulator(BENCH, [RUN], "pd").replay(space.candidates(values)).position
    assert np.sqrt(np.mean((loose - firm) ** 2)) < 3e-4


@pytest.mark.parametrize("nominal", [0.001, 0.003])
def test_more_rotor_behind_a_give_is_more_rotor_from_the_start(nominal: float) -> None:
    whole = SERVO | SOFT | {"armature": nominal + 0.003}
    parts = SERVO | SOFT | {"armature": nominal, f"armature/inertia{AT}": 0.003}
    one, two = play(BENCH, RUN, [whole, parts]).position[:, :, 0]
    assert one == pytest.approx(two, abs=1e-9)
