"""What is concealed is physics: it vanishes with its size and does not hang on the time step."""

from dataclasses import replace

import numpy as np
import pytest
from test_blind_effects import plans, world_of

from pup.blind.catalogue import KINDS, MASKED, available, draw, plausible, unlisted
from pup.blind.drafts import NUISANCE, draw_case, draw_null
from pup.blind.kit import Kit
from pup.blind.make import ROBOTS
from pup.blind.reference import readings
from pup.blind.sensors import Noise
from pup.blind.setting import NULLS, STRATA, Setting, setting
from pup.blind.sound import converged, shrinks
from pup.blind.world import STEP, Effect, Engine, Place, Plan, World, steady
from pup.errors import InputError
from pup.robot import RobotDescription

QUIET = Noise(position=0.0, quantum=0.0)
FINER = 4  # as many steps for one; an error linear in the step shows three quarters of itself
STEP_FREE = 1.7e-5  # rad, rms; the nominal motion itself changes as much with the step
VANISHED, SAME = 0.05, 0.07  # shares of the change at typical size
SWITCHED = 0.21  # the same of what jumps from level to level, at the next step at the earliest
SEEDS = 150
BRIEF = 30  # ticks, up to a moment without torque
DISTAL = Place("joint", ("l_ank_roll",))  # carries the lightest link


def moved(world: World, shown: list[Plan], *effects: Effect) -> np.ndarray:
    seen = readings(replace(world, effects=effects), shown)[0]
    return np.concatenate([seen[plan.id].stacked() for plan in shown])


def shortened(plan: Plan) -> Plan:
    enabled = None if plan.enabled is None else plan.enabled[:BRIEF]
    return replace(plan, time=plan.time[:BRIEF], target=plan.target[:BRIEF], enabled=enabled)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def telling(effect: Effect) -> Effect:
    """The same within the short motions of a test."""
    if effect.name == "joint_stop":
        return replace(effect, size=0.3 * effect.shape["side"])
    shape = {"friction_step": {"onset": 0.3}, "stick_events": {"every": 0.2}}.get(effect.form)
    return replace(effect, shape=shape) if shape else effect


def drawn_for(stratum: str, ground: bool, seed: int) -> tuple[np.random.Generator, Setting]:
    rng = np.random.default_rng(seed)
    return rng, setting(stratum, ground, rng)


def typical(name: str, world: World) -> Effect:
    effect = telling(draw(name, Kit.of(world.robot, False), np.random.default_rng(5)))
    light = len(world.robot.joints) > 1 and effect.place.kind in ("joint", "group")
    return replace(effect, place=DISTAL) if light else effect


LEG = (
    *("coulomb_friction", "quadratic_damping", "torque_speed_limit", "target_rate_limit"),
    *("command_delay", "actuator_lag", "integral_action"),
    *("backlash", "joint_compliance", "structural_flex"),
)


