"""Equation 1 on arrays small enough to work it out by hand."""

from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from recordings import make

from pup.physics.simulator import Trajectories, tick_slices
from pup.recording import Recording
from pup.robot import RobotDescription
from pup.sysid import loss as loss_module
from pup.sysid.loss import FEET_WEIGHT, LOST_FOOT, LOST_POSITION, TILT_WEIGHT, ReplayLoss

TIME = [0.0, 0.1, 0.2]
NAN = np.nan


class Robot:
    """All that the loss asks of a robot."""

    joint_names = ("a", "b")
    feet = ("left", "right")


@pytest.fixture(autouse=True)
def turning(monkeypatch: pytest.MonkeyPatch) -> None:
    """There is no model to tell that its joints turn; of those that slide see test_loss_units."""
    monkeypatch.setattr(loss_module, "joint_units", lambda robot: np.ones(len(robot.joint_names)))


def loss_of(*recordings: Recording) -> ReplayLoss:
    robot: Any = Robot()
    assert isinstance(robot, Robot) and not isinstance(robot, RobotDescription)
    return ReplayLoss(robot, recordings)


def recorded(id_: str, position: Any, tilt: Any = None, **changes: Any) -> Recording:
    extras = {}
    if tilt is not None:
        roll, pitch = np.transpose(tilt)
        extras = {"imu/roll": roll, "imu/pitch": pitch}
    known = {"time": TIME[: len(position)], "target": np.zeros_like(position), "extras": extras}
    return make(id=id_, position=position, **(known | changes))


def replayed(recordings: tuple[Recording, ...], **arrays: Any) -> Trajectories:
    ticks = tick_slices(recordings)
    n = ticks[-1].stop
    absent = {
        "position": np.zeros((1, n, 2)),
        "tilt": np.full((1, n, 2), NAN),
        "feet": np.full((1, n, 2, 3), NAN),
    }
    given = {name: np.asarray(value, dtype=float)[None] for name, value in arrays.items()}
    return Trajectories(ticks, **(absent | given))


def total(loss: ReplayLoss, trajectories: Trajectories) -> float:
    return float(loss.total(loss.terms(trajectories))[0])


def test_position_term_is_the_sum_of_norms_averaged_over_recordings() -> None:
    one = recorded("one", [[3.0, 4.0], [0.0, 0.0], [0.0, 1.0]])  # 5 + 0 + 1
    two = recorded("two", [[0.6, 0.8], [0.0, 2.0]])  # 1 + 2
    loss = loss_of(one, two)
    seen = replayed((one, two))
    assert loss.terms(seen).position == pytest.approx(np.array([[6.0, 3.0]]))
    assert total(loss, seen) == pytest.approx(4.5)
    assert loss.total(loss.terms(seen), [1]) == pytest.approx([3.0])


def test_joints_are_put_in_the_robots_order() -> None:
    swapped = recorded("swapped", [[1.0, 2.0], [3.0, 4.0]], joints=("b", "a"))
    assert total(loss_of(swapped), replayed((swapped,), position=[[2.0, 1.0], [4.0, 3.0]])) == 0


def test_a_sample_that_was_not_read_counts_nothing() -> None:
    gaps = recorded("gaps", [[NAN, 4.0], [NAN, NAN], [3.0, NAN]])
    loss = loss_of(gaps)
    assert total(loss, replayed((gaps,))) == pytest.approx(7.0)
    rmse = loss.rmse(replayed((gaps,)))
    assert rmse[0, 0] == pytest.approx([3.0, 4.0])
    assert np.array_equal(loss.errors(replayed((gaps,)))[0][0], [[0, -4], [0, 0], [-3, 0]])


def test_falls_and_stands_are_weighed_as_the_paper_has_it() -> None:
    """Tilt over standing and falling, feet over standing alone, each its own mean."""
    still = np.zeros((3, 2))
    fall = recorded("fall", still, still, motion="fall", support="ground")
    stand = recorded("stand", still, still, motion="standup", support="ground")
    step = recorded("step", still, still, motion="step", support="suspended")
    every = (fall, stand, step)
    loss = loss_of(*every)
    tilt = np.zeros((9, 2))
    tilt[1] = [0.03, 0.04]  # of the fall: 0.05
    tilt[5] = [0.0, 0.02]  # of the stand: 0.02
    tilt[7] = [1.0, 1.0]  # of the step: does not count
    feet = np.zeros((9, 2, 3))
    feet[0:3] += [[1.0, 0, 0], [0, 2.0, 0]]  # of the fall: does not count
    feet[3:6] += [0.1, 0.0, 0.05]  # where they stand is of no account
    feet[5] += [[0.03, 0, 0], [0, 0, 0.04]]  # but that they moved is: 0.05
    seen = replayed(every, tilt=tilt, feet=feet)
    terms = loss.terms(seen)
    assert terms.tilt == pytest.approx(np.array([[0.05, 0.02, 0.0]]))
    assert terms.feet == pytest.approx(np.array([[0.0, 0.05, 0.0]]))
    assert (TILT_WEIGHT, FEET_WEIGHT) == (10.0, 20.0)
    assert total(loss, seen) == pytest.approx(10 * 0.035 + 20 * 0.05)
    assert loss.total(loss.terms(seen), [0, 2]) == pytest.approx([10 * 0.05])
    assert loss.total(loss.terms(seen), [2]) == pytest.approx([0.0])


