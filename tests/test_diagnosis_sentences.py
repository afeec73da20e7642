"""Sentences of a diagnosis: what is said of places, sizes and effects."""

import re
from dataclasses import replace
from typing import Any

import pytest
from diagnoses import Maker
from test_diagnosis_report import speech

from pup.diagnosis.document import document
from pup.diagnosis.laws import WORDS
from pup.diagnosis.sentences import sentence
from pup.diagnosis.verdict import Parameter
from pup.diagnosis.wording import effect_words, percent, shift, spoken
from pup.physics.terms import TERMS, Place
from pup.robot import RobotDescription

PLACES = {
    "joint": Place("joint", "l_knee"),
    "group": Place("group", "hip"),
    "body": Place("body", "body"),
    "foot": Place("foot", "l_ank_roll_link"),
    "ground": Place("ground"),
    "sensor": Place("sensor"),
    "bus": Place("bus"),
    "robot": Place("robot"),
}


@pytest.fixture(scope="module")
def op2() -> Maker:
    return Maker(RobotDescription.load("darwin_op2"), ticks=20, most=2)


def told(maker: Maker, effect: str, place: Place, **sizes: float) -> str:
    """The sentence about an effect."""
    diagnosis = maker.missing(effect, place, **sizes)
    return sentence(diagnosis, diagnosis.findings[0], speech(diagnosis))


def test_names_are_spoken() -> None:
    assert spoken("l_knee") == "left knee"
    assert spoken("l_ank_pitch") == "left ankle pitch"
    assert spoken("FR_thigh_joint") == "front right thigh"
    assert spoken("servo") == "servo"


def test_numbers_are_readable() -> None:
    assert percent(0.314) == "31 %"
    assert percent(0.0531) == "5.3 %"
    assert percent(1e-5) == "0 %"
    assert shift(0.31) == "31 % too high"
    assert shift(-0.2) == "20 % too low"
    assert shift(9.0) == "10 times what it should be"


def test_a_delay_that_changes_is_told(op2: Maker) -> None:
    diagnosis = op2.missing("command_delay", PLACES["bus"], time=0.012)
    (finding,) = diagnosis.findings
    uneven = finding.parameters | {"jitter": Parameter(0.004, "s", 0.003, 0.005)}
    shown = sentence(diagnosis, replace(finding, parameters=uneven), speech(diagnosis))
    assert shown == (
        "Commands to all servos arrive 12 ms late. From tick to tick that changes by ±4 ms."
    )


def test_sentences_name_place_and_size(op2: Maker) -> None:
    knee, bus = PLACES["joint"], PLACES["bus"]
    assert told(op2, "backlash", knee, gap=0.008) == (
        "The left knee loses 0.92° at every load reversal: gear backlash."
    )
    assert told(op2, "command_delay", bus, time=0.012) == (
        "Commands to all servos arrive 12 ms late."
    )
    warm = told(op2, "thermal_drift", knee, rate=0.02, time=1000.0, load=1.0)
    assert warm == (
        "The left knee loses strength by what it carries: 10 % in 10 s at half of the torque limit."
    )
    assert told(op2, "torque_speed_limit", PLACES["group"]).startswith(
        "The faster the hip joints turn, the weaker the motor"
    )
    assert "12 mm away" in told(op2, "com_offset", PLACES["body"], x=0.012, y=0.0, z=0.0)
    assert "50 g less" in told(op2, "payload", PLACES["body"], mass=-0.05)
    assert told(op2, "ground_friction", PLACES["foot"], change=-0.3).startswith(
        "The left foot grips worse"
    )


def test_a_sliding_joint_is_told_in_millimetres() -> None:
    emps = Maker(RobotDescription.load("emps"))
    words = told(emps, "backlash", Place("joint", "axis"), gap=0.0005)
    assert words == "The axis loses 1 mm at every load reversal: gear backlash."
    assert " N works" in told(emps, "coulomb_friction", Place("joint", "axis"), torque=20.0)


SERVOS = sorted(name for name, term in TERMS.items() if {"joint", "robot"} <= set(term.kinds))


@pytest.mark.parametrize("effect", SERVOS)
def test_what_all_joints_do_is_not_said_of_the_robot(op2: Maker, effect: str) -> None:
    """A robot neither turns nor sticks, and has no gear."""
    everywhere = PLACES["robot"]
    speak = speech(op2.missing(effect, everywhere))
    named = [speak.heading(effect, everywhere), speak.words(effect, everywhere)]
    named += [speak.lack(effect, [everywhere]), speak.short(effect, everywhere)]
    assert all("robot" not in words and "all joints" in words.lower() for words in named)
    assert "robot" not in told(op2, effect, everywhere).lower()


def test_joints_are_several(op2: Maker) -> None:
    share = {"share": 0.15}
    assert told(op2, "load_dependent_friction", PLACES["group"], **share) == (
        "The hip joints lose 30 % of the load that they carry to friction."
    )
    assert told(op2, "backlash", PLACES["robot"], gap=0.008) == (
        "All joints lose 0.92° at every load reversal: gear backlash."
    )
    clocks = Place("robot")
    assert speech(op2.missing("clock_skew", clocks)).words("clock_skew", clocks) == (
        "two clocks that run apart on the robot"
    )


def test_a_cable_pulls_one_way(op2: Maker) -> None:
    """Its constant pull has a direction of its own, which is not back."""
    for preload, way in ((0.05, "positive"), (-0.05, "negative")):
        words = told(op2, "joint_spring", PLACES["joint"], stiffness=0.15, preload=preload)
        assert words.endswith(f"and 0.05 N m in the {way} direction all the time.")


def test_names_of_people_have_capitals() -> None:
    assert effect_words("coulomb_friction") == "Coulomb friction"
    assert effect_words("stribeck_friction") == "Stribeck friction"


@pytest.mark.parametrize("effect", TERMS)
def test_every_effect_has_a_sentence(op2: Maker, effect: str) -> None:
    words = told(op2, effect, PLACES[TERMS[effect].kinds[0]])
    assert words[0].isupper() and words.endswith(".")
    assert re.search(r"\d", words)
    assert not re.search(r"nan|inf\b|\de[-+]|_", words)
    assert len(words) < 200


@pytest.mark.parametrize(
    ("effect", "place", "name", "kind"),
    [
        ("coulomb_friction", "joint", "coulomb_friction", {"kind": "joint", "names": ["l_knee"]}),
        (
            "coulomb_friction",
            "robot",
            "coulomb_friction",
            {"kind": "group", "names": ["arm", "head", "hip", "knee", "ankle"]},
        ),
        ("thermal_drift", "robot", "thermal_drift", {"kind": "robot", "names": ["darwin_op2"]}),
        ("derivative_kick", "group", "unknown", {"kind": "group", "names": ["hip"]}),
        (
            "rising_static_friction",
            "joint",
            "unknown",
            {"kind": "joint", "names": ["l_knee"]},
        ),
    ],
)
def test_the_document_speaks_the_contracts_language(
    op2: Maker, effect: str, place: str, name: str, kind: dict[str, Any]
) -> None:
    """What all servos do is of all groups; what the contract has no name for is unknown."""
    (finding,) = document(op2.missing(effect, PLACES[place]), "corrected")["findings"]
    assert (finding["effect"], finding["place"]) == (name, kind)


def test_every_effect_is_in_words() -> None:
    assert set(TERMS) < set(WORDS)
