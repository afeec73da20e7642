"""Robots of one joint without an engine: the motion that MuJoCo gives, or left to it."""

from typing import Any

import mujoco
import mujoco.batch
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pup.physics.model import compile_model
from pup.physics.one_joint import OneJoint
from pup.robot import RobotDescription

Array = NDArray[np.float64]

N = 6
BENCH = compile_model(RobotDescription.load("servo_bench"), "bench").compiled
EMPS = compile_model(RobotDescription.load("emps"), "bench").compiled
LEG = compile_model(RobotDescription.load("darwin_leg"), "suspended").compiled


def batch_of(model: mujoco.MjModel, seed: int = 0) -> mujoco.batch.Batch:
    """Simulations whose bodies, rotors, damping, wrenches and starts are drawn."""
    rng = np.random.default_rng(seed)
    batch = mujoco.batch.Batch(model, N, 1)
    batch.expand("body_mass")[:] *= rng.uniform(0.5, 2.0, (N, 1))
    batch.expand("body_ipos")[:, -1] += rng.normal(size=(N, 3)) * 0.01
    batch.expand("dof_armature")[:] = rng.uniform(1e-4, 1e-2, (N, 1))
    batch.set_const()
    batch.expand("dof_damping")[:] = rng.uniform(0.0, 0.2, (N, 1))
    batch.bind("xfrc_applied")[:, -1] = rng.normal(size=(N, 6)) * 0.1
    batch.bind("qpos")[:] = rng.normal(size=(N, 1)) * 0.05
    batch.bind("qvel")[:] = rng.normal(size=(N, 1)) * 0.1
    return batch


def both(model: mujoco.MjModel, seed: int, forces: Array) -> tuple[Array, Array]:
    """Positions and velocities by MuJoCo and without it, each (n_steps, N, 2)."""
    out = []
    for alone in (False, True):
        batch = batch_of(model, seed)
        engine: Any = OneJoint.of(batch) if alone else batch
        assert engine is not None
        qpos, qvel, applied = (batch.bind(name) for name in ("qpos", "qvel", "qfrc_applied"))
        path = []
        for force in forces:
            applied[:] = force
            engine.step()
            path.append(np.hstack([qpos, qvel]))
        out.append(np.stack(path))
    return out[0], out[1]


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000))
@pytest.mark.parametrize("model", [BENCH, EMPS], ids=["hinge", "slide"])
def test_motion_is_that_of_mujoco(model: mujoco.MjModel, seed: int) -> None:
    size = 0.2 if model is BENCH else 5.0
    forces = np.random.default_rng(seed).normal(size=(300, N, 1)) * size
    theirs, own = both(model, seed, forces)
    assert np.ptp(theirs[..., 0]) > 1e-3
    assert np.abs(own - theirs).max() < 1e-11


def test_beyond_its_range_a_joint_is_left_to_mujoco() -> None:
    """A load that is pressed against its limit and comes back, to the solver's own precision."""
    forces = np.repeat(np.array([0.9, -0.3]), [700, 300])[:, None, None] * np.ones((1, N, 1))
    theirs, own = both(BENCH, 1, forces)
    assert (theirs[..., 0].max(axis=0) > np.pi).any()
    assert np.abs(own - theirs).max() < 1e-7


@pytest.mark.parametrize("name", ["qpos", "qvel", "qfrc_applied"])
@pytest.mark.parametrize("value", [np.nan, 1e12])
def test_what_breaks_down_is_told_as_mujoco_tells_it(name: str, value: float) -> None:
    told = []
    for alone in (False, True):
        batch = batch_of(BENCH)
        engine: Any = OneJoint.of(batch) if alone else batch
        batch.bind(name)[2] = value
        for _ in range(2):
            engine.step()
        told.append((batch.warning[:, :, 1] > 0, batch.bind("qpos").copy()))
    (theirs, there), (own, here) = told
    assert theirs[2].any()
    np.testing.assert_array_equal(own, theirs)
    others = np.arange(N) != 2
    np.testing.assert_allclose(here[others], there[others], atol=1e-12)


def test_only_the_chosen_move() -> None:
    batch = batch_of(BENCH)
    engine = OneJoint.of(batch)
    assert engine is not None
    before = batch.bind("qpos").copy()
    engine.step(ids=np.array([0, 3], dtype=np.int32))
    moved = (batch.bind("qpos") != before)[:, 0]
    assert list(np.flatnonzero(moved)) == [0, 3]


def test_learning_the_law_leaves_the_simulations_where_they_were() -> None:
    batch = batch_of(BENCH)
    batch.bind("qfrc_applied")[:] = 0.3
    before = {n: batch.bind(n).copy() for n in ("qpos", "qvel", "qfrc_applied", "xfrc_applied")}
    assert OneJoint.of(batch) is not None
    for name, values in before.items():
        np.testing.assert_array_equal(batch.bind(name), values)


@pytest.mark.parametrize(("field", "value"), [("dof_frictionloss", 0.01), ("jnt_stiffness", 0.5)])
def test_a_model_that_has_more_to_it_is_left_to_mujoco(field: str, value: float) -> None:
    batch = batch_of(BENCH)
    batch.expand(field)[3] = value  # in one of the simulations
    assert OneJoint.of(batch) is None


TENDON = """
<mujoco>
  <worldbody><body name="arm"><joint name="j"/><geom size="0.1" pos="0.1 0 0"/></body></worldbody>
  <tendon><fixed limited="true" range="-1.4 2.4"><joint joint="j" coef="1"/></fixed></tendon>
</mujoco>
"""


def test_a_tendon_that_is_slack_where_it_was_looked_at_is_left_to_mujoco() -> None:
    assert OneJoint.of(mujoco.batch.Batch(mujoco.MjModel.from_xml_string(TENDON), N, 1)) is None


def test_a_robot_of_more_joints_is_left_to_mujoco() -> None:
    assert OneJoint.of(mujoco.batch.Batch(LEG, N, 1)) is None
