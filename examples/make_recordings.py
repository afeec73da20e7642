"""Makes the recordings that come with the package, on a virtual Darwin OP2.

    python examples/make_recordings.py

Nine step tests, two stand-ups and two falls go to pup/robots/darwin_op2/recordings, the parameters
of the virtual robot to examples/shipped_truth.json and to standard output. `pup run` without
recordings of one's own identifies this robot; the truth tells how well.
"""

import json
from pathlib import Path

import numpy as np

from pup.files import read_json
from pup.physics.parameters import robot_space
from pup.robot import RobotDescription
from pup.sysid.virtual import concealed_parameters, record

ROOT = Path(__file__).parents[1]
RECORDINGS = ROOT / "pup/robots/darwin_op2/recordings"
TRUTH = ROOT / "examples/shipped_truth.json"

SEED = 2019
KINDS = (
    *("step:0.1", "step:0.3", "step:0.6") * 3,
    *("standup:1.75", "standup:2"),
    *("fall:forward", "fall:left"),
)
# What the paper's authors identified of their robot (dart-env, MIT), to draw a likely one around.
# The torque limit is lower than theirs of 15.5 N m, which hardly any motion would reach.
AUTHORS = {
    "rho/arm": 0.861,
    "rho/head": 1.209,
    "rho/hip": 1.310,
    "rho/knee": 1.159,
    "rho/ankle": 2.357,
    "sigma/arm": 0.313,
    "sigma/head": 1.095,
    "sigma/hip": 1.196,
    "sigma/knee": 2.811,
    "sigma/ankle": 2.868,
    "torque_limit": 9.0,
    "ground_friction": 0.713,
}


def main(recordings: Path = RECORDINGS, truth: Path = TRUTH) -> None:
    """Draw a robot, record it, and tell what it was."""
    robot = RobotDescription.load("darwin_op2")
    centre = robot_space(robot, "nn_pd").at(AUTHORS).candidates().named()
    parameters = concealed_parameters(robot, "nn_pd", np.random.default_rng(SEED), centre)
    made = record(robot, KINDS, recordings, SEED, "nn_pd", parameters, truth=truth)
    size = sum(file.stat().st_size for file in recordings.glob("*.parquet"))
    print(f"{len(made)} recordings, {size / 1000:.0f} kB, in {recordings}")
    print(json.dumps(read_json(truth)["parameters"], indent=1))


if __name__ == "__main__":
    main()
