"""Replays of a robot of one joint by the compiled loop, and sub-step after sub-step.

Both replay the same five scripted motions under the same candidates, in turn, in one process. Told
are milliseconds for a call, whose smallest ones a fit makes one after the other.
"""

from collections.abc import Callable
from unittest.mock import patch

import numpy as np

from benchmarks.paired import Report, in_turn, parser
from pup.diagnosis.replays import union
from pup.physics.loop import Loop
from pup.physics.mujoco_batch import MujocoSimulator
from pup.physics.parameters import Candidates, robot_space
from pup.recording import Recording
from pup.robot import RobotDescription
from pup.sysid.excitation import script

ROBOT = "servo_bench"
KINDS = ("step:0.3", "hold", "chirp", "triangle", "multisine")
COUNTS = (1, 8, 64)
EFFECTS: dict[str, dict[str, float]] = {
    "none": {},
    "dry friction": {"coulomb_friction/torque@joint:servo": 0.03},
    "a lag": {"actuator_lag/time@joint:servo": 0.01},
    "play": {"backlash/gap@joint:servo": 0.01},
    "late commands": {"command_delay/time@bus": 0.01},
}


def main() -> None:
    given = parser(__doc__, rounds=7).parse_args()
    report = Report("one_joint", given.json)
    robot = RobotDescription.load(ROBOT)
    runs = recordings(robot)
    simulator = MujocoSimulator(robot, runs, "pd")
    seconds = sum(float(run.time[-1]) for run in runs)
    report.say(f"{len(runs)} recordings of {seconds:.0f} s in all, {simulator.steps} sub-steps")
    rows = []
    for name, row in EFFECTS.items():
        space = union(robot_space(robot, "pd"), [row])
        for count in COUNTS:
            candidates = space.candidates(np.tile(space.at(row).nominal, (count, 1)))
            loop, steps = in_turn(
                [lambda c=candidates: simulator.replay(c), without_loop(simulator, candidates)],
                given.rounds,
            )
            told = [1e3 * float(np.median([c.processor for c in costs])) for costs in (loop, steps)]
            rows.append({"effect": name, "candidates": count, "loop": told[0], "steps": told[1]})
            report.say(
                f"  {name}, {count} candidates: {told[0]:.1f} ms, step by step {told[1]:.1f} ms"
            )
    report.add("milliseconds", rows)
    report.finish()


def recordings(robot: RobotDescription) -> list[Recording]:
    """Scripts as recordings, of which the first position was read."""
    told = []
    for motion in script(robot, KINDS, np.random.default_rng(0)):
        position = np.full_like(motion.target, np.nan)
        position[0] = motion.target[0]
        told.append(
            Recording(
                id=motion.id,
                robot=robot.name,
                motion=motion.motion,
                support=motion.support,
                source="simulation",
                joints=robot.joint_names,
                time=motion.time,
                target=motion.target,
                position=position,
            )
        )
    return told


def without_loop(simulator: MujocoSimulator, candidates: Candidates) -> Callable[[], None]:
    def run() -> None:
        with patch.object(Loop, "of", lambda *_: None):
            simulator.replay(candidates)

    return run


if __name__ == "__main__":
    main()
