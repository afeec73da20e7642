"""What holds for every effect of the library, whatever its equation."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from terms import BENCH, LEG, LEG_POSE, OP2, Row, play, sizes, steps
from test_simulator import recording

from pup.errors import InputError
from pup.physics.mujoco_batch import MujocoSimulator
from pup.physics.parameters import ParameterSpace, robot_space
from pup.physics.terms import CLASS_OF, CLASSES, TERMS, Place, column, term_space
from pup.physics.terms.scale import Scale
from pup.recording import Recording
from pup.robot import RobotDescription

EMPS = RobotDescription.load("emps")
SQUAT = np.array(OP2.poses["half_squat"])
STOP = {"angle": -1.2, "side": 1.0}
"""Where the left knee meets a stop in the poses used here."""


def a_place(effect: str, robot: RobotDescription) -> Place | None:
    """Somewhere on a robot's left leg, or on the bench, where an effect can act."""
    limb = robot is not BENCH
    names = {
        "joint": "l_knee" if limb else "servo",
        "group": "knee" if limb else "servo",
        "body": "l_knee_link" if limb else "arm",
        "foot": "l_ank_roll_link",
    }
    for kind in TERMS[effect].kinds:
        if kind != "foot" or robot.feet:
            return Place(kind, names.get(kind, ""))
    return None


def a_term(effect: str, robot: RobotDescription, share: float = 1.0) -> Row:
    """An effect at a share of its typical sizes."""
    place = a_place(effect, robot)
    assert place is not None
    return sizes(effect, place, share, **(STOP if effect == "joint_stop" else {}))


def on_the_ground(seconds: float = 0.5) -> Recording:
    time = np.arange(0, seconds, 0.03)
    target = SQUAT + 0.1 * np.sin(7 * time)[:, None]
    extras = {"imu/roll": np.full(len(time), 0.01), "imu/pitch": np.full(len(time), -0.02)}
    return recording(OP2, time, target, SQUAT, "ground", id="ground", extras=extras)


AIR = {
    "servo_bench": steps(BENCH, np.zeros(1), 0.5, "bench"),
    "darwin_leg": steps(LEG, LEG_POSE, 0.5, "suspended"),
    "darwin_op2": steps(OP2, SQUAT, 0.5, "suspended"),
}
ON_GROUND = ("ground_compliance", "ground_friction", "ground_slope", "contact_restitution")
SEEN_ON_GROUND = (*ON_GROUND, "imu_misalignment", "imu_delay")
IN_THE_AIR = [effect for effect in TERMS if effect not in SEEN_ON_GROUND]


def test_every_effect_is_of_one_class() -> None:
    assert sorted(e for effects in CLASSES.values() for e in effects) == sorted(TERMS)
    assert set(CLASS_OF) == set(TERMS)


@pytest.mark.parametrize("actuator", ["pd", "nn_pd"])
@pytest.mark.parametrize("robot", [BENCH, LEG, OP2], ids=lambda r: r.name)
def test_at_zero_a_term_changes_no_bit(robot: RobotDescription, actuator: str) -> None:
    """One row without any effect, one with each and one with all, in one batch."""
    runs = [AIR[robot.name]] + ([on_the_ground(0.3)] if robot is OP2 else [])
    effects = [effect for effect in TERMS if a_place(effect, robot)]
    none = {k: v for effect in effects for k, v in a_term(effect, robot, 0.0).items()}
    rows = [none, *(none | a_term(effect, robot, 0.1) for effect in effects)]
    told, plain = play(robot, runs, rows, actuator), play(robot, runs, [{}], actuator)
    for name in ("position", "tilt", "feet"):
        assert np.array_equal(getattr(told, name)[0], getattr(plain, name)[0], equal_nan=True)
    every = np.nan_to_num(np.concatenate([told.position, told.tilt], axis=2))
    changed = (every != every[0]).any(axis=(1, 2))
    unseen = set() if robot is OP2 else set(SEEN_ON_GROUND)
    # Nothing here is driven fast enough for back-EMF, and the bench never hits its stop.
    assert {e for e, c in zip(effects, changed[1:], strict=True) if not c} <= (
        unseen | {"torque_speed_limit", "joint_stop", "payload", "external_force"}
    )