def rested(tilt: np.ndarray) -> Recording:
    """Eight ticks at rest and two after a command, leaning as told, shape (10, 2), rad."""
    target = np.zeros((10, 2))
    target[8:] = 0.5
    return recorded(
        "stand",
        np.zeros((10, 2)),
        tilt,
        motion="standup",
        support="ground",
        target=target,
        time=np.arange(10) / 30,
    )


@pytest.mark.parametrize("lost", [False, True])
def test_a_lean_at_rest_is_no_error_of_what_follows(lost: bool) -> None:
    """Eight ticks at rest, of which the first four settle, and two after a command."""
    measured = np.tile([0.04, -0.02], (10, 1))
    stand = rested(measured)
    tilt = np.full((10, 2), NAN) if lost else np.zeros((10, 2))
    tilt[0] = measured[0]
    if not lost:
        tilt[9] = [0.03, 0.04]  # since it rested: 0.05
    told = loss_of(stand).terms(replayed((stand,), tilt=tilt)).tilt[0, 0]
    settled = np.hypot(0.04, 0.02)  # of the first tick, which is where it was put
    expected = 9 * np.hypot(LOST_POSITION, LOST_POSITION) if lost else 0.05 + settled
    assert told == pytest.approx(expected)


@example(fallen=1.55, simulated=-1.55, lean=0.3)
@given(
    fallen=st.floats(-np.pi, np.pi), simulated=st.floats(-np.pi, np.pi), lean=st.floats(-0.3, 0.3)
)
def test_a_lean_at_rest_matters_nowhere_on_the_circle(
    fallen: float, simulated: float, lean: float
) -> None:
    """However far it falls, an IMU that sits askew says the same as one that does not."""
    measured, tilt = np.zeros((10, 2)), np.zeros((10, 2))
    measured[8:, 0], tilt[8:, 0] = fallen, simulated
    told = []
    for askew in (0.0, lean):
        stand = rested(measured + np.array([askew, 0.0]))
        seen = replayed((stand,), tilt=tilt)
        told.append(np.abs(loss_of(stand).errors(seen)[1][0, 8:, 0]))
    assert (told[1] <= np.pi).all()
    assert told[1] == pytest.approx(told[0], abs=1e-9)


def test_a_tick_without_tilt_does_not_hide_a_lean_at_rest() -> None:
    """What is known of the rest tells the lean; where nothing is known of it, nothing is said."""
    measured = np.tile([0.04, -0.02], (10, 1))
    measured[5, 0] = measured[4:8, 1] = NAN
    stand = rested(measured)
    seen = replayed((stand,), tilt=np.zeros((10, 2)))
    unknown_lean = 0.02 * 6  # of the pitch, at the ticks that have one
    assert loss_of(stand).terms(seen).tilt[0, 0] == pytest.approx(unknown_lean)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_what_stands_before_a_recording_does_not_matter(order: tuple[int, int]) -> None:
    """Feet that a suspended recording does not have are no step of the next one's."""
    still = np.zeros((2, 2))
    air = recorded("air", still), np.full((2, 2, 3), NAN)
    stood = recorded("stood", still, support="ground", motion="standup"), np.ones((2, 2, 3))
    stood[1][1, 0] = [1.0, 1.0, 1.5]  # one foot, half a metre up
    recordings, feet = zip(*((air, stood)[i] for i in order), strict=True)
    loss = loss_of(*recordings)
    seen = replayed(recordings, position=np.zeros((4, 2)), feet=np.concatenate(feet))
    assert loss.terms(seen).feet.sum() == pytest.approx(0.5)


def test_tilt_goes_the_short_way_round() -> None:
    lying = recorded("f", np.zeros((2, 2)), [[3.1, 0], [-3.1, 0]], motion="fall", support="ground")
    loss = loss_of(lying)
    seen = replayed((lying,), tilt=[[-3.1, 0], [3.1, 0]])
    assert loss.terms(seen).tilt == pytest.approx(np.array([[2 * (2 * np.pi - 6.2)]]))
    assert np.abs(loss.errors(seen)[1]).max() == pytest.approx(2 * np.pi - 6.2)


