"""How a joint with a motor of its own begins: where it has held its load."""

from dataclasses import replace

import numpy as np
import pytest
from terms import BENCH, OP2, SERVO, Row, bench, held, play
from test_simulator import recording

from pup.recording import Recording

AT = "@joint:servo"
SQUAT = np.array(OP2.poses["half_squat"])
SLACK = {"backlash/gap@group:ankle": 0.006}


@pytest.mark.parametrize("timestep", [0.002, 0.0005])
@pytest.mark.parametrize("behind", [0.0, 1.0])
@pytest.mark.parametrize(
    "size", [{"backlash/gap": 0.01}, {"joint_compliance/compliance": 0.02}], ids=str
)
def test_what_hangs_at_rest_stays(size: Row, behind: float, timestep: float) -> None:
    """Of play and of give, whether the encoder sees them or not, to either side."""
    robot = replace(BENCH, timestep=timestep)
    for target in (0.5, -0.4):
        row = {f"{name}{AT}": value for name, value in size.items()}
        row |= {f"{name.split('/')[0]}/behind{AT}": behind for name in size}
        rest = bench(held(target, 6.0), row)[0, -1]
        seen = play(robot, held(target, 0.4, rest), [SERVO | row]).position[0, :, 0]
        assert np.ptp(seen) < 2e-5


def at_rest() -> Recording:
    """A robot that has stood on ankles with play for long, and then shifts its weight."""
    time = np.arange(0, 4.5, 0.03)
    target, begin = np.tile(SQUAT, (len(time), 1)), 100
    target[begin + 20 :, [10, 16]] += [0.05, -0.05]
    run = recording(OP2, time, target, SQUAT, "ground")
    seen = play(OP2, run, [SLACK])
    tilt = dict(zip(("imu/roll", "imu/pitch"), seen.tilt[0, begin:].T, strict=True))
    return replace(
        run,
        time=time[begin:] - time[begin],
        target=target[begin:],
        position=seen.position[0, begin:],
        extras=tilt,
    )


def test_a_robot_found_at_rest_on_loose_ankles_stands_on_their_side() -> None:
    run = at_rest()
    seen, alone = play(OP2, run, [SLACK, {}]), play(OP2, run, [{}])
    assert np.sqrt(np.mean((seen.position[0] - run.position) ** 2)) < 1e-3
    np.testing.assert_array_equal(seen.position[1], alone.position[0])
