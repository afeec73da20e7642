"""Replays against closed forms, and what must not depend on how they are put together."""

import ctypes
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import brentq

from pup.physics.model import compile_model
from pup.physics.mujoco_batch import MujocoSimulator
from pup.physics.parameters import ParameterSpace, robot_space
from pup.physics.simulator import Trajectories
from pup.recording import Recording, load_recordings
from pup.robot import RobotDescription

Array = NDArray[np.float64]

G = 9.81
STEP = 0.002  # s, the sub-step of the robots used here but `emps`
MASS, LENGTH = 0.3247, 0.1  # of the servo bench at its knobs' defaults
FACTOR = """
[[parameter]]
name = "mass/load"
unit = "1"
nominal = 1.0
search = [0.5, 2.0]
actuators = ["pd"]
"""
ARM = 1e-6 + 1e-7  # kg m², its arm and the load's own
BENCH = RobotDescription.load("servo_bench")
OP2 = RobotDescription.load("darwin_op2")


def recording(
    robot: RobotDescription,
    time: Array,
    target: Array,
    start: Array | float = 0.0,
    support: str = "bench",
    **more: Any,
) -> Recording:
    """Commands and a first position; what follows was not measured."""
    position = np.full((len(time), len(robot.joints)), np.nan)
    position[0] = start
    return Recording(
        id=more.pop("id", "r"),
        robot=robot.name,
        motion="step",
        support=support,
        source="simulation",
        joints=robot.joint_names,
        time=time,
        target=np.broadcast_to(np.asarray(target, float).reshape(len(time), -1), position.shape),
        position=position,
        **more,
    )


def space_of(
    robot: RobotDescription, values: Mapping[str, float], actuator: str = "pd"
) -> ParameterSpace:
    """The robot's space at some values; names it lacks are appended."""
    space = robot_space(robot, actuator)
    extra = [name for name in values if name not in space.names]
    wide = ParameterSpace(
        (*space.names, *extra),
        (*space.units, *("?" for _ in extra)),
        np.append(space.nominal, [values[n] for n in extra]),
        np.append(space.lower, [0.0 for _ in extra]),
        np.append(space.upper, [1.0 for _ in extra]),
    )
    return wide.at(values)


def replay(
    robot: RobotDescription,
    recordings: tuple[Recording, ...],
    values: Mapping[str, float],
    actuator: str = "pd",
) -> Trajectories:
    candidates = space_of(robot, values, actuator).candidates()
    return MujocoSimulator(robot, recordings, actuator).replay(candidates)


def test_a_pendulum_without_torque_swings_at_its_period() -> None:
    """Torque off means a free swing: no servo, no damping."""
    time, angle, armature = np.arange(2500) * STEP, 0.05, 0.001
    off = {"torque_enabled": np.zeros(len(time))}
    free = recording(BENCH, time, np.full(len(time), 1.0), angle, extras=off)
    q = replay(BENCH, (free,), {"armature": armature}).position[0, :, 0]
    inertia = MASS * LENGTH**2 + ARM + armature
    period = 2 * np.pi * np.sqrt(inertia / (MASS * G * LENGTH)) * (1 + angle**2 / 16)
    downward = np.flatnonzero((q[:-1] > 0) & (q[1:] <= 0))
    crossing = time[downward] + STEP * q[downward] / (q[downward] - q[downward + 1])
    assert np.diff(crossing) == pytest.approx(period, rel=2e-4)
    assert q[-400:].max() == pytest.approx(angle, rel=1e-3)


def test_torque_comes_back_where_it_is_enabled_again() -> None:
    time = np.arange(500) * STEP
    enabled = (time >= 0.5).astype(float)
    target = np.full(len(time), 0.4)
    run = recording(BENCH, time, target, extras={"torque_enabled": enabled})
    q = replay(BENCH, (run,), {}).position[0, :, 0]
    assert (q[time <= 0.5] == 0).all()
    assert q[-1] > 0.3