def test_a_term_acts_on_its_joint_and_what_hangs_there_alone() -> None:
    """A suspended robot's other limbs feel nothing but rounding."""
    effects = [e for e in IN_THE_AIR if {"joint", "body"} & set(TERMS[e].kinds)]
    big = [e for e in effects if e != "torque_speed_limit"]  # a squat is too slow for it
    rows: list[Row] = [{}, *(a_term(effect, OP2) for effect in big)]
    seen = play(OP2, AIR["darwin_op2"], rows).position
    leg = np.array([n.startswith(("l_hip", "l_knee", "l_ank")) for n in OP2.joint_names])
    for effect, told in zip(big, seen[1:], strict=True):
        moved = np.abs(told - seen[0]).max(axis=0)
        assert moved[OP2.joint_names.index("l_knee")] > 1e-5, effect
        assert moved[~leg].max() < 1e-12, effect


def test_at_a_group_a_term_acts_as_at_each_of_its_joints() -> None:
    effects = [e for e in IN_THE_AIR if {"joint", "group"} <= set(TERMS[e].kinds)]
    by_group: list[Row] = [sizes(e, Place("group", "knee")) for e in effects]
    by_joint = [
        sizes(e, Place("joint", "l_knee")) | sizes(e, Place("joint", "r_knee")) for e in effects
    ]
    seen = play(OP2, AIR["darwin_op2"], [*by_group, *by_joint]).position
    assert np.array_equal(seen[: len(effects)], seen[len(effects) :])


def test_at_the_bus_or_the_robot_a_term_acts_on_all_joints() -> None:
    every = [(e, k) for e in IN_THE_AIR for k in ("bus", "robot") if k in TERMS[e].kinds]
    rows: list[Row] = [{}, *(sizes(effect, Place(kind)) for effect, kind in every)]
    seen = play(OP2, AIR["darwin_op2"], rows).position
    for effect, told in zip(every, seen[1:], strict=True):
        driven = np.abs(seen[0] - seen[0, :1]).max(axis=0) > 1e-3
        assert (np.abs(told - seen[0]).max(axis=0)[driven] > 0).all(), effect


def test_shapes_of_two_terms_of_a_kind_do_not_mix() -> None:
    """A joint's own teeth count there, another's do not; sizes of joint and group add."""
    knee, ankle = Place("joint", "l_knee"), Place("joint", "l_ank_pitch")
    one = sizes("cogging", knee, teeth=16.0)
    other = sizes("cogging", ankle, 0.0, teeth=48.0)
    halves = sizes("coulomb_friction", knee, 0.5) | sizes(
        "coulomb_friction", Place("group", "knee"), 0.5
    )
    seen = play(
        LEG, AIR["darwin_leg"], [one, one | other, sizes("coulomb_friction", knee), halves]
    ).position
    assert np.array_equal(seen[0], seen[1])
    assert seen[2] == pytest.approx(seen[3], abs=1e-12)


DRIVETRAIN = ("backlash", "joint_compliance", "structural_flex")
"""Effects that take the rotor off the link: next to none is none but for the sub-step's error."""
HARD = ("actuator_lag", "joint_stop")
"""Effects that ask for shorter sub-steps than the rest: a lag of four of them, an impact."""


def test_replays_depend_continuously_on_every_size() -> None:
    """Nothing jumps where an effect begins; half of a small size is about half of its effect.

    In sub-steps that a rotor of its own can follow: its first one may find the servo at its limit.
    """
    shares = {e: (1e-4, 1.0, 2.0) if e in DRIVETRAIN else (1e-4, 0.05, 0.1) for e in IN_THE_AIR}
    rows: list[Row] = [{}]
    rows += [a_term(effect, LEG, share) for effect in IN_THE_AIR for share in shares[effect]]
    seen = play(replace(LEG, timestep=5e-4), AIR["darwin_leg"], rows).position
    change = np.sqrt(np.mean((seen[1:] - seen[0]) ** 2, axis=(1, 2))).reshape(-1, 3)
    for effect, (tiny, half, full) in zip(IN_THE_AIR, change, strict=True):
        # A goal of limited acceleration takes a time that goes by the root of its size.
        assert tiny < (8e-5 if effect == "target_rate_limit" else 2e-5), effect
        # Play of another width is met at other times: half of it may do more.
        assert 0.3 < half / full < 0.7 or effect == "backlash", effect


def test_no_effect_is_an_artefact_of_the_sub_step() -> None:
    """Half of it changes a leg's motion by less than 0.3 mrad, or 0.5 where it is hard."""
    rows: list[Row] = [{}, *(a_term(effect, LEG) for effect in IN_THE_AIR)]
    run = steps(LEG, LEG_POSE, 1.2, "suspended")
    fine = replace(LEG, timestep=LEG.timestep / 2)
    change = play(LEG, run, rows).position - play(fine, run, rows).position
    for effect, moved in zip(("nothing", *IN_THE_AIR), change, strict=True):
        assert np.sqrt(np.mean(moved**2)) < (5e-4 if effect in HARD else 3e-4), effect


