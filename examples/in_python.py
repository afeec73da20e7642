"""pup from Python, without Ray: a servo with a dry bearing, and what finds that.

    python examples/in_python.py

A virtual servo is given dry friction and is recorded. A description that has none replays the
recordings under 64 stiffnesses at once, of which none fits; then the diagnosis says why.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from pup.diagnosis.engine import diagnose
from pup.diagnosis.replays import Bench, threads
from pup.physics.mujoco_batch import MujocoSimulator
from pup.physics.parameters import robot_space
from pup.robot import RobotDescription, TermSpec
from pup.robot_writer import write_corrected
from pup.sysid.virtual import record

MOTIONS = ("step:0.6", "step:0.6", "triangle", "chirp", "hold")
CORES = 2


def main(folder: Path) -> str:
    """Record the dry servo in a folder, and diagnose it; the name of what is found first."""
    robot = RobotDescription.load("servo_bench")
    dry = TermSpec("coulomb_friction", "joint", robot.joint_names[0], {"torque": 0.06})  # N m
    concealed = write_corrected(robot, folder / "concealed", {}, [dry])
    recordings = record(concealed, MOTIONS, folder / "recordings", seed=3, actuator="pd")

    # One batch: 64 candidates times 5 recordings.
    space = robot_space(robot, "pd")
    stiffness = space.names.index(f"kp/{robot.groups[0]}")
    values = np.tile(space.nominal, (64, 1))
    values[:, stiffness] *= np.geomspace(0.3, 3.0, 64)
    replay = MujocoSimulator(robot, recordings, "pd", CORES).replay(space.candidates(values))
    errors = []
    for recording, ticks in zip(recordings, replay.ticks, strict=True):
        errors.append(replay.position[:, ticks] - recording.position)
    rms = np.sqrt(np.mean(np.concatenate(errors, axis=1) ** 2, axis=(1, 2)))
    best = int(np.argmin(rms))
    print(f"best stiffness {values[best, stiffness]:.2f} N m/rad: {1000 * rms[best]:.1f} mrad")

    found = diagnose(
        robot,
        recordings,
        lambda measured: threads(Bench(measured), CORES),
        CORES,
        lambda stage, share: print(f"{share:4.0%} {stage}", file=sys.stderr),
    )
    for finding in found.findings:
        sizes = ", ".join(f"{n} {p.value:.3g}" for n, p in finding.parameters.items())
        print(f"{finding.effect} at {finding.place} ({finding.probability:.2f}): {sizes}")
    if found.held_out is not None:
        before, after = 1000 * found.held_out.before, 1000 * found.held_out.after
        print(f"motions left out: {before:.1f} -> {after:.1f} mrad")
    return found.findings[0].effect if found.findings else found.verdict


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        main(Path(place))
