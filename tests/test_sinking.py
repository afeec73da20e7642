"""A robot that rests has sunk into the floor before its recording begins."""

from dataclasses import replace

import numpy as np
import pytest

from pup.diagnosis.replays import union
from pup.physics.mujoco_batch import MujocoSimulator
from pup.physics.parameters import robot_space
from pup.physics.simulator import Trajectories
from pup.physics.terms import Place, column
from pup.recording import Recording, load_recordings
from pup.robot import RobotDescription

OP2 = RobotDescription.load("darwin_op2")
PERIOD, SETTLED = 0.03, 60
SOFT = column("ground_compliance", "time", Place("ground"))
"""s, by which contacts push back later."""


@pytest.fixture(scope="module")
def stand() -> Recording:
    """A stand of three seconds, as it begins: readings of the first tick alone."""
    (run,) = load_recordings([OP2.folder / "recordings" / "standup_2.parquet"])
    ticks = round(3 / PERIOD)
    held, read = (np.repeat(v[:1], ticks, axis=0) for v in (run.target, run.position))
    time = PERIOD * np.arange(ticks)
    return replace(run, time=time, target=held, position=read, extras={})


def simulated(run: Recording, soft: float) -> Trajectories:
    """What a robot of nominal parameters does on a soft floor."""
    nominal = robot_space(OP2, "pd")
    row = dict(zip(nominal.names, nominal.nominal, strict=True)) | {SOFT: soft}
    space = union(nominal, [row])
    simulator = MujocoSimulator(OP2, [run], "pd")
    return simulator.replay(space.candidates(np.array([[row[n] for n in space.names]])))


@pytest.mark.parametrize("soft", [0.0, 0.04, 0.1])
def test_who_stands_goes_on_standing(stand: Recording, soft: float) -> None:
    """Put on top of such a floor it would rock by up to 60 mrad for half a second."""
    whole = simulated(stand, soft)
    position, tilt = whole.position[0, SETTLED:], whole.tilt[0, SETTLED:]
    assert np.ptp(position, axis=0).max() < 2e-4
    rest = replace(
        stand,
        time=stand.time[: len(position)],
        target=stand.target[: len(position)],
        position=position,
        extras={"imu/roll": tilt[:, 0], "imu/pitch": tilt[:, 1]},
    )
    again = simulated(rest, soft)
    np.testing.assert_allclose(again.position[0], position, atol=2e-4)
    np.testing.assert_allclose(again.tilt[0], tilt, atol=1e-3)