def test_a_simulation_that_broke_down_is_finite_and_worse() -> None:
    still = np.zeros((3, 2))
    stand = recorded("s", still, still, motion="stand", support="ground")
    loss = loss_of(stand)
    position, tilt, feet = np.zeros((3, 2)), np.zeros((3, 2)), np.zeros((3, 2, 3))
    position[2], tilt[2], feet[2] = NAN, NAN, NAN
    seen = replayed((stand,), position=position, tilt=tilt, feet=feet)
    terms = loss.terms(seen)
    assert terms.position[0, 0] == pytest.approx(LOST_POSITION * np.sqrt(2))
    assert terms.tilt[0, 0] == pytest.approx(LOST_POSITION * np.sqrt(2))
    assert terms.feet[0, 0] == pytest.approx(LOST_FOOT * np.sqrt(6))
    assert np.isfinite(total(loss, seen))
    assert seen.diverged.tolist() == [[True]]
    assert np.isfinite(loss.rmse(seen)).all()
    whole = Trajectories(seen.ticks, *(np.full_like(a, NAN) for a in (seen.position, seen.tilt)),
                         np.full_like(seen.feet, NAN))  # fmt: skip
    assert total(loss, whole) > total(loss, seen)


def test_a_gap_in_a_broken_simulation_still_counts_nothing() -> None:
    gap = recorded("gap", [[0.0, 0.0], [0.0, NAN]])
    position = [[0.0, 0.0], [NAN, NAN]]
    assert total(loss_of(gap), replayed((gap,), position=position)) == LOST_POSITION


def test_candidates_do_not_mix() -> None:
    rng = np.random.default_rng(0)
    two = (recorded("a", rng.normal(size=(3, 2))), recorded("b", rng.normal(size=(2, 2))))
    loss, ticks = loss_of(*two), tick_slices(two)
    position = rng.normal(size=(4, 5, 2))
    absent = np.full((4, 5, 2), NAN), np.full((4, 5, 2, 3), NAN)
    both = loss.terms(Trajectories(ticks, position, *absent)).position
    for i in range(4):
        alone = loss.terms(replayed(two, position=position[i])).position
        assert np.array_equal(both[i], alone[0])


def test_weighted_errors_add_up_to_equation_1() -> None:
    rng = np.random.default_rng(1)
    angles = rng.normal(0, 0.1, (3, 2))
    every = (
        recorded("a", rng.normal(size=(3, 2))),
        recorded("b", [[NAN, 0.2], [0.1, 0.3]]),
        recorded("s", rng.normal(size=(3, 2)), angles, motion="stand", support="ground"),
        recorded("f", rng.normal(size=(3, 2)), angles, motion="fall", support="ground"),
        recorded("g", rng.normal(size=(3, 2)), motion="fall", support="ground"),
    )
    loss = loss_of(*every)
    n = sum(len(r.time) for r in every)
    seen = replayed(
        every,
        position=rng.normal(size=(n, 2)),
        tilt=rng.normal(size=(n, 2)),
        feet=rng.normal(size=(n, 2, 3)),
    )
    errors, blocks = loss.weighted_errors(seen)
    norms = np.sqrt(np.add.reduceat(errors[0] ** 2, blocks))
    assert norms.sum() == pytest.approx(total(loss, seen))


@pytest.mark.parametrize(
    ("given", "wording"),
    [
        (
            {"motion": "step", "support": "suspended"},
            ["no standing or falling recording: tilt and foot terms left out"],
        ),
        ({"motion": "stand", "support": "ground", "tilt": True}, []),
        (
            {"motion": "stand", "support": "ground"},
            ["no torso roll and pitch in r: tilt term left out there"],
        ),
        (
            {"motion": "fall", "support": "ground", "tilt": True},
            ["no standing recording: foot term left out"],
        ),
        (
            {"motion": "fall", "support": "ground"},
            [
                "no torso roll and pitch in r: tilt term left out there",
                "no standing recording: foot term left out",
            ],
        ),
        (
            {"motion": "stand", "support": "suspended"},
            ["no standing or falling recording: tilt and foot terms left out"],
        ),
    ],
)
def test_what_is_left_out_is_told(given: dict[str, Any], wording: list[str]) -> None:
    tilt = np.zeros((3, 2)) if given.pop("tilt", False) else None
    assert loss_of(recorded("r", np.zeros((3, 2)), tilt, **given)).omitted() == wording