SHORT = steps(LEG, LEG_POSE, 0.35, "suspended")


@settings(max_examples=25)
@given(st.lists(st.sampled_from(IN_THE_AIR), min_size=2, max_size=3, unique=True), st.data())
def test_effects_compose(effects: list[str], data: st.DataObject) -> None:
    """Two or three at the same place, as large as a lab meets them: nothing breaks down."""
    row: dict[str, float] = {}
    for effect in effects:
        row |= a_term(effect, LEG, data.draw(st.sampled_from([0.3, 1.0, 2.0])))
    seen = play(LEG, SHORT, [row, {}]).position
    assert np.isfinite(seen).all() and np.abs(seen[0] - seen[1]).max() < 2.0


def test_effects_of_the_ground_compose() -> None:
    """All of them at once on a standing robot."""
    row = {k: v for e in SEEN_ON_GROUND for k, v in a_term(e, OP2).items()}
    seen = play(OP2, on_the_ground(), [row, row | a_term("backlash", OP2)])
    assert np.isfinite(seen.position).all() and np.isfinite(seen.tilt).all()


BAD = [
    ("slack/gap@joint:l_knee", "there is no effect 'slack'; known: command_delay,"),
    ("backlash/width@joint:l_knee", "backlash has no 'width'; it has: gap, behind, drag"),
    ("backlash/gap@limb:l_knee", "place 'limb:l_knee': 'limb' is none of joint, group,"),
    ("backlash/gap@joint:knee", "place joint:knee: the robot has no joint of that name"),
    ("backlash/gap@group:l_knee", "place group:l_knee: the robot has no group of that name"),
    ("backlash/gap@joint", "place joint: which joint? give its name"),
    ("backlash/gap@bus", "backlash cannot act at bus; it acts at a joint or group"),
    ("voltage_sag/drop@bus:a", "place bus:a: there is one bus; leave the name out"),
    ("payload/mass@body:world", "place body:world: the robot has no body of that name"),
    ("structural_flex/compliance@body:body", "place body:body: no joint carries it"),
]


@pytest.mark.parametrize(("name", "words"), BAD, ids=[name for name, _ in BAD])
def test_a_column_that_means_nothing_is_refused(name: str, words: str) -> None:
    one = np.ones(1)
    space = robot_space(OP2, "pd").plus(ParameterSpace((name,), ("1",), one, 0 * one, 2 * one))
    with pytest.raises(InputError) as error:
        MujocoSimulator(OP2, [AIR["darwin_op2"]], "pd").replay(space.candidates())
    assert words in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("effect", TERMS)
def test_a_term_tells_what_it_is(effect: str) -> None:
    """Its sizes are absent nominally, within what is tried, and it says where they come from."""
    term = TERMS[effect]
    assert term.effect == effect and term.source and (term.__doc__ or "").strip()
    place = Place(term.kinds[0], "x")
    space = term_space(effect, place)
    assert (space.lower <= space.nominal).all() and (space.nominal <= space.upper).all()
    for quantity in term.quantities:
        assert Place.parse(str(place)) == place
        assert column(effect, quantity.name, place) in space.names
        assert all(quantity.lower <= value <= quantity.limit for value in quantity.grid)
        assert 0 < quantity.typical <= quantity.limit or quantity.shape
    assert term.magnitudes() and (space.nominal[: len(term.magnitudes())] == 0).all()


def test_the_page_on_the_physics_tells_every_effect_and_quantity() -> None:
    page = (Path(__file__).parents[1] / "docs" / "physics.md").read_text().splitlines()
    for effect, term in TERMS.items():
        start = f"| `{effect}` | {', '.join(term.kinds)} |"
        (row,) = [line for line in page if line.startswith(start)]
        for quantity in term.quantities:
            assert f"`{quantity.name}`" in row


@pytest.mark.parametrize(("robot", "angle"), [(EMPS, 0.145), (BENCH, 1.0), (LEG, 1.0)])
def test_joints_that_slide_are_known_by_their_kind(robot: RobotDescription, angle: float) -> None:
    """What a robot calls the unit of its forces does not matter."""
    named = tuple(replace(spec, unit="?") for spec in robot.parameters)
    assert Scale.of(replace(robot, parameters=named)).angle == pytest.approx(angle)
