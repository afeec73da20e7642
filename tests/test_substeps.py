"""Sub-steps that are too long in contact are told by shorter ones, and are then not used."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recordings import make

from pup.diagnosis.coordinates import described_at
from pup.diagnosis.fit import Fit
from pup.diagnosis.nominal import Certificate, Nominal, free_names, nominal_coordinate
from pup.diagnosis.replays import Bench, Replays, threads
from pup.diagnosis.residuals import Measured, Noise
from pup.diagnosis.substeps import SHORTEST, shorter_stepped
from pup.physics.parameters import robot_space
from pup.recording import Recording
from pup.robot import RobotDescription
from pup.robot_writer import write_corrected

OP2 = RobotDescription.load("darwin_op2")
LIGHT = {"armature": 0.0005, "kd/knee": 1.0, "kd/hip": 0.9}
"""Small rotors that are damped strongly, as a sealed robot has them."""
SIGMA = 0.00125


def knees(support: str) -> Recording:
    """Steps of both knees, from how the Darwin stands."""
    assert OP2.gait is not None and OP2.gait.start is not None
    time = 0.01 * np.arange(150)
    pose = np.asarray(OP2.gait.start)
    target = np.tile(pose, (len(time), 1))
    for name in ("l_knee", "r_knee"):
        i = OP2.joint_names.index(name)
        target[:, i] += np.where(np.sin(2 * np.pi * 1.5 * time) > 0, 0.0, 0.1) * (time > 0.3)
    return make(
        robot=OP2.name,
        motion="stand",
        support=support,
        joints=OP2.joint_names,
        time=time,
        target=target,
        position=np.tile(pose, (len(time), 1)),
        extras={f"imu/{angle}": np.zeros(len(time)) for angle in ("roll", "pitch")},
    )


def asked(robot: RobotDescription, support: str, sigma: float) -> RobotDescription | None:
    """What is told of a fit that knows the robot."""
    measured, space = Measured.of(robot, [knees(support)]), robot_space(robot, "pd")

    def replays_of(some: Measured) -> Replays:
        return Replays(some, space, threads(Bench(some), 1), 1)

    free = tuple(nominal_coordinate(space, n) for n in free_names(space, support == "ground"))
    fit = Fit(free, described_at(free, space.at(LIGHT)))
    noise = Noise(np.full(measured.channels, sigma), np.zeros(measured.channels), "assumed")
    nominal = Nominal(fit, noise, Certificate((1.0, 1.0), True, 0.0))
    return shorter_stepped(nominal, replays_of(measured), replays_of)


def test_a_light_rotor_that_is_damped_strongly_takes_shorter_ones_on_the_ground() -> None:
    finer = asked(OP2, "ground", SIGMA)
    assert finer is not None and finer.timestep == OP2.timestep / 2
    assert replace(finer, timestep=OP2.timestep) == OP2


@pytest.mark.parametrize(
    ("timestep", "support", "sigma"),
    [
        (SHORTEST, "ground", SIGMA),  # no shorter ones are used
        (0.002, "suspended", SIGMA),
        (0.002, "ground", 0.02),  # they are hidden by the noise
        (0.002, "ground", 1e-10),  # it goes elsewhere
    ],
)
def test_else_the_robots_own_are_kept(timestep: float, support: str, sigma: float) -> None:
    assert asked(replace(OP2, timestep=timestep), support, sigma) is None


def test_a_robot_is_written_with_the_substeps_it_has(tmp_path: Path) -> None:
    finer = replace(OP2, timestep=0.001)
    written = write_corrected(finer, tmp_path / "finer", {}, OP2.terms, actuator=OP2.actuator)
    assert written.timestep == 0.001
    text = (OP2.folder / "robot.toml").read_text()
    assert (tmp_path / "finer" / "robot.toml").read_text() == text.replace(
        "timestep = 0.002", "timestep = 0.001"
    )
    same = write_corrected(OP2, tmp_path / "same", {}, OP2.terms)
    assert same.timestep == OP2.timestep
