"""Scripts that an experiment plays on a concealed robot, through its bus."""

from pathlib import Path

import numpy as np
import pytest

from pup.errors import InputError
from pup.robot import RobotDescription
from pup.sysid.excitation import Motion, script

pytest.importorskip("mujoco")

from services.experiment.playing import Player, virtual_robot

OP2 = RobotDescription.load("darwin_op2")


def test_a_robot_goes_to_no_pose_on_the_way_to_which_it_would_touch_itself(tmp_path: Path) -> None:
    """From where it is put down an elbow would go 5 mm into the hip; other scripts are played."""
    kinds = ("step:0.1", "step:0.3", "step:0.6") * 2
    motions = {m.id: m for m in script(OP2, kinds, np.random.default_rng(15), jitter=True)}
    blocked = motions["step_0.3_1"]
    stand = np.array([OP2.poses["stand"]] * 2)
    with virtual_robot(OP2, 1000, tmp_path / "robot.log") as doors:
        player = Player(OP2, doors, 1000)
        with pytest.raises(InputError, match=r"recording a: no way to its first pose"):
            player.play(blocked, "a", 0, None)
        rest = Motion("rest", "hold", "suspended", np.array([0.0, 0.1]), stand)
        recorded = player.play(rest, "b", 1, None)
        player.close()
    assert np.abs(recorded.position[0] - stand[0]).max() < 0.15
