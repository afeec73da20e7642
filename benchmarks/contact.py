"""What a diagnosis says of a robot on the ground that has one thing more than its description.

`python -m benchmarks.contact --robots soft slippery` records a virtual quadruped, or with `--model`
another walking robot, that stands up, walks on the spot and sways, each with gains, inertia and a
floor of its own, and diagnoses it. What is concealed acts as the library has it, at half the time
step: this tells whether the search finds its way through contact, not whether real floors are
named. That blind sets tell.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from pup.diagnosis.engine import diagnose
from pup.diagnosis.replays import Bench, threads
from pup.diagnosis.result import Diagnosis
from pup.physics.parameters import robot_space
from pup.recording import Recording
from pup.robot import RobotDescription, TermSpec
from pup.sysid.excitation import PERIOD, Motion, script
from pup.sysid.virtual import SensorNoise, record_virtual

SPREAD = 0.12
"""Of the robots' parameters, in logarithms."""
LONGEST, LEAD = 7.0, 0.5
"""Of a motion, and before it begins to walk, s."""
TONES, AMPLITUDE = (0.4, 0.9, 1.6), 0.05
"""Of the sway, Hz and rad."""


def concealed(robot: RobotDescription) -> dict[str, TermSpec | None]:
    """What the robots have more than their description, by name."""
    first = robot.feet[0]
    return {
        "nothing": None,
        "soft": TermSpec("ground_compliance", "ground", "", {"time": 0.03}),
        "leaning": TermSpec("ground_slope", "ground", "", {"pitch": 0.04, "roll": -0.02}),
        "slippery": TermSpec("ground_friction", "foot", first, {"change": -0.4}),
        "lively": TermSpec("contact_restitution", "ground", "", {"share": 0.6}),
        "askew": TermSpec("imu_misalignment", "sensor", "", {"pitch": 0.03}),
        "late": TermSpec("imu_delay", "sensor", "", {"time": 0.06}),
    }


def motions(robot: RobotDescription) -> list[Motion]:
    """Two in the air, and on the ground standing up, walking on the spot and swaying."""
    told = script(robot, ("step:0.3", "chirp", "standup:2"), np.random.default_rng(1))
    return [*map(_beginning, told), walk_on_the_spot(robot), _sway(robot)]


def _beginning(motion: Motion) -> Motion:
    kept = motion.time <= LONGEST
    return replace(motion, time=motion.time[kept], target=motion.target[kept])


def walk_on_the_spot(robot: RobotDescription) -> Motion:
    assert robot.gait is not None
    ticks, stand = np.arange(0, LONGEST - 1, PERIOD), np.array(robot.poses["stand"])
    gait = robot.gait.angles(np.maximum((ticks - LEAD) / robot.gait.period, 0.0))
    begun = np.clip((ticks - LEAD) / LEAD, 0.0, 1.0)[:, None]
    return Motion("walk", "walk", "ground", ticks, stand + begun * (gait - stand))


def _sway(robot: RobotDescription) -> Motion:
    rng, stand = np.random.default_rng(5), np.array(robot.poses["stand"])
    ticks = np.arange(0, LONGEST, PERIOD)
    waves = [
        rng.uniform(0.5, 1.0, len(stand))
        * np.sin(2 * np.pi * tone * ticks[:, None] + rng.uniform(0, 2 * np.pi, len(stand)))
        for tone in TONES
    ]
    grown = np.minimum(ticks / 1.5, 1.0)[:, None]
    return Motion("multisine", "multisine", "ground", ticks, stand + AMPLITUDE * grown * sum(waves))


def recorded(robot: RobotDescription, hidden: TermSpec | None, seed: int) -> tuple[Recording, ...]:
    """Recordings of a robot whose parameters and effect nobody tells."""
    rng = np.random.default_rng(seed)
    space = robot_space(robot, "pd")
    drawn = space.nominal * np.exp(SPREAD * rng.normal(size=len(space.names)))
    true = dict(zip(space.names, drawn, strict=True))
    other = replace(robot, timestep=robot.timestep / 2, terms=(hidden,) if hidden else ())
    return record_virtual(other, motions(robot), "pd", true, rng, SensorNoise(), repeats=1)


def told(diagnosis: Diagnosis) -> str:
    """Verdict, findings and what they gain, in a line."""
    findings = [
        f"{f.effect} at {f.place} {f.probability:.2f} "
        + ", ".join(f"{k} {p.value:.3g} {p.unit}" for k, p in f.parameters.items())
        for f in diagnosis.findings
    ]
    held = diagnosis.held_out
    errors = f"{1e3 * held.before:.2f} to {1e3 * held.after:.2f} mrad" if held else "-"
    return f"{diagnosis.verdict}; {'; '.join(findings) or diagnosis.reason or '-'}; {errors}"


def main() -> None:
    """Diagnose what is asked for, one robot after the other."""
    quadruped = str(Path(__file__).parents[1] / "examples" / "quadruped")
    names = list(concealed(RobotDescription.load(quadruped)))
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", default=quadruped, help="name or folder of the robot")
    parser.add_argument("--robots", nargs="+", choices=names, default=names)
    asked = parser.parse_args()
    robot = RobotDescription.load(asked.model)
    known = concealed(robot)
    for name in asked.robots:
        runs = recorded(robot, known[name], 100 + names.index(name))
        begun = time.process_time()
        with threadpool_limits(limits=1):
            diagnosis = diagnose(
                robot, runs, lambda m: threads(Bench(m), 1), 1, lambda stage, share: None
            )
        seconds = time.process_time() - begun
        print(
            f"{name}: {told(diagnosis)}; {diagnosis.replays} candidates, {seconds:.0f} s",
            flush=True,
        )


if __name__ == "__main__":
    main()
