"""Equation 1 of a robot whose joints turn and slide: neither outweighs the other by its unit."""

import numpy as np
import pytest
from numpy.typing import NDArray
from recordings import make
from walking import DARWIN

from pup.physics.parameters import robot_space
from pup.physics.simulator import Trajectories, tick_slices
from pup.recording import Recording
from pup.robot import RobotDescription
from pup.sysid.loss import ReplayLoss
from pup.sysid.problem import Problem

Array = NDArray[np.float64]
MODEL = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="cart">
      <joint name="rail" type="slide" axis="1 0 0" range="-0.1 0.1"/>
      <inertial mass="1" pos="0 0 0" diaginertia="1e-3 1e-3 1e-3"/>
      <body name="arm">
        <joint name="turn" axis="0 1 0" range="-2 2"/>
        <inertial mass="0.2" pos="0 0 -0.1" diaginertia="1e-3 1e-3 1e-3"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
ROBOT = """
schema = 1
name = "crane"
joint = [
  { name = "rail", group = "rail", lower = -0.1, upper = 0.1 },
  { name = "turn", group = "turn", lower = -2.0, upper = 2.0 },
]
parameter = [
  { name = "kp/*", unit = "", nominal = 30.0, search = [1.0, 90.0], actuators = ["pd"] },
  { name = "kd/*", unit = "", nominal = 2.0, search = [0.1, 9.0], actuators = ["pd"] },
  { name = "tau_max/*", unit = "", nominal = 9.0, search = [1.0, 20.0], actuators = ["pd"] },
  { name = "armature", unit = "", nominal = 0.01, search = [0.001, 0.1], actuators = ["pd"] },
]
"""
UNIT = 0.2 / np.pi
"""m of the rail that stand for a radian."""


@pytest.fixture(scope="module")
def crane(tmp_path_factory: pytest.TempPathFactory) -> RobotDescription:
    folder = tmp_path_factory.mktemp("crane")
    (folder / "model.xml").write_text(MODEL)
    (folder / "robot.toml").write_text(ROBOT)
    return RobotDescription.load(folder)


def at_rest(robot: RobotDescription, ticks: int = 4) -> Recording:
    still = np.zeros((ticks, len(robot.joints)))
    joints = robot.joint_names
    time = np.arange(ticks) / 30
    return make(robot=robot.name, joints=joints, time=time, target=still, position=still)


def off_by(run: Recording, position: Array) -> Trajectories:
    """A replay with these positions at every tick, shape (n_joints,)."""
    n = len(run.time)
    absent = np.full((1, n, 2), np.nan), np.full((1, n, 0, 3), np.nan)
    return Trajectories(tick_slices([run]), np.tile(position, (1, n, 1)), *absent)


def test_a_slide_counts_by_shares_of_its_range(crane: RobotDescription) -> None:
    run = at_rest(crane)
    loss, seen = ReplayLoss(crane, [run]), off_by(run, np.array([3 * UNIT, 4.0]))
    assert loss.terms(seen).position == pytest.approx(np.array([[4 * 5.0]]))
    assert loss.errors(seen)[0][0, 0] == pytest.approx([3.0, 4.0])
    weighted, blocks = loss.weighted_errors(seen)
    assert np.sqrt(np.add.reduceat(weighted[0] ** 2, blocks)) == pytest.approx([5.0] * 4)
    assert loss.rmse(seen)[0, 0] == pytest.approx([3 * UNIT, 4.0])  # m, rad


def test_a_slide_that_breaks_down_is_off_by_its_range(crane: RobotDescription) -> None:
    run = at_rest(crane)
    loss, seen = ReplayLoss(crane, [run]), off_by(run, np.full(2, np.nan))
    assert loss.terms(seen).position == pytest.approx(np.array([[4 * np.pi * np.sqrt(2)]]))
    assert loss.rmse(seen)[0, 0] == pytest.approx([0.2, np.pi])


def test_what_moves_a_slide_alone_is_seen(crane: RobotDescription) -> None:
    """Another stiffness of the rail costs as much as one of the arm that is off by as much."""
    time = np.arange(30) / 30
    target = 0.3 * np.sin(6 * time)[:, None] * [UNIT, 1.0]
    run = make(robot="crane", joints=crane.joint_names, time=time, target=target, position=target)
    space = robot_space(crane, "pd")
    problem = Problem(crane, (run,), "pd", space, ("kp/rail", "kp/turn"))
    error = problem.loss.errors(problem.replay(np.full((1, 2), 0.3)))[0][0]
    rail, turn = np.sqrt((error**2).mean(axis=0))
    assert 0.2 < rail / turn < 5.0


def test_robots_whose_joints_turn_keep_their_bits() -> None:
    run = at_rest(DARWIN)
    loss = ReplayLoss(DARWIN, [run])
    assert (loss.units == 1.0).all()
    away = np.random.default_rng(0).normal(size=len(DARWIN.joints))
    away[3] = np.nan
    expected = np.where(np.isnan(away), np.pi, away)
    seen = off_by(run, away)
    assert np.array_equal(loss.errors(seen)[0][0], np.tile(expected, (4, 1)))
    each = np.sqrt((np.tile(expected, (4, 1)) ** 2).sum(axis=1))
    assert np.array_equal(loss.terms(seen).position, [[np.add.reduceat(each, [0])[0]]])