@pytest.mark.parametrize(("name", "names"), [("servo_bench", None), ("darwin_leg", LEG)])
def test_effects_vanish_with_their_size_and_do_not_hang_on_the_step(
    name: str, names: tuple[str, ...] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pup.blind.simulate.SETTLING", 0.1)
    monkeypatch.setattr("pup.blind.simulate.SLOW", 0.1)
    world = world_of(name)
    fine = replace(world, engine=Engine(step=STEP / FINER))
    shown = [shortened(plan) for plan in plans(world.robot, "bench")]
    nominal, exact = moved(world, shown), moved(fine, shown)
    for effect in names or (*available(Kit.of(world.robot, False)), *unlisted()):
        drawn = typical(effect, world)
        change = moved(world, shown, drawn) - nominal
        error = rms(change - (moved(fine, shown, drawn) - exact))
        same = SWITCHED if drawn.form == "quantised_torque" else SAME
        assert error < same * rms(change) + STEP_FREE, f"{effect}: off by {error:.1e} rad"
        if effect == "joint_stop":  # its size is an angle
            continue
        left = rms(moved(world, shown, drawn.scaled(1e-3)) - nominal)
        assert left < VANISHED * rms(change) + STEP_FREE, f"{effect}: {left:.1e} rad of nothing"


def test_a_lag_of_nothing_is_none_beside_other_effects() -> None:
    """Sagging and warm motors have other limits, within which a lag must stay."""
    world = world_of("servo_bench")
    shown = plans(world.robot, "bench")
    others = [typical(name, world) for name in ("voltage_sag", "thermal_drift", "integral_action")]
    lag = typical("actuator_lag", world).scaled(1e-6)
    assert rms(moved(world, shown, *others, lag) - moved(world, shown, *others)) < 1e-6


@pytest.mark.parametrize("name", ["joint_compliance", "structural_flex", "backlash"])
def test_the_stiffest_springs_of_a_nuisance_are_stable(name: str) -> None:
    world = world_of("darwin_leg")
    shown = plans(world.robot, "bench")
    nominal = moved(world, shown)
    for kept in (0.25, 1.0):  # a nuisance is halved up to twice
        drawn = typical(name, world).scaled(kept * NUISANCE[0])
        if name == "structural_flex":
            drawn = replace(drawn, place=Place("body", ("l_ank_roll_link",)))
        assert rms(moved(world, shown, drawn) - nominal) < 1e-3


def test_effects_that_are_artefacts_are_told() -> None:
    """One that grows as it should vanish, and one that is shorter than a step."""
    world = world_of("servo_bench")
    plan = replace(plans(world.robot, "bench")[1], enabled=None)
    nominal = readings(world, [plan])[0][plan.id]

    def verdicts(effect: Effect) -> tuple[bool, bool]:
        seen = readings(replace(world, effects=(effect,)), [plan])[0][plan.id]
        change = seen.stacked() - nominal.stacked()
        return (
            shrinks(world, plan, effect, nominal, change, QUIET),
            converged(world, plan, effect, change, QUIET),
        )

    assert verdicts(typical("coulomb_friction", world)) == (True, True)
    assert verdicts(replace(typical("joint_spring", world), inverse=True)) == (False, True)
    late = replace(typical("command_delay", world), size=0.6 * STEP)
    assert not verdicts(late)[1]


@pytest.mark.parametrize("robot", ["servo_bench", "darwin_leg"])
def test_no_draw_is_of_a_size_that_no_robot_has(
    robot: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pup.blind.drafts._stopped", lambda draft, effect: effect)
    description = RobotDescription.load(robot)
    kit = Kit.of(description, False)
    for seed in range(12):
        rng = np.random.default_rng(seed)
        for stratum in ("single", "below_noise", "weak", "masked", "pair", "unlisted"):
            try:
                draft = draw_case(description, stratum, False, rng, Setting())
            except InputError:  # a pair of one class, drawn anew by the caller
                continue
            assert all(plausible(effect, kit) for effect in draft.effects)
            for factor in 10 ** rng.uniform(-3, 3, size=4):
                try:
                    draft = draft.resized(float(factor))
                except InputError:
                    continue
                assert all(plausible(effect, kit) for effect in draft.effects)


@pytest.mark.parametrize(
    ("name", "ground"), [*((name, False) for name in ROBOTS), ("darwin_op2", True)]
)
def test_every_kind_of_case_can_be_drawn(
    name: str, ground: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without motions, which take long and hang on the robot alone."""
    monkeypatch.setattr("pup.blind.drafts.programme", lambda *given: ())
    monkeypatch.setattr("pup.blind.drafts._stopped", lambda draft, effect: effect)
    robot = RobotDescription.load(name)
    for stratum in STRATA:
        drawn = 0
        for seed in range(SEEDS):
            try:
                draft = draw_case(robot, stratum, ground, *drawn_for(stratum, ground, seed))
            except InputError:  # drawn anew by the caller
                continue
            drawn += 1
            assert draft.stratum == stratum
            assert len(draft.effects) == (2 if stratum == "pair" else 1)
            assert stratum != "masked" or draft.effects[0].name in MASKED
        assert drawn > SEEDS / 2, stratum
    for kind in NULLS:
        for seed in range(SEEDS):
            null = draw_null(robot, kind, ground, *drawn_for(f"null:{kind}", ground, seed))
            assert null.stratum == f"null:{kind}" and not null.effects


CHANCE = 4.0
"""Standard deviations by which a share may be off."""


@pytest.mark.parametrize(("name", "ground"), [("servo_bench", False), ("darwin_op2", True)])
def test_what_is_recorded_tells_nothing_of_the_stratum(
    name: str, ground: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Programmes and setups as they are played, against those of all cases together."""
    robot = RobotDescription.load(name)
    played: list[Setting] = []

    def noted(robot: RobotDescription, ground: bool, given: Setting, rng: object) -> tuple[()]:
        played.append(given)
        return ()

    monkeypatch.setattr("pup.blind.drafts.programme", noted)
    monkeypatch.setattr("pup.blind.drafts._stopped", lambda draft, effect: effect)
    seen: dict[str, list[Setting]] = {}
    for stratum in (*STRATA, *(f"null:{kind}" for kind in NULLS)):
        kind = stratum.removeprefix("null:")
        for seed in range(SEEDS):
            words = drawn_for(stratum, ground, seed + 1000 * len(seen))
            try:
                (draw_case if kind == stratum else draw_null)(robot, kind, ground, *words)
            except InputError:  # drawn anew by the caller
                continue
        seen[stratum], played[:] = list(played), []

    def share(some: list[Setting], what: str) -> float:
        return sum(getattr(one, what) for one in some) / len(some)

    every = [one for some in seen.values() for one in some]
    for what in ("powered", "plain", "fall", "walk"):
        common = share(every, what)
        assert 0.2 < common < 0.6 if ground or what in ("powered", "plain") else common == 0
        for stratum, some in seen.items():
            if (stratum, what) == ("unidentifiable", "powered"):
                continue  # torque that is switched off would tell what it cannot be told by
            chance = CHANCE * np.sqrt(common * (1 - common) / len(some))
            assert abs(share(some, what) - common) <= chance, (stratum, what)
    for what in ("rough", "wide"):  # as often among omissions as among nulls
        nulls = sum(part * share(seen[f"null:{kind}"], what) for kind, part in NULLS.items())
        missing = sum(part * share(seen[kind], what) for kind, part in STRATA.items())
        assert missing == pytest.approx(nulls, abs=CHANCE * np.sqrt(0.25 / SEEDS / 5))
        assert all(share(some, what) > 0 for some in seen.values())


def test_sizes_out_of_range_are_refused() -> None:
    world = world_of("servo_bench")
    kit = Kit.of(world.robot, False)
    for name in (*available(kit), *unlisted()):
        effect = draw(name, kit, np.random.default_rng(1))
        least, most = KINDS[name].span if name in KINDS else (0.05, 1.5)
        if name != "joint_stop":
            assert plausible(effect.scaled(least), kit) and plausible(effect.scaled(most), kit)
            assert not plausible(effect.scaled(0.9 * least), kit), name
            assert not plausible(effect.scaled(1.1 * most), kit), name


def test_a_light_rotor_with_much_damping_gets_a_smaller_step() -> None:
    world = world_of("darwin_leg")
    hard = replace(world.nominal, kd=1.6 * world.nominal.kd, armature=0.4 * world.nominal.armature)
    assert steady(world.nominal, STEP) == STEP
    assert steady(hard, STEP) < STEP
    shown = plans(world.robot, "bench")
    rough = replace(world, nominal=hard, engine=Engine(step=steady(hard, STEP)))
    fine = replace(rough, engine=Engine(step=STEP / 8))
    assert rms(moved(rough, shown) - moved(fine, shown)) < 5e-5
