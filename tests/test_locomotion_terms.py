"""The walking task with terms: what acts is the replay's, simulation by simulation."""

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from test_simulator import recording
from test_terms import a_term
from walking import DARWIN, EXACT, JOINTS, QPOS, QVEL, idle, random_actions, walking

from pup.errors import InputError
from pup.locomotion.sampling import ParameterSampler
from pup.locomotion.settings import TaskSettings
from pup.locomotion.simulations import Motion, Pose, Simulations
from pup.locomotion.task import WalkingTask
from pup.physics.mujoco_batch import MujocoSimulator, Run
from pup.physics.outfit import mount
from pup.physics.parameters import Candidates, robot_space
from pup.physics.rotations import multiply, roll_pitch
from pup.physics.terms import TERMS, Place, split_column, term_space
from pup.physics.terms.learned import LearnedLaw
from pup.recording import Recording
from pup.robot import RobotDescription, TermSpec
from pup.sysid.result import FittedBounds

Array = NDArray[np.float64]
Row = Mapping[str, float]

SQUAT = np.array(DARWIN.poses["half_squat"])
SUBSTEPS = 8
PERIOD = SUBSTEPS * DARWIN.timestep
LAW = {f"learned_law/{q.name}@joint:l_knee": 0.1 * q.typical for q in LearnedLaw.quantities}


def space_with(rows: Sequence[Row], actuator: str) -> Candidates:
    """The robot with the terms of each row."""
    space = robot_space(DARWIN, actuator)
    places: dict[tuple[str, Place], None] = {}
    for name in (name for row in rows for name in row):
        term = split_column(name)
        assert term is not None
        places[term[0], term[2]] = None
    for effect, place in places:
        space = space.plus(term_space(effect, place))
    return space.candidates(np.stack([space.at(row).nominal for row in rows]))


def swaying(seconds: float) -> Array:
    """Targets around the half-squat, one for each control step."""
    count = round(seconds / PERIOD)
    sway = 0.15 * np.sin(9 * PERIOD * np.arange(count))[:, None]
    return SQUAT + sway + 0.05 * np.random.default_rng(0).standard_normal((count, JOINTS))


def told_and_read(targets: Array, clock: float = 1.0) -> tuple[Recording, NDArray[np.int64]]:
    """A recording of targets, and its rows at which the task reads.

    A target belongs to the sub-steps that follow, and to a replay's sub-step belongs what is told
    from half a sub-step before it on.
    """
    read = PERIOD * np.arange(len(targets) + 1)
    told = clock * (read[:-1] - DARWIN.timestep / 2) + 1e-12  # round-off shall bring none earlier
    time = np.unique(np.concatenate([read, told[1:]]))
    held = np.maximum(np.searchsorted(told, time + 1e-12) - 1, 0)
    imu = {f"imu/{angle}": np.full(len(time), 0.02) for angle in ("roll", "pitch")}
    run = recording(DARWIN, time, targets[held], SQUAT, "ground", extras=imu)
    return run, np.searchsorted(time, read - 1e-12)


