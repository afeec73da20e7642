"""What to record next."""

import numpy as np
import pytest

from pup.diagnosis.coordinates import term_coordinate
from pup.diagnosis.experiment import (
    NextRecording,
    Pair,
    Rival,
    next_recording,
    recorded_again,
    recorded_besides,
)
from pup.diagnosis.fit import Fit
from pup.diagnosis.menu import options
from pup.diagnosis.residuals import Noise
from pup.physics.terms import Place, column
from pup.physics.terms.scale import Scale
from pup.robot import RobotDescription
from pup.sysid.excitation import possible_kinds
from tests.located import fitted, measured_under, replays_of, settled

BENCH = RobotDescription.load("servo_bench")
OP2 = RobotDescription.load("darwin_op2")
PLACE = Place("joint", "servo")


@pytest.fixture(scope="module")
def late() -> tuple[list[Rival], Noise]:
    """Two explanations of steps whose commands came late, fitted to those steps alone."""
    missing = {"command_delay/time@joint:servo": 0.01}
    replays = replays_of(measured_under(BENCH, missing, ("step",), 2.0))
    nominal, noise = fitted(replays)
    told = []
    for effect in ("command_delay", "measurement_delay"):
        free = term_coordinate(column(effect, "time", PLACE), Scale.of(BENCH))
        start = Fit((*nominal.coordinates, free), np.append(nominal.at, 0.5))
        told.append(Rival(effect, PLACE, 0.5, settled(start, replays, noise)))
    return told, noise


def test_only_a_drop_tells_late_commands_from_old_readings(late: tuple[list[Rival], Noise]) -> None:
    """With the torque off no command matters, but readings are as old as ever."""
    found, noise = late
    assert found[0].fit.chi2 == pytest.approx(found[1].fit.chi2, abs=2)
    told = next_recording(BENCH, found, noise, replays_of)
    assert told is not None
    assert told.motion == "drop"
    assert told.splits[0].expected > 100
    document = told.document()
    assert document["motion"] == "drop"
    assert document["splits"] == [["command_delay", "measurement_delay"]]
    assert "commands that arrive late" in document["reason"]


def test_nothing_is_asked_for_where_nothing_would_tell(late: tuple[list[Rival], Noise]) -> None:
    found, noise = late
    assert next_recording(BENCH, found[:1], noise, replays_of) is None
    assert next_recording(BENCH, [found[0], found[0]], noise, replays_of) is None


@pytest.mark.parametrize("robot", [BENCH, OP2])
def test_options_are_recordings_the_robot_can_make(robot: RobotDescription) -> None:
    menu = options(robot)
    for option in menu:
        option.recording.validate(robot)
        robot.setup(option.setup)
    assert {"step", "triangle", "chirp", "hold", "multisine", "drop"} <= {
        option.recording.motion for option in menu
    }
    playable = {*possible_kinds(robot), "drop"}  # whose torque a hand switches off
    assert {option.recording.motion for option in menu} <= playable
    assert sum(option.plain for option in menu) >= 9
    assert {knob.name for knob in robot.knobs} == {n for o in menu for n in o.setup}
    floors = [option for option in menu if option.other_floor]
    assert bool(floors) == (robot is OP2)
    assert all(option.recording.support == "ground" for option in floors)


def test_where_motions_tell_nothing_another_one_is_asked_for() -> None:
    measured = measured_under(BENCH, {}, ("step", "triangle"), 1.0)
    told = recorded_besides(measured)
    assert told.motion == "chirp" and told.setup == {} and told.splits == ()
    assert told.document()["splits"] == []


def test_of_steps_those_that_move_the_joints_come_first() -> None:
    told = recorded_besides(measured_under(BENCH, {}, ("triangle",), 1.0))
    assert (told.motion, told.words) == ("step", "steps of 0.3 rad")
    assert told.reason == (
        "steps of 0.3 rad, beside what was recorded, would move the joints in another way"
    )


def test_where_recordings_are_spoilt_the_same_is_asked_for_again() -> None:
    told = recorded_again(measured_under(BENCH, {}, ("hold",), 1.0), "read at 20 Hz or faster")
    assert told.motion == "hold"
    assert told.document()["reason"] == "the same motions again, read at 20 Hz or faster"


def test_what_the_contract_has_no_name_for_is_told_as_unknown() -> None:
    pair = Pair("derivative_kick", "command_delay", 50.0)
    told = NextRecording("step", "steps", "bench", {}, False, "", (pair,)).document()
    assert told["splits"] == [["unknown", "command_delay"]]
