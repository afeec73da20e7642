"""The Brax engine against the MuJoCo engine, at small size on the CPU.

A model is compiled anew by XLA in every test that simulates: 10 to 40 s each on one core.
"""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from biped import biped, biped_bounds
from commandline import pup
from test_simulator import recording

from pup.errors import InputError
from pup.locomotion.sampling import ParameterSampler
from pup.locomotion.settings import TaskSettings
from pup.locomotion.task import WalkingTask
from pup.physics import engine as engines
from pup.physics.engine import Engine, make_simulator
from pup.physics.parameters import Candidates, ParameterSpace, robot_space
from pup.physics.simulator import Trajectories
from pup.recording import Recording, load_recordings, write_recordings
from pup.robot import RobotDescription
from services.replay import model_of

BENCH, LEG = (RobotDescription.load(name) for name in ("servo_bench", "darwin_leg"))
OP2 = RobotDescription.load("darwin_op2")
SHIPPED = OP2.folder / "recordings"
SECOND = 1.0

installed = pytest.mark.skipif(
    engines.find_spec("brax") is None or engines.find_spec("jax") is None,
    reason="the extra `brax` is not installed",
)


def commanded(robot: RobotDescription, seconds: float, seed: int, **more: object) -> Recording:
    """Random steps about the middle of the joints' ranges at an uneven rate."""
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(1 / 33, 1 / 25, round(seconds * 28)))
    lower, upper = (np.array([getattr(j, end) for j in robot.joints]) for end in ("lower", "upper"))
    steps = rng.uniform(-0.4, 0.4, (3, len(robot.joints)))
    target = np.clip(
        (lower + upper) / 2 + steps[np.arange(len(time)) * 3 // len(time)], lower, upper
    )
    position = np.full(target.shape, np.nan)
    position[0] = target[0] + 0.1
    told = {"id": f"r{seed}", "motion": "step", "support": "bench", "source": "simulation"}
    return Recording(
        robot=robot.name, joints=robot.joint_names, time=time, target=target, position=position,
        **(told | more),
    )  # fmt: skip


def several(space: ParameterSpace, count: int, spread: float = 0.3) -> Candidates:
    """The nominal candidate and others about it."""
    off = np.random.default_rng(1).uniform(-spread, spread, (count, len(space)))
    off[0] = 0.0
    unit = np.clip(space.normalise(space.nominal) + off, 0.02, 0.98)
    return space.candidates(space.denormalise(unit))


def both(
    robot: RobotDescription, runs: list[Recording], candidates: Candidates, actuator: str
) -> tuple[Trajectories, Trajectories]:
    mujoco, brax = (make_simulator(e, robot, runs, actuator, 1).replay(candidates) for e in Engine)
    return mujoco, brax


# --- Without JAX ----------------------------------------------------------------------------------


def test_an_engine_that_is_not_installed_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engines, "find_spec", lambda name: None)
    write_recordings([commanded(BENCH, 0.3, 1)], tmp_path)
    told = pup(
        *("replay", tmp_path / "r1.parquet", "--robot", "servo_bench"),
        *("--engine", "brax", "--out", tmp_path / "out"),
    )
    assert (
        told.code == 2
        and "constraints.txt '.[brax]'" in told.err
        and len(told.err.splitlines()) == 1
    )
    assert not list((tmp_path / "out").glob("*"))


def test_jax_is_imported_only_where_the_engine_is_chosen() -> None:
    modules = "pup.locomotion.task, pup.sysid.problem, services.replay, services.cli"
    code = f"import sys, {modules}; sys.exit('jax' in sys.modules or 'brax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=120).returncode == 0


def test_a_policy_walks_in_mujoco_only(tmp_path: Path) -> None:
    told = pup(
        *("replay", "--policy", tmp_path, "--robot", "darwin_op2"),
        *("--engine", "brax", "--out", tmp_path / "out"),
    )
    assert told.code == 2 and "--engine brax" in told.err


def test_more_robots_than_a_processor_can_step_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("brax")
    given = ("train", "--robot", "darwin_op2", "--engine", "brax", "--simulations", 64)
    told = pup(*given, "--out", tmp_path / "out")
    assert told.code == 2 and "--simulations 16" in told.err and len(told.err.splitlines()) == 1
    assert not (tmp_path / "out" / "checkpoint.npz").exists()


# --- With it --------------------------------------------------------------------------------------


@installed
def test_what_mjx_cannot_simulate_is_refused(tmp_path: Path) -> None:
    """One line that names the robot and what it is; before anything is compiled."""
    model = (BENCH.folder / "model.xml").read_text()
    (tmp_path / "robot.toml").write_text((BENCH.folder / "robot.toml").read_text())
    for old, new, what in (
        ("<option ", '<option density="1.2" ', "fluid"),
        ("<option ", '<option noslip_iterations="3" ', "noslip_iterations"),
    ):
        (tmp_path / "model.xml").write_text(model.replace(old, new))
        robot = RobotDescription.load(str(tmp_path))
        with pytest.raises(InputError, match=what) as refused:
            make_simulator(Engine.BRAX, robot, [commanded(robot, 0.3, 1)], "pd", 1)
        assert "'servo_bench'" in str(refused.value) and "\n" not in str(refused.value)


