"""What follows a fall is left out, told by an IMU that may leave gaps."""

import numpy as np
import pytest
from recordings import make

from pup.diagnosis.falls import DOWN, TOPPLES, standing
from pup.diagnosis.pieces import pieces
from pup.recording import Recording
from pup.robot import RobotDescription

OP2 = RobotDescription.load("darwin_op2")
PERIOD = 0.02


def recording(pitch: np.ndarray, support: str = "ground") -> Recording:
    ticks, joints = len(pitch), len(OP2.joints)
    return make(
        robot=OP2.name,
        motion="fall",
        support=support,
        joints=OP2.joint_names,
        time=PERIOD * np.arange(ticks),
        target=np.zeros((ticks, joints)),
        position=np.zeros((ticks, joints)),
        extras={"imu/roll": np.zeros(ticks), "imu/pitch": pitch},
    )


@pytest.mark.parametrize("every", [1, 2])
def test_a_fall_ends_where_the_robot_topples(every: int) -> None:
    pitch = np.linspace(0.0, 1.5, 151)
    known = np.arange(151) % every == 0
    told = standing(recording(np.where(known, pitch, np.nan)))
    lean = pitch[len(told.time) - 1]
    assert TOPPLES - 0.01 <= lean <= TOPPLES + 0.01 * every + 0.01


def test_who_stands_up_is_seen_whole_whatever_the_first_reading() -> None:
    pitch = np.linspace(DOWN + 0.5, 0.0, 200)
    pitch[0] = np.nan
    assert len(standing(recording(pitch)).time) == 200


def test_parts_begin_at_rest_however_seldom_positions_are_read() -> None:
    """A joint that is read at every fourth tick moves between them all the same."""
    time = np.arange(0.0, 40.0, 0.01)
    angle = np.interp(time % 4.0, [0.0, 1.0, 2.0, 3.0], [0.0, 0.7, 0.7, 0.0])
    whole = recording(np.zeros(len(time)), "suspended")
    position = np.repeat(angle[:, None], len(OP2.joints), axis=1)
    target = np.where(time[:, None] % 4.0 < 2.0, 0.7, 0.0) * np.ones(len(OP2.joints))
    position[np.arange(len(time)) % 4 != 0] = np.nan
    long = Recording(
        **{**vars(whole), "time": time, "target": target, "position": position, "extras": {}}
    )
    starts = np.cumsum([0, *(len(part.time) for part in pieces([long]))])[1:-1]
    speed = np.gradient(angle, time)
    assert len(starts) > 2 and np.abs(speed[starts - 2]).max() < 1e-6