@pytest.mark.parametrize(
    "setup", [{}, {"mass": 0.5, "length": 0.2}, {"kp": 64.0}, {"vin": 5.0, "mass": 0.1}]
)
def test_a_pd_servo_sags_under_gravity_as_by_hand(setup: dict[str, float]) -> None:
    """The knobs scale stiffness by kp/32 vin/6, and change load and lever."""
    time = np.arange(0, 5, 0.02)
    kp, target = 5.0, 0.6
    run = recording(BENCH, time, np.full(len(time), target), setup=setup)
    values = {"kp/servo": kp, "kd/servo": 0.3, "tau_max/servo": 3.0}
    q = replay(BENCH, (run,), values).position[0, -1, 0]
    stiffness = kp * setup.get("kp", 32) / 32 * setup.get("vin", 6) / 6
    moment = G * setup.get("mass", MASS) * setup.get("length", LENGTH)
    rest = brentq(lambda x: stiffness * (target - x) - moment * np.sin(x), 0, target, xtol=1e-14)
    assert q == pytest.approx(rest, abs=1e-9)


def test_a_factor_on_a_body_s_mass_leaves_what_a_knob_adds(tmp_path: Path) -> None:
    """A load that is known tells how strong a servo is, whatever the body weighs."""
    folder = tmp_path / "bench"
    shutil.copytree(BENCH.folder, folder)
    with (folder / "robot.toml").open("a") as file:
        file.write(FACTOR)
    robot, factor, added = RobotDescription.load(folder), 1.2, 0.5
    time = np.arange(0, 2, 0.02)
    runs = [
        recording(robot, time, np.full(len(time), 0.6), setup={"mass": added + own})
        for own in (MASS, factor * MASS)
    ]
    heavier = replay(robot, runs[:1], {"mass/load": factor}).position
    np.testing.assert_allclose(heavier, replay(robot, runs[1:], {}).position, atol=1e-5)


def test_the_torque_limit_holds_a_load_where_it_can_and_follows_the_supply() -> None:
    time = np.arange(0, 6, 0.02)
    setup = {"mass": 1.0, "length": 0.2, "vin": 4.5}
    run = recording(BENCH, time, np.full(len(time), 1.5), setup=setup)
    limit = 1.6
    values = {"kp/servo": 20.0, "kd/servo": 0.2, "tau_max/servo": limit, "damping/servo": 0.3}
    q = replay(BENCH, (run,), values).position[0, -1, 0]
    assert q == pytest.approx(np.arcsin(limit * 4.5 / 6 / (G * 1.0 * 0.2)), abs=1e-6)


def test_mass_and_length_change_the_swing() -> None:
    time, angle = np.arange(2000) * STEP, 0.03
    off = {"torque_enabled": np.zeros(len(time))}
    runs = tuple(
        recording(BENCH, time, np.zeros(len(time)), angle, id=f"l{x}", extras=off, setup=setup)
        for x, setup in enumerate(({"length": 0.3, "mass": 0.05}, {"length": 0.05, "mass": 1.5}))
    )
    both = replay(BENCH, runs, {"armature": 0.002}).position[0].reshape(2, -1)
    for q, (mass, length) in zip(both, ((0.05, 0.3), (1.5, 0.05)), strict=True):
        inertia = mass * length**2 + ARM + 0.002
        rate = np.sqrt(mass * G * length / inertia)
        assert q == pytest.approx(angle * np.cos(rate * time), abs=angle * 3e-3)


def test_a_clipped_force_against_viscous_damping_reaches_its_speed() -> None:
    """Where the servo clips, its own damping does nothing: what is outside it is left."""
    emps = RobotDescription.load("emps")
    time = np.arange(0, 2, 0.001)
    force, viscous, mass = 50.0, 500.0, 95.11
    run = recording(emps, time, np.full(len(time), 0.26))
    values = {"tau_max/axis": force, "damping/axis": viscous, "armature": 0.0}
    x = replay(emps, (run,), values).position[0, :, 0]
    speed, lag = force / viscous, mass / viscous
    assert x == pytest.approx(speed * (time - lag * (1 - np.exp(-time / lag))), abs=1e-4)
    assert np.diff(x)[-200:] / 0.001 == pytest.approx(speed, rel=1e-4)


