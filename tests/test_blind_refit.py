"""The generator's refit finds nominal parameters that hide what can be hidden."""

from dataclasses import replace

import numpy as np
import pytest
from test_blind_effects import plans, world_of

from pup.blind import refit as module
from pup.blind.absorb import visibility
from pup.blind.reference import Reference, readings
from pup.blind.refit import Refit
from pup.blind.sensors import Noise
from pup.blind.world import Effect, Nominal, Place, World

NOISE, QUIET = Noise(), Noise(position=1e-4, quantum=0.0)
ROUNDS = 4
SLOW, LOW = slice(0, 1), 0.25  # the sway alone, and a limit that it meets


def known(name: str, **factors: float) -> tuple[World, dict[str, float]]:
    """A robot and its parameters, those of some kinds multiplied."""
    world = world_of(name)
    values = {
        spec.name: spec.nominal * factors.get(spec.name.partition("/")[0], 1.0)
        for spec in world.robot.parameters
    }
    return replace(world, nominal=Nominal.of(world.robot, values)), values


def refit_to(
    name: str, motions: slice = slice(None), **factors: float
) -> tuple[Refit, dict[str, float]]:
    """A refit to readings of the same robot with some parameters multiplied, and those."""
    world, values = known(name)
    shown = plans(world.robot, "bench")[motions]
    other, wanted = known(name, **factors)
    seen = {plan: one.stacked() for plan, one in readings(other, shown)[0].items()}
    return Refit(Reference.of(world, shown, values), seen, NOISE), wanted


@pytest.mark.parametrize("name", ["servo_bench", "darwin_leg"])
def test_other_parameters_are_found_whatever_way_they_are_off(name: str) -> None:
    refit, wanted = refit_to(name, kp=0.75, kd=1.3)
    found = refit.best(ROUNDS)
    assert refit.begun().off > 100
    assert found.off < 2.0
    kp = next(n for n in wanted if n.startswith("kp/"))
    assert found.values[kp] == pytest.approx(wanted[kp], rel=0.05)


def test_a_torque_limit_below_what_motions_meet_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is far below a nominal one that no motion meets, which therefore has no slope."""
    refit, wanted = refit_to("servo_bench", SLOW, tau_max=LOW)
    refit = replace(refit, noise=QUIET)
    column = list(refit.origin.values).index("tau_max/servo")
    assert np.abs(refit.origin.slopes["sway"][:, column]).max() == 0.0
    found = refit.best(ROUNDS)
    assert found.off < 1.0
    assert found.values["tau_max/servo"] == pytest.approx(wanted["tau_max/servo"], rel=0.01)
    monkeypatch.setattr(module, "_limits", lambda origin: [dict(origin.values)])
    assert refit.best(ROUNDS).off > 10


def test_more_weight_is_the_same_as_a_weaker_servo(monkeypatch: pytest.MonkeyPatch) -> None:
    """What slopes promise at first leads elsewhere, and back only by more steps."""
    world, values = known("servo_bench")
    shown = plans(world.robot, "bench")
    heavy = Effect("payload", Place("body", ("load",)), 0.06, "mass", "kg")
    seen = readings(replace(world, effects=(heavy,)), shown)[0]
    refit = Refit(
        Reference.of(world, shown, values), {n: one.stacked() for n, one in seen.items()}, NOISE
    )
    found = refit.best(ROUNDS)
    assert refit.begun().off > 50
    assert found.off < 3.0
    weaker = 0.3247 / (0.3247 + heavy.size)
    for name in ("kp/servo", "tau_max/servo"):
        assert found.values[name] == pytest.approx(weaker * values[name], rel=0.05)
    assert refit.best(2).off < 1.0
    monkeypatch.setattr(module, "_scaled", lambda origin: [dict(origin.values)] * 4)
    assert refit.best(2).off > 5.0


def test_a_refit_never_leaves_more_than_none() -> None:
    refit, _ = refit_to("servo_bench", armature=3.0)
    offs = [refit.best(rounds).off for rounds in (0, 1, 3)]
    assert offs == sorted(offs, reverse=True)
    assert offs[0] == refit.begun().off


def test_noise_with_a_memory_hides_what_is_as_slow() -> None:
    """A change that lasts counts as (1 - m) / (1 + m) of as many readings of white noise."""
    world, values = known("servo_bench")
    shown = plans(world.robot, "bench")[SLOW]
    origin = Reference.of(world, shown, values)
    lasting = {name: readings + 0.01 for name, readings in origin.stacked().items()}
    white, coloured = (
        Refit(origin, lasting, Noise(memory=memory)).begun().off for memory in (0.0, 0.8)
    )
    count = len(shown[0].time)
    assert white == pytest.approx(0.01 * np.sqrt(count) / NOISE.sigma)
    assert coloured == pytest.approx(white * np.sqrt((0.2 / 1.8 * (count - 1) + 1) / count))


def test_what_the_imu_alone_tells_may_be_material() -> None:
    """Roll and pitch count as joints do, in their own noise."""
    world, values = known("darwin_op2")
    origin = Reference.of(world, plans(world.robot, "ground"), values)
    (sway,) = origin.seen.values()
    assert sway.tilt is not None
    seen = {"sway": replace(sway, tilt=sway.tilt + np.array([0.0, 0.01]))}
    told = visibility(origin, seen, NOISE)
    assert told.raw == pytest.approx(0.01 / NOISE.imu * NOISE.sigma)
    assert told.document()["material"]


def test_what_a_refit_leaves_is_told_with_what_it_moved() -> None:
    refit, _ = refit_to("servo_bench", kp=0.8)
    other, _ = known("servo_bench", kp=0.8)
    seen = readings(other, refit.origin.plans)[0]
    told = visibility(refit.origin, seen, NOISE, rounds=ROUNDS)
    assert told.snr < 1.0 and told.absorbed > 0.99
    assert told.absorbed_by["kp/servo"] == pytest.approx(-0.2, abs=0.01)
