"""A body that bends does so where its parent carries it, whatever the knobs of a recording say."""

from dataclasses import replace
from pathlib import Path
from shutil import copytree

import mujoco
import numpy as np
import pytest
from test_blind_effects import world_of

from pup.blind.catalogue import draw
from pup.blind.kit import Kit
from pup.blind.mechanism import GRAVITY, Mechanism, build
from pup.blind.scene import Scene
from pup.blind.world import Effect, Nominal, Place, Plan, World
from pup.robot import RobotDescription
from pup.robot_parts import Edit, Knob

LENGTHS = (0.08, 0.1, 0.13)
MASS, ANGLE, STIFFNESS = 0.25, 0.6, 45.0
SETTLED = 3000  # steps
ANGLES = (0.0, 0.7)  # rad, of the driven joints


def held(knob: str, values: tuple[float, ...], joints: int = 1) -> list[Plan]:
    time = np.arange(2.0)
    target = np.full((2, joints), ANGLE)
    return [Plan("a", "hold", "bench", time, target, setup={knob: v}) for v in values]


def built(world: World, plans: list[Plan]) -> Mechanism:
    return build(world, "bench", plans, [world.nominal])


def with_effect(world: World, name: str) -> World:
    drawn = draw(name, Kit.of(world.robot, False), np.random.default_rng(3))
    return replace(world, effects=(drawn,))


def anchors(mechanism: Mechanism, joint: str, frame: str, angle: float) -> np.ndarray:
    """Where a joint sits in a body's frame, lane by lane."""
    found = []
    for lane in range(len(mechanism.batch.bind("qpos"))):
        model = mechanism.batch.get_model(lane)
        data = mujoco.MjData(model)
        data.qpos[mechanism.qpos] = angle
        mujoco.mj_forward(model, data)
        at = data.joint(joint).xanchor - data.body(frame).xpos
        found.append(data.body(frame).xmat.reshape(3, 3).T @ at)
    return np.array(found)


@pytest.mark.parametrize("angle", ANGLES)
def test_the_load_bends_at_the_servos_axis_for_every_length(angle: float) -> None:
    world = with_effect(world_of("servo_bench"), "structural_flex")
    told = anchors(built(world, held("length", LENGTHS)), "load:bends", "arm", angle)
    assert np.abs(told).max() < 1e-12


@pytest.mark.parametrize("angle", ANGLES)
def test_a_load_that_is_mounted_askew_bends_at_one_place_too(angle: float, tmp_path: Path) -> None:
    folder = tmp_path / "askew"
    copytree(RobotDescription.load("servo_bench").model_path.parent, folder)
    model = (folder / "model.xml").read_text()
    askew = model.replace('name="load" pos', 'name="load" euler="0.3 0.5 0.2" pos')
    assert askew != model
    (folder / "model.xml").write_text(askew)
    robot = RobotDescription.load(folder)
    world = with_effect(replace(world_of("servo_bench"), robot=robot), "structural_flex")
    told = anchors(built(world, held("length", LENGTHS)), "load:bends", "arm", angle)
    assert np.abs(told[0]).max() > 0.01
    assert np.abs(told - told[1]).max() < 1e-12


def test_the_load_sags_by_its_moment_over_the_stiffness() -> None:
    world = world_of("servo_bench")
    shape = {"x": 0.0, "y": 1.0, "z": 0.0, "loss": 5e-4, "root": 0.1}
    load = Place("body", ("load",))
    flex = Effect("structural_flex", load, STIFFNESS, "stiffness", "N m/rad", shape)
    world = replace(world, effects=(flex,))
    plans = [replace(plan, setup={**plan.setup, "mass": MASS}) for plan in held("length", LENGTHS)]
    mechanism = built(world, plans)
    scene = Scene(world, plans, [world.nominal], mechanism)
    scene.place(False)
    for _ in range(SETTLED):
        scene.kick(0.0, np.array([[ANGLE]]), np.ones((1, 1)), scene.sensed())
        mechanism.batch.step()
    bend = scene.qpos[:, mechanism.model.joint("load:bends").qposadr[0]]
    link = scene.qpos[:, mechanism.qpos[0]] + bend
    wanted = -MASS * GRAVITY * np.array(LENGTHS) * np.sin(link) / STIFFNESS
    assert bend == pytest.approx(wanted, rel=1e-3)


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("effect", ["backlash", "joint_compliance"])
def test_what_gives_in_the_gear_sits_on_the_servos_axis_for_every_length(
    effect: str, angle: float
) -> None:
    world = with_effect(world_of("servo_bench"), effect)
    mechanism = built(world, held("length", LENGTHS))
    assert np.abs(anchors(mechanism, f"servo:{effect}", "arm", angle)).max() < 1e-12


@pytest.mark.parametrize("effect", ["payload", "com_offset"])
def test_what_changes_a_load_goes_with_it(effect: str) -> None:
    """The moment about the servo at rest: all the mass is at the load, or beside it."""
    world = with_effect(world_of("servo_bench"), effect)
    plans = held("length", LENGTHS)
    batch = built(world, plans).batch
    size, nominal = world.effects[0].size, world.robot.setup({})["mass"]
    more, beside = (size, 0.0) if effect == "payload" else (0.0, size)
    for lane, length in enumerate(LENGTHS):
        model = batch.get_model(lane)
        data = mujoco.MjData(model)
        data.qpos[0] = ANGLE
        mujoco.mj_forward(model, data)
        lever = length * np.sin(ANGLE) - beside * np.cos(ANGLE)
        assert data.qfrc_bias[0] == pytest.approx((nominal + more) * GRAVITY * lever, rel=1e-9)


def test_a_driven_link_bends_at_its_joint_where_a_knob_moves_both() -> None:
    robot = RobotDescription.load("darwin_leg")
    edit = Edit("body_pos", "l_knee_link", 2, -1.0, 0.0)
    thigh = Knob("thigh", "m", 0.093, 0.05, 0.2, (edit,), ())
    robot = replace(robot, knobs=(*robot.knobs, thigh))
    values = {s.name: s.nominal for s in robot.parameters}
    flex = draw("structural_flex", Kit.of(robot, False), np.random.default_rng(3))
    flex = replace(flex, place=Place("body", ("l_knee_link",)))
    world = World(robot, Nominal.of(robot, values), (flex,))
    mechanism = built(world, held("thigh", (0.08, 0.093, 0.12), len(robot.joints)))
    for name in ("l_knee", "l_knee_link:bends"):
        told = anchors(mechanism, name, "l_hip_pitch_link", 0.0)
        assert told[:, 2] == pytest.approx([-0.08, -0.093, -0.12])