def test_coulomb_friction_holds_what_it_can() -> None:
    """Off the vertical, under a moment it covers it creeps (MuJoCo's is soft); else it slips."""
    time = np.arange(0, 1, 0.02)
    off = {"torque_enabled": np.zeros(len(time))}
    moment = MASS * G * LENGTH * np.sin(0.3)
    run = recording(BENCH, time, np.zeros(len(time)), 0.3, extras=off)
    ends = [
        replay(BENCH, (run,), {"coulomb/servo": share * moment}).position[0, -1, 0]
        for share in (1.5, 1.1, 0.5)
    ]
    assert ends[:2] == pytest.approx([0.3, 0.3], abs=0.03)
    assert ends[2] < 0.1


def stepping(moves_at: float, time: Array) -> Array:
    return np.where(time >= moves_at - 1e-9, 0.5, 0.0)


@pytest.mark.parametrize("actuator", ["pd", "nn_pd"])
def test_a_delay_of_whole_substeps_is_a_later_command(actuator: str) -> None:
    time = np.arange(300) * STEP
    early, late = (recording(BENCH, time, stepping(t, time)) for t in (0.1, 0.1 + 7 * STEP))
    delayed = replay(BENCH, (early,), {"command_delay": 7 * STEP}, actuator)
    moved = replay(BENCH, (late,), {"command_delay": 0.0}, actuator)
    plain = replay(BENCH, (late,), {}, actuator)
    assert delayed.position == pytest.approx(moved.position, abs=1e-12)
    assert np.array_equal(moved.position, plain.position)


def test_a_delay_is_continuous() -> None:
    """Twenty delays over two sub-steps: twenty even steps of the trajectory."""
    time = np.arange(100) * STEP
    run = recording(BENCH, time, 0.2 * stepping(0.05, time))  # small: clipped, steps are uneven
    delays = np.linspace(4, 6, 21) * STEP
    space = space_of(BENCH, {"command_delay": 0.0})
    values = np.tile(space.nominal, (len(delays), 1))
    values[:, space.names.index("command_delay")] = delays
    q = MujocoSimulator(BENCH, (run,), "pd").replay(space.candidates(values)).position[:, 60, 0]
    moved = -np.diff(q)
    assert (moved > 0).all()
    assert moved.max() < 1.3 * moved.mean()


def test_uneven_ticks_see_what_even_ones_see() -> None:
    """On the grid of sub-steps: the same commands sent at few ticks or repeated at every one."""
    rng = np.random.default_rng(4)
    steps = np.sort(rng.choice(np.arange(1, 500), size=40, replace=False))
    few = np.concatenate([[0], steps])
    targets = rng.uniform(-0.5, 0.5, len(few))
    uneven = recording(BENCH, few * STEP, targets)
    every = np.arange(500)
    held = targets[np.searchsorted(few, every, side="right") - 1]
    even = recording(BENCH, every * STEP, held)
    q_few = replay(BENCH, (uneven,), {}).position[0]
    q_every = replay(BENCH, (even,), {}).position[0]
    assert q_few == pytest.approx(q_every[few], abs=1e-10)


def test_ticks_between_substeps_change_nothing() -> None:
    """Off the grid: ticks that repeat a command leave the others' positions as they are."""
    rng = np.random.default_rng(5)
    time = np.cumsum(rng.uniform(0.013, 0.041, 30)) + 100.0
    targets = rng.uniform(-0.5, 0.5, len(time))
    between = time[:-1] + rng.uniform(0.2, 0.8, len(time) - 1) * np.diff(time)
    both = np.argsort(np.concatenate([time, between]))
    dense_time = np.concatenate([time, between])[both]
    dense_target = np.concatenate([targets, targets[:-1]])[both]
    sparse = replay(BENCH, (recording(BENCH, time, targets),), {}).position[0]
    dense = replay(BENCH, (recording(BENCH, dense_time, dense_target),), {}).position[0]
    assert dense[::2] == pytest.approx(sparse, abs=1e-10)


def standing(id: str, seconds: float, seed: int, **more: Any) -> Recording:
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(1 / 33, 1 / 25, int(seconds * 28)))
    pose = np.array(OP2.poses["half_squat"])
    target = pose + rng.uniform(-0.05, 0.05, (len(time), len(pose)))
    return recording(OP2, time, target, pose, "ground", id=id, **more)


def hanging(id: str, seconds: float, seed: int) -> Recording:
    run = standing(id, seconds, seed)
    return replace(run, support="suspended")


def op2_candidates(actuator: str, count: int) -> Any:
    space = robot_space(OP2, actuator)
    unit = np.random.default_rng(1).uniform(0.2, 0.6, (count, len(space)))
    return space.candidates(space.denormalise(unit))


