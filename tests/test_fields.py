"""Setup knobs as fields of a model."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from robots import robot_folder
from terms import BENCH, held, play

from pup.robot import RobotDescription


def test_a_knob_at_its_default_changes_nothing_beside_one_that_is_turned(tmp_path: Path) -> None:
    """Not even where the model is written for another default: replays stay by themselves."""
    text = (BENCH.folder / "robot.toml").read_text().replace("default = 0.3247", "default = 0.3")
    robot = RobotDescription.load(robot_folder(tmp_path, text, BENCH.model_path.read_text()))
    run = held(0.5, 0.4)
    turned = replace(run, id="turned", setup={"mass": 0.6})
    alone, both = play(robot, run, [{}]), play(robot, [run, turned], [{}])
    np.testing.assert_array_equal(both.position[:, both.ticks[0]], alone.position)
    assert np.abs(both.position[:, both.ticks[1]] - alone.position).max() > 1e-3