def both_ways(
    candidates: Candidates, actuator: str, targets: Array, clock: float = 1.0
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Positions and tilts as read after each control step: by the task's physics, by a replay's.

    Both start from where the replay does, a sub-step's half behind in velocity.
    """
    run, reads = told_and_read(targets, clock)
    simulator = MujocoSimulator(DARWIN, [run], actuator)
    replayed = simulator.replay(candidates)
    begun = Run(DARWIN, simulator.groups[0], candidates, simulator.law)
    n, largest = len(candidates), candidates.space.candidates(candidates.values.max(axis=0))
    ours = Simulations(DARWIN, largest, actuator, n, SUBSTEPS, PERIOD, 1)
    ours.start(
        np.arange(n), candidates, np.full(n, PERIOD / SUBSTEPS * clock), begun.qpos, begun.qvel
    )
    state = ours.state() | {"physics": begun.batch.state.copy()}
    link = begun.qpos[:, begun.group.model.qpos], begun.qvel[:, begun.group.model.dofs]
    sensed = begun.servos.sense(link[0].copy(), link[1].copy())
    state |= {"before": sensed[1].copy(), "velocity": sensed[1].copy()}
    state |= {"sensed_position": sensed[0].copy(), "sensed_velocity": sensed[1].copy()}
    state |= {
        f"{t.effect}/{name.strip('_')}": getattr(t, name) for t in begun.terms for name in t.state
    }
    for name in ("read_position", "read_torso"):  # nothing has moved before the start
        if name in state:
            now = sensed[0] if name == "read_position" else begun.qpos[:, 3:7]
            state[name] = np.repeat(now[:, None], state[name].shape[1], axis=1)
    ours.restore(state)
    seen = []
    for target in targets:
        motion = ours.step(np.broadcast_to(target, (n, JOINTS)), np.ones(n, dtype=bool))
        assert not motion.lost.any()
        tilt = roll_pitch(multiply(motion.imu, mount(DARWIN, begun.group.model)))
        seen.append((motion.encoders, tilt))
    position, tilt = (np.stack(told, axis=1) for told in zip(*seen, strict=True))
    return (position, tilt), (replayed.position[:, reads[1:]], replayed.tilt[:, reads[1:]])


EFFECTS = [effect for effect in TERMS if effect != "clock_skew"]


@pytest.mark.parametrize(
    ("actuator", "seconds", "tolerance"), [("pd", 1.0, 1e-9), ("nn_pd", 0.4, 1e-7)]
)
def test_every_effect_acts_as_in_a_replay(actuator: str, seconds: float, tolerance: float) -> None:
    """On the ground from the same state, one simulation for each effect.

    The NN-PD computes its gains in single precision, which makes more of a rounding.
    """
    rows = [{}, *(a_term(effect, DARWIN) for effect in EFFECTS), LAW]
    ours, replayed = both_ways(space_with(rows, actuator), actuator, swaying(seconds))
    for read, expected in zip(ours, replayed, strict=True):
        np.testing.assert_allclose(read, expected, atol=tolerance)
    moved = np.max([np.abs(told - told[:1]).max(axis=(1, 2)) for told in ours], axis=0)
    still = [effect for effect, by in zip(EFFECTS, moved[1:-1], strict=True) if by < 2e-4]
    assert still == [] if actuator == "pd" else ["torque_speed_limit"]  # here below its limit


def test_many_effects_together_act_as_in_a_replay() -> None:
    both: Row = {}
    for effect in ("backlash", "command_delay", "voltage_sag", "stribeck_friction"):
        both = {**both, **a_term(effect, DARWIN)}
    for effect in ("measurement_delay", "encoder_bias", "imu_delay", "ground_slope"):
        both = {**both, **a_term(effect, DARWIN, 2.0)}
    ours, replayed = both_ways(space_with([both], "pd"), "pd", swaying(1.0))
    for read, expected in zip(ours, replayed, strict=True):
        np.testing.assert_allclose(read, expected, atol=1e-9)


@pytest.mark.parametrize(("share", "tolerance"), [(0.01, 1e-9), (-0.002, 1e-3)])
def test_a_fast_clock_of_the_commands_shortens_the_control_period(
    share: float, tolerance: float
) -> None:
    """A command told at t comes at t / (1 + share), here and in a replay.

    A replay takes a sub-step's lateness where it begins, which brings commands that come later and
    later by so little of a sub-step early.
    """
    candidates = space_with([{"clock_skew/share@robot": share}], "pd")
    ours, replayed = both_ways(candidates, "pd", swaying(1.0), 1 + share)
    for read, expected in zip(ours, replayed, strict=True):
        np.testing.assert_allclose(read, expected, atol=tolerance)


def corrected(*specs: TermSpec) -> RobotDescription:
    return replace(DARWIN, terms=specs)


def spec(effect: str, share: float = 1.0) -> TermSpec:
    """An effect at its typical size, as a robot's description has it."""
    row = a_term(effect, DARWIN, share) if effect in TERMS else LAW
    named = [split_column(name) for name in row]
    assert named[0] is not None
    place = named[0][2]
    values = {n[1]: v for n, v in zip(named, row.values(), strict=True) if n is not None}
    return TermSpec(effect, place.kind, place.name, values)


EVERYTHING = corrected(*(spec(effect, 0.5) for effect in (*TERMS, "learned_law")))
NOISY = TaskSettings()


def task_with(
    robot: RobotDescription, settings: TaskSettings = NOISY, n: int = 6, **more: Any
) -> WalkingTask:
    """A task over parameters drawn from bounds of the PD."""
    space = more.pop("space", robot_space(robot, "pd"))
    pd = FittedBounds(
        actuator="pd",
        space=space,
        names=("kp/knee", "armature", *more.pop("names", ())),
        lower=np.array([10.0, 0.0005, *more.pop("lower", ())]),
        upper=np.array([20.0, 0.005, *more.pop("upper", ())]),
    )
    return walking(settings, n=n, sampler=ParameterSampler(pd), robot=robot, **more)


def test_a_task_of_all_effects_resumes_bit_by_bit_on_any_number_of_threads() -> None:
    """In the middle of episodes, before a reset, and after one."""
    settings = replace(NOISY, horizon=0.35)
    whole = task_with(EVERYTHING, settings)
    whole.reset()
    rng = np.random.default_rng(0)
    others: list[WalkingTask] = []
    for i in range(24):
        action = random_actions(rng, 6)
        if i in (4, 10, 13):
            other = task_with(EVERYTHING, settings, seed=99, threads=1 + len(others))
            other.restore({name: values.copy() for name, values in whole.state().items()})
            others.append(other)
        step = whole.step(action)
        for other in others:
            same = other.step(action)
            for name in ("reward", "terminated", "truncated", "live", "distance", "time"):
                np.testing.assert_array_equal(getattr(step, name), getattr(same, name))
            told, again = step.observation.proprioception, same.observation.proprioception
            np.testing.assert_array_equal(told, again)
    assert (whole.state()["episodes/steps"] < 12).all()  # all have started anew
    for other in others:
        for name, values in other.state().items():
            np.testing.assert_array_equal(values, whole.state()[name], err_msg=name)


def test_the_state_of_every_kind_of_effect_is_in_the_tasks_state() -> None:
    task = task_with(EVERYTHING, n=2)
    task.reset()
    before = task.state()
    for _ in range(3):
        task.step(idle(2))
    after = task.state()
    for effect, names in (
        ("backlash", ("drivetrain/position", "drivetrain/velocity")),
        ("stribeck_friction", ("stribeck_friction/bend",)),
        ("rising_static_friction", ("rising_static_friction/bend", "rising_static_friction/age")),
        ("actuator_lag", ("actuator_lag/lagging",)),
        ("voltage_sag", ("voltage_sag/left",)),
        ("integral_action", ("integral_action/sum",)),
        ("derivative_kick", ("derivative_kick/goal",)),
        ("target_rate_limit", ("target_rate_limit/goal",)),
        ("learned_law", ("learned_law/age",)),
        ("command_delay", ("held", "told")),
        ("measurement_delay", ("read_position",)),
        ("imu_delay", ("read_torso",)),
    ):
        for name in names:
            kept = f"simulations/{name}"
            assert len(after[kept]) == 2 and (after[kept] != before[kept]).any(), effect


def test_a_reset_of_one_simulation_leaves_the_others_bits_alone() -> None:
    """And starts that one as a task of its own does, whatever was before."""
    one, other = (task_with(EVERYTHING) for _ in range(2))
    one.reset(), other.reset()
    rng = np.random.default_rng(0)
    rest = np.array([0, 1, 3, 4, 5])
    for i in range(14):
        if i == 5:
            state = other.state()
            state["simulations/physics"][2, QPOS.start + 1] += 0.31  # 2 drifts off its line
            other.restore(state)
        action = random_actions(rng, 6, spread=2)
        step, same = one.step(action), other.step(action)
        assert step.live.all()
        assert same.terminated[2] == (i == 5) and same.live[2] == (i != 6)
        if i < 6:  # later, other noise is drawn
            np.testing.assert_array_equal(
                step.observation.proprioception[rest], same.observation.proprioception[rest]
            )
        told, again = one.state(), other.state()
        for name in (name for name in told if name.startswith("simulations/")):
            np.testing.assert_array_equal(told[name][rest], again[name][rest], err_msg=name)


def test_a_simulation_that_starts_anew_is_as_one_that_starts_first() -> None:
    rng = np.random.default_rng(3)
    space = robot_space(EVERYTHING, "pd")
    candidates = space.candidates(np.tile(space.nominal, (3, 1)))
    starts = task_with(EVERYTHING)._starts
    qpos, qvel = starts.draw(rng, 3)
    steps = np.array([0.004, 0.0045, 0.005])

    def of(n: int) -> Simulations:
        return Simulations(EVERYTHING, space.candidates(), "pd", n, SUBSTEPS, 0.03, 1)

    used, fresh = of(3), of(1)
    used.start(np.arange(3), candidates, steps, qpos, qvel)
    for target in swaying(0.1):
        used.step(np.tile(target, (3, 1)), np.ones(3, dtype=bool))
    again = np.array([1])
    own = candidates.rows(slice(1))
    poses = [
        simulations.start(rows, own, steps[:1], qpos[:1], qvel[:1])
        for simulations, rows in ((used, again), (fresh, np.arange(1)))
    ]
    for field in fields(Pose):
        np.testing.assert_array_equal(*(getattr(pose, field.name) for pose in poses))
    for target in swaying(0.1):
        mine = used.step(np.tile(target, (3, 1)), np.ones(3, dtype=bool))
        its = fresh.step(target[None], np.ones(1, dtype=bool))
        for field in fields(Motion):
            np.testing.assert_array_equal(getattr(mine, field.name)[1], getattr(its, field.name)[0])


def test_an_episode_starts_where_the_encoders_read_the_start_pose() -> None:
    """And the IMU tells the lean of the floor, on which the robot stands."""
    off = spec("encoder_bias", 3.0)
    slope = TermSpec("ground_slope", "ground", "", {"pitch": 0.05})
    tasks = [task_with(robot, EXACT, n=2) for robot in (DARWIN, corrected(off, slope))]
    seen = [task.reset().proprioception for task in tasks]
    np.testing.assert_allclose(seen[1][:, :40], seen[0][:, :40], atol=1e-6)
    np.testing.assert_allclose(
        seen[1][:, 40:] - seen[0][:, 40:], [[0, 0.05, 0, 0.05]] * 2, atol=1e-3
    )
    qpos = [task.state()["simulations/physics"][:, QPOS] for task in tasks]
    knee = 7 + DARWIN.joint_names.index("l_knee")
    np.testing.assert_allclose(qpos[0][:, knee] - qpos[1][:, knee], off.values["offset"])
    assert (np.abs(tasks[1]._starts._lowest(qpos[1])) < 1e-9).all()


def test_bounds_of_a_term_are_drawn_for_each_episode() -> None:
    """A corrected robot's play and delay within bounds of their own."""
    robot = corrected(spec("backlash"), spec("measurement_delay"))
    names = ("backlash/gap@joint:l_knee", "measurement_delay/time@joint:l_knee")
    task = task_with(
        robot, replace(NOISY, horizon=0.1), names=names, lower=(0, 0), upper=(0.05, 0.06)
    )
    mu = task.reset().true_parameters
    assert np.ptp(mu[:, 2]) > 0.1
    drives = next(t for t in task._simulations._parts[0].live.terms if t.effect == "drivetrain")
    for _ in range(9):
        told = np.clip(0.05 * task.state()["episodes/mu"][:, 2], 0, None)
        np.testing.assert_allclose(drives._gap[:, DARWIN.joint_names.index("l_knee")], told)
        task.step(idle(6))


@pytest.mark.parametrize(
    ("term", "words"),
    [
        (
            TermSpec("structural_flex", "body", "body", {"compliance": 0.01}),
            "place body:body: no joint carries it, so structural_flex cannot act",
        ),
        (TermSpec("clock_skew", "robot", "", {"share": -1.0}), "clock_skew: a clock at 0 of its"),
    ],
)
def test_a_term_that_cannot_act_is_refused_in_one_line(term: TermSpec, words: str) -> None:
    with pytest.raises(InputError, match=words) as refused:
        task_with(corrected(term))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("robot", [DARWIN, EVERYTHING], ids=["plain", "with all effects"])
def test_a_simulation_that_breaks_down_ends_its_episode_and_spoils_no_other(
    robot: RobotDescription,
) -> None:
    """Nor itself, once it has started anew."""
    sound, broken = (task_with(robot, n=4) for _ in range(2))
    sound.reset(), broken.reset()
    sound.step(idle(4)), broken.step(idle(4))
    state = broken.state()
    state["simulations/physics"][1, QVEL] = 1e9
    state["simulations/physics"][2, QPOS.start + 9] = np.nan
    broken.restore(state)
    for i in range(4):
        step, other = broken.step(idle(4)), sound.step(idle(4))
        assert np.isfinite(step.observation.proprioception).all()
        assert np.isfinite(step.reward).all() and np.isfinite(step.distance).all()
        np.testing.assert_array_equal(step.terminated, [False, i == 0, i == 0, False])
        np.testing.assert_array_equal(step.live, [True, i != 1, i != 1, True])
        np.testing.assert_array_equal(step.reward[[0, 3]], other.reward[[0, 3]])
        if i == 0:  # later, other noise is drawn
            np.testing.assert_array_equal(
                step.observation.proprioception[[0, 3]], other.observation.proprioception[[0, 3]]
            )
    for name, values in broken.state().items():
        assert not np.isnan(values.astype(float)).any(), name