@pytest.mark.parametrize("actuator", ["pd", "nn_pd"])
def test_results_do_not_depend_on_the_company_to_the_last_bit(actuator: str) -> None:
    """Alone or among others, in whatever order, on one thread or two."""
    runs = (standing("a", 0.5, 1), standing("b", 0.3, 2), hanging("c", 0.4, 3))
    candidates = op2_candidates(actuator, 7)
    together = MujocoSimulator(OP2, runs, actuator).replay(candidates)
    threaded = MujocoSimulator(OP2, runs, actuator, threads=2).replay(candidates)
    backwards = MujocoSimulator(OP2, runs, actuator).replay(candidates.rows(slice(None, None, -1)))
    for name in ("position", "tilt", "feet"):
        whole = getattr(together, name)
        assert np.array_equal(getattr(threaded, name), whole, equal_nan=True)
        assert np.array_equal(getattr(backwards, name)[::-1], whole, equal_nan=True)
    for i in (0, 6):
        alone = MujocoSimulator(OP2, runs, actuator).replay(candidates.rows(slice(i, i + 1)))
        assert np.array_equal(alone.position[0], together.position[i])
    for run, part in zip(runs, together.ticks, strict=True):
        alone = MujocoSimulator(OP2, (run,), actuator).replay(candidates.rows(slice(3, 4)))
        assert np.array_equal(alone.position[0], together.position[3, part])


@pytest.mark.parametrize("actuator", ["pd", "nn_pd"])
def test_one_joint_alone_or_in_company_is_the_same_to_the_last_bit(actuator: str) -> None:
    """A batch of a single number takes other paths through NumPy."""
    time = np.arange(0, 0.5, 0.03)
    run = recording(BENCH, time, 0.3 * np.sin(9 * time))
    space = robot_space(BENCH, actuator)
    unit = np.random.default_rng(1).uniform(0.2, 0.8, (9, len(space)))
    simulator = MujocoSimulator(BENCH, (run,), actuator)
    together = simulator.replay(space.candidates(space.denormalise(unit))).position
    for i in range(9):
        alone = simulator.replay(space.candidates(space.denormalise(unit[i : i + 1]))).position
        assert np.array_equal(alone[0], together[i])


def test_a_simulation_that_breaks_down_is_told_and_leaves_its_neighbours_alone() -> None:
    time = np.arange(0, 1, 0.03)
    run = recording(BENCH, time, stepping(0.3, time))
    calm = recording(BENCH, time, np.zeros(len(time)), id="s")
    space = robot_space(BENCH, "pd")
    values = np.tile(space.nominal, (3, 1))
    for name in ("kp/servo", "tau_max/servo"):
        values[1, space.names.index(name)] = 1e15
    simulator = MujocoSimulator(BENCH, (run, calm), "pd")
    told = simulator.replay(space.candidates(values))
    assert told.diverged.tolist() == [[False, False], [True, False], [False, False]]
    lost = np.isnan(told.position[1, told.ticks[0], 0])
    assert not lost[0]
    assert (np.diff(lost.astype(int)) >= 0).all(), "from one tick on, to the end"
    alone = simulator.replay(space.candidates(values[:1]))
    assert np.array_equal(told.position[0], alone.position[0])
    assert np.array_equal(told.position[2], alone.position[0])


def test_ground_and_suspended_stand_in_one_call() -> None:
    runs = (standing("a", 0.4, 1), hanging("b", 0.3, 2), standing("c", 0.2, 3))
    told = MujocoSimulator(OP2, runs, "pd").replay(op2_candidates("pd", 2))
    ground, air = np.r_[told.ticks[0], told.ticks[2]], told.ticks[1]
    assert np.isfinite(told.position).all()
    assert np.isfinite(told.tilt[:, ground]).all()
    assert np.isfinite(told.feet[:, ground]).all()
    assert np.isnan(told.tilt[:, air]).all()
    assert np.isnan(told.feet[:, air]).all()