@installed
def test_terms_are_refused() -> None:
    space = robot_space(BENCH, "pd")
    term = ParameterSpace(
        ("backlash/width@servo",), ("rad",), np.array([0.01]), np.zeros(1), np.ones(1)
    )
    simulator = make_simulator(Engine.BRAX, BENCH, [commanded(BENCH, 0.3, 1)], "pd", 1)
    with pytest.raises(InputError, match="backlash"):
        simulator.replay(space.plus(term).candidates())


@installed
def test_a_servo_moves_as_in_mujoco() -> None:
    """PD with its limit, delays, knobs, dry friction and torque off; one candidate breaks down."""
    space = robot_space(BENCH, "pd").plus(
        ParameterSpace(
            ("command_delay", "coulomb/servo", "damping/servo"), ("s", "N m", "N m s/rad"),
            np.array([0.0033, 0.02, 0.01]), np.zeros(3), np.array([0.05, 0.1, 0.05]),
        )
    )  # fmt: skip
    candidates = several(space, 4)
    for name in ("kp/servo", "tau_max/servo"):
        candidates.values[3, candidates.index[name]] = 1e15
    first, second = commanded(BENCH, SECOND, 1), commanded(BENCH, 0.6, 2)
    enabled = (np.arange(len(first.time)) % 9 > 1).astype(float)
    fast = np.arange(0, 0.2, 0.0007)  # commands, more than one in a sub-step
    runs = [
        replace(first, extras={"torque_enabled": enabled}),
        recording(BENCH, fast, np.sin(20 * fast), 0.1, id="fast"),
        replace(second, setup={"mass": 0.5, "length": 0.15, "vin": 5.0}),
    ]
    mujoco, brax = both(BENCH, runs, candidates, "pd")
    np.testing.assert_array_equal(brax.diverged, mujoco.diverged)
    assert mujoco.diverged[3].all() and not mujoco.diverged[:3].any()
    assert np.ptp(mujoco.position[:3], axis=1).min() > 0.1
    np.testing.assert_allclose(brax.position[:3], mujoco.position[:3], atol=1e-6)


@installed
def test_a_leg_moves_as_in_mujoco() -> None:
    """NN-PD with all of its 27 weights different; the bar is 1e-3 rad over 1 s."""
    candidates = several(robot_space(LEG, "nn_pd"), 2, 0.1)
    mujoco, brax = both(LEG, [commanded(LEG, SECOND, 3)], candidates, "nn_pd")
    assert np.ptp(mujoco.position, axis=1).min() > 0.1
    np.testing.assert_allclose(brax.position, mujoco.position, atol=1e-6)


@installed
def test_a_biped_is_stepped_as_in_mujoco_until_its_feet_decide(tmp_path: Path) -> None:
    """In the air to single precision; on the floor, like it; resumed, to the last bit."""
    robot = biped(tmp_path)
    sampler = ParameterSampler(biped_bounds(robot))
    settings = TaskSettings(position_noise=0.0, tilt_noise=0.0, horizon=0.5)
    tasks = [
        WalkingTask(robot, sampler, settings, 4, np.random.default_rng(0), 1, engine)
        for engine in Engine
    ]
    actions = np.random.default_rng(1).integers(3, 8, (24, 4, 2))
    for task in tasks:
        task.reset()
    one, other = ([task.step(action) for action in actions] for task in tasks)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(b.live, a.live)
        np.testing.assert_array_equal(b.truncated, a.truncated)
        off = b.observation.proprioception - a.observation.proprioception
        assert np.sqrt((off[:, :4] ** 2).mean()) < 0.05
        assert np.isfinite(b.reward).all()
    assert any(step.truncated.any() for step in one), "episodes begin anew"
    brax = tasks[1]
    state = brax.state()
    ahead = [brax.step(action).observation.proprioception for action in actions[:4]]
    brax.restore(state)
    again = [brax.step(action).observation.proprioception for action in actions[:4]]
    np.testing.assert_array_equal(ahead, again)


@installed
@pytest.mark.slow
def test_the_whole_robot_moves_as_in_mujoco() -> None:
    """The shipped step recordings, suspended, under the identified parameters and others."""
    files = [SHIPPED / f"step_{size}_0.parquet" for size in ("0.1", "0.3", "0.6")]
    runs = load_recordings(files, OP2)
    actuator, space, _ = model_of(OP2, None)
    mujoco, brax = both(OP2, runs, several(space, 3, 0.1), actuator)
    assert np.ptp(mujoco.position, axis=1).max() > 1.0
    np.testing.assert_allclose(brax.position, mujoco.position, atol=1e-5)


@installed
@pytest.mark.slow
@pytest.mark.ray
def test_a_short_training_runs(tmp_path: Path) -> None:
    pytest.importorskip("gymnasium")
    told = pup(
        *(
            "train",
            "--engine",
            "brax",
            "--out",
            tmp_path / "out",
            "--steps",
            1000,
            "--pattern",
            0,
            "--cores",
            1,
        ),
        *("--simulations", 8, "--length", 8, "--minibatch", 32, "--json"),
    )
    assert told.code == 0, told.err
    assert told.json()["provenance"]["options"]["engine"] == "brax"
    assert (tmp_path / "out" / "policy" / "weights.npz").exists()
