"""Where effects are looked for, and in which forms."""

from dataclasses import replace

import numpy as np
import pytest

from pup.diagnosis.hypotheses import hypotheses
from pup.diagnosis.residuals import Measured
from pup.physics.terms import Place
from pup.recording import load_recordings
from pup.robot import RobotDescription
from tests.diagnoses import MOTIONS, recordings


@pytest.mark.parametrize(
    ("name", "bodies"),
    [
        ("servo_bench", set()),  # one joint cannot tell it from a centre of mass elsewhere
        (
            "darwin_leg",
            {
                "l_hip_roll_link",
                "l_hip_pitch_link",
                "l_knee_link",
                "l_ank_pitch_link",
                "l_ank_roll_link",
            },
        ),
    ],
)
def test_a_force_from_outside_is_looked_for_where_several_joints_feel_it(
    name: str, bodies: set[str]
) -> None:
    robot = RobotDescription.load(name)
    told = hypotheses(Measured.of(robot, recordings(robot, 60, MOTIONS)))
    assert {h.place.name for h in told if h.effect == "external_force"} == bodies
    loads = {h.place.name for h in told if h.effect == "payload"}
    assert bodies < loads  # any link may carry something


@pytest.mark.parametrize(
    ("name", "link", "joint"),
    [("servo_bench", "arm", "servo"), ("darwin_leg", "l_ank_pitch_link", "l_ank_pitch")],
)
def test_a_links_flex_is_a_sibling_of_the_compliance_of_the_joint_that_moves_it(
    name: str, link: str, joint: str
) -> None:
    robot = RobotDescription.load(name)
    told = {h.key: h for h in hypotheses(Measured.of(robot, recordings(robot, 60, MOTIONS)))}
    flex = told["structural_flex", Place("body", link)]
    compliances = [h for h in told.values() if h.effect == "joint_compliance"]
    siblings = [h.place for h in compliances if h.sibling_of(flex)]
    assert siblings == [Place("joint", joint)]
    dry = told["coulomb_friction", Place("joint", joint)]
    assert not flex.sibling_of(dry)


@pytest.mark.parametrize("hanging", [(), ("step_0.1_0",)])
def test_a_free_torso_is_pushed_and_links_where_some_motions_hang(hanging: tuple[str, ...]) -> None:
    robot = RobotDescription.load("darwin_op2")
    shipped = [robot.folder / "recordings" / f"{n}.parquet" for n in ("standup_2", *hanging)]
    told = hypotheses(Measured.of(robot, load_recordings(shipped)))
    pushed = [h.place.name for h in told if h.effect == "external_force"]
    assert len(set(pushed)) == len(pushed)
    assert robot.torso in pushed
    assert ("l_knee_link" in pushed) == bool(hanging)


@pytest.mark.parametrize("power", [1.0, 0.0])
def test_what_becomes_of_an_integral_is_asked_where_the_torque_goes_off(power: float) -> None:
    robot = RobotDescription.load("servo_bench")
    runs = recordings(robot, 60, MOTIONS)
    told = np.where(np.arange(60) < 30, 1.0, power)
    limp = [*runs[:-1], replace(runs[-1], extras={"torque_enabled": told})]
    forms = {
        h.choices for h in hypotheses(Measured.of(robot, limp)) if h.effect == "integral_action"
    }
    assert forms == ({(0.0,)} if power else {(0.0,), (1.0,)})