def test_the_first_tick_is_the_recorded_start() -> None:
    """Where a joint was not read at first, the next reading before a command stands for it.

    A reading after its target has changed is of another pose: then the first target stands.
    """
    run = standing("a", 0.4, 1, extras={"imu/roll": np.full(11, 0.03), "imu/pitch": np.zeros(11)})
    position = run.position.copy()
    position[0, 4] = np.nan
    position[1, 4] = 0.21
    position[:, 5] = np.where(np.arange(len(position)) == 3, 0.3, np.nan)
    told = MujocoSimulator(OP2, (replace(run, position=position),), "nn_pd").replay(
        op2_candidates("nn_pd", 2)
    )
    start = np.where(np.arange(20) == 4, 0.21, run.position[0])
    start[5] = run.target[0, 5]
    assert np.array_equal(told.position[:, 0], np.tile(start, (2, 1)))
    assert told.tilt[:, 0] == pytest.approx(np.tile([0.03, 0.0], (2, 1)), abs=1e-12)
    soles = told.feet[:, 0, :, 2]
    assert (soles > 0).all()
    assert (soles < 0.06).all(), "ankles stand as high as the robot's feet are"


def test_a_robot_in_the_air_falls_freely() -> None:
    """Its root obeys gravity alone: half a g t squared."""
    time = np.arange(50) * STEP * 4
    pose = np.array(OP2.poses["half_squat"])
    run = recording(OP2, time, np.tile(pose, (len(time), 1)), pose, "ground")
    simulator = MujocoSimulator(OP2, (run,), "pd")
    (group,) = simulator.groups
    high = group.start.copy()
    high[:, 2] += 1.0
    simulator.groups = (replace(group, start=high),)
    told = simulator.replay(op2_candidates("pd", 2))
    k = np.arange(50) * 4
    fallen = told.feet[:, 0, :, 2][:, None] - told.feet[..., 2]
    assert fallen == pytest.approx(
        np.broadcast_to((G * STEP**2 * k**2 / 2)[None, :, None], fallen.shape), abs=1e-9
    )
    assert told.position == pytest.approx(np.broadcast_to(pose, told.position.shape), abs=1e-9)


def test_two_milliseconds_are_fine_enough() -> None:
    """A tenth of the sub-step changes a leg's steps of 0.3 rad by less than 0.3 mrad."""
    leg = RobotDescription.load("darwin_leg")
    rng = np.random.default_rng(3)
    middle = np.array([0.0, -0.4, 0.5, -1.0, -0.3, 0.1])
    target = middle + np.repeat(rng.uniform(-0.3, 0.3, (4, 6)), 15, axis=0)
    taken = recording(leg, np.arange(60) / 30, target, middle, "suspended")
    fine = replace(leg, timestep=leg.timestep / 10)
    ours, finer = (
        MujocoSimulator(robot, [taken], "pd").replay(robot_space(robot, "pd").candidates())
        for robot in (leg, fine)
    )
    assert np.sqrt(np.mean((ours.position - finer.position) ** 2)) < 3e-4


def test_stiff_servos_near_their_limit_move_as_with_fine_substeps() -> None:
    """Damping that stops a light link within a sub-step must not make its servo chatter."""
    run = load_recordings([OP2.model_path.parent / "recordings" / "step_0.6_0.parquet"])
    gains = {"arm": (11, 0.95, 3.4), "head": (13, 0.95, 2.1), "hip": (20, 1.5, 6.0)}
    gains |= {"knee": (22, 1.7, 6.0), "ankle": (14, 1.1, 4.4)}
    values = {"armature": 5e-4}
    for group, told in gains.items():
        values |= {
            f"{k}/{group}": float(v) for k, v in zip(("kp", "kd", "tau_max"), told, strict=True)
        }
    coarse, fine = (
        replay(replace(OP2, timestep=step), run, values).position for step in (STEP, STEP / 8)
    )
    assert np.sqrt(np.mean((coarse - fine) ** 2)) < 1e-3


def test_steps_are_not_timed() -> None:
    """A clock that MuJoCo reads at each stage costs 40 % of a step of one joint, for no one."""
    path = next(Path(mujoco.__file__).parent.glob("libmujoco*"))
    assert ctypes.c_void_p.in_dll(ctypes.CDLL(str(path)), "mjcb_time").value is None
    robot = RobotDescription.load("servo_bench")
    model = compile_model(robot, "bench").compiled
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    assert data.timer[mujoco.mjtTimer.mjTIMER_STEP].duration == 0
