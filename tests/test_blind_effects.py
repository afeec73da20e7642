"""Every effect that can be concealed changes the motion, and more of it changes it more."""

from dataclasses import replace

import numpy as np
import pytest

from pup.blind.catalogue import CLASS_OF, CLASSES, KINDS, available, draw, unlisted
from pup.blind.drafts import draw_case
from pup.blind.kit import Kit
from pup.blind.reference import readings
from pup.blind.setting import Setting
from pup.blind.world import Effect, Nominal, Plan, World
from pup.errors import InputError
from pup.robot import RobotDescription

SEEN = 2e-5  # rad, rms; a tenth of it would be lost in the noise of any set
TICKS = 0.0335 * np.arange(40)


def plans(robot: RobotDescription, support: str) -> list[Plan]:
    """A sweep, steps and a moment without torque; on the ground weight is shifted."""
    count = len(robot.joints)
    start = np.array(robot.poses["half_squat"] if support == "ground" else [0.0] * count)
    if count == 6:
        start = np.array([0.0, -0.4, 0.5, -1.0, -0.3, 0.1])
    fade = np.clip(TICKS - 0.2, 0, 0.4)[:, None] / 0.4
    size = 0.08 if support == "ground" else 0.2 if count > 1 else 0.6
    phases = np.linspace(0, 3, count)
    slow = start + size * fade * np.sin(4 * TICKS[:, None] + phases)
    fast = start + 1.5 * size * (np.floor(2 * TICKS) % 2)[:, None] * np.ones(count)
    on = (TICKS < 0.8) | (TICKS > 0.95)
    if support == "ground":
        return [Plan("sway", "multisine", support, TICKS, slow)]
    return [
        Plan("sway", "multisine", support, TICKS, slow),
        Plan("step", "step", support, TICKS, fast, enabled=on),
    ]


def differs(world: World, support: str, effect: Effect, base: dict) -> float:
    """Rms over all readings of what an effect changes, rad."""
    seen = readings(replace(world, effects=(effect,)), plans(world.robot, support))[0]
    apart = [seen[name].stacked() - base[name].stacked() for name in base]
    return float(np.sqrt(np.mean(np.concatenate(apart) ** 2)))


def world_of(name: str) -> World:
    robot = RobotDescription.load(name)
    return World(robot, Nominal.of(robot, {s.name: s.nominal for s in robot.parameters}))


@pytest.mark.parametrize(
    ("name", "support", "effects"),
    [
        ("servo_bench", "bench", None),
        ("darwin_leg", "bench", ("armature", "external_force", "voltage_sag", "com_offset")),
        (
            "darwin_op2",
            "ground",
            (
                *("ground_compliance", "ground_slope", "ground_friction", "contact_restitution"),
                *("imu_misalignment", "imu_delay"),
            ),
        ),
    ],
)
def test_effects_change_the_motion(
    name: str, support: str, effects: tuple[str, ...] | None
) -> None:
    world = world_of(name)
    kit = Kit.of(world.robot, support == "ground")
    base = readings(world, plans(world.robot, support))[0]
    rng = np.random.default_rng(5)
    for effect in effects or (*available(kit), *unlisted()):
        drawn = draw(effect, kit, rng)
        if effect == "joint_stop":
            drawn = replace(drawn, size=0.3 * drawn.shape["side"])
        if effect == "friction_step":
            drawn = replace(drawn, shape={"onset": 0.3})
        if effect == "stick_events":
            drawn = replace(drawn, shape={"every": 0.2})
        small = differs(world, support, drawn, base)
        assert small > SEEN, f"{effect} cannot be seen ({small:.1e} rad)"


@pytest.mark.parametrize("effect", ["coulomb_friction", "backlash", "command_delay", "payload"])
def test_more_of_an_effect_changes_more(effect: str) -> None:
    world = world_of("servo_bench")
    base = readings(world, plans(world.robot, "bench"))[0]
    drawn = draw(effect, Kit.of(world.robot, False), np.random.default_rng(2))
    sizes = [differs(world, "bench", drawn.scaled(f), base) for f in (0.3, 1.0, 2.0)]
    assert sizes[0] < sizes[1] < sizes[2]


def test_every_class_has_effects_that_can_be_drawn() -> None:
    assert set(KINDS) == set(CLASS_OF)
    assert len(CLASSES) == 23


def test_a_delayed_command_and_a_delayed_reading_cannot_be_told_apart() -> None:
    world = world_of("servo_bench")
    kit, rng = Kit.of(world.robot, False), np.random.default_rng(0)
    still = {"jitter": 0.0, "lost": 0.0}
    command, reading = (
        replace(draw(name, kit, rng, ("joint",)), shape=still)
        for name in ("command_delay", "measurement_delay")
    )
    moves = [replace(plan, enabled=None) for plan in plans(world.robot, "bench")]
    one, two = (readings(replace(world, effects=(e,)), moves)[0] for e in (command, reading))
    for name in one:
        assert np.abs(one[name].position - two[name].position).max() < 2e-4


def test_a_weight_is_missing_where_loads_that_are_known_differ() -> None:
    """With one load, more weight is the same as less of all that the servo does."""
    robot = RobotDescription.load("servo_bench")
    loads = {True: [0], False: [0]}
    for seed in range(400):
        rng, plain = np.random.default_rng(seed), seed % 2 == 0
        try:
            draft = draw_case(robot, "pair", False, rng, Setting(plain=plain))
        except InputError:
            continue
        if "payload" in [effect.name for effect in draft.effects]:
            loads[plain].append(len({plan.setup["mass"] for plan in draft.plans if not plan.test}))
    assert loads[True] == [0]
    assert len(loads[False]) > 3
    assert min(loads[False][1:]) > 1


@pytest.mark.parametrize("share", [1.0, 0.1])
@pytest.mark.parametrize(
    ("name", "kind"), [("joint_compliance", "joint"), ("structural_flex", "body")]
)
def test_a_joint_may_have_play_and_give_way_besides(name: str, kind: str, share: float) -> None:
    """Both are joints in series: as a pair, or as a nuisance of one another."""
    world = world_of("servo_bench")
    kit = Kit.of(world.robot, False)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        play = draw("backlash", kit, rng, ("joint",))
        give = draw(name, kit, rng, (kind,)).scaled(share)
        alone = readings(replace(world, effects=(give,)), plans(world.robot, "bench"))[0]
        both = readings(replace(world, effects=(play, give)), plans(world.robot, "bench"))[0]
        apart = np.concatenate([both[plan].stacked() - alone[plan].stacked() for plan in both])
        assert SEEN < np.sqrt(np.mean(apart**2)) < 6 * play.size
