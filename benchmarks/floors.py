"""How much of what a concealed robot records is its floor's doing.

`python -m benchmarks.floors --seeds 1000 1001` has virtual robots stand up, shift their weight and
walk on the spot, each on its own mat, on one with the time constant of the description's floor, and
on a level one. It tells by how much joints and torso then move otherwise, until one of them leans
too far: what a diagnosis could find at most, beside what encoders and the IMU can show.
"""

import argparse
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.contact import walk_on_the_spot
from hardware_agent.virtual.character import Character, draw
from hardware_agent.virtual.drives import CENTRE, TICK
from hardware_agent.virtual.plant import Plant
from hardware_agent.virtual.skeleton import STEP, bodies_of
from pup.physics.rotations import roll_pitch
from pup.robot import RobotDescription
from pup.sysid.excitation import PERIOD, Motion, script

Array = NDArray[np.float64]

RAMP, REST = 2.0, 1.0
"""To a motion's first pose, and there, s."""
FALLEN = 0.6
"""Tilt from which a robot falls, rad."""
KINDS = ("own", "hard", "level")
HARD = 0.02
"""Time constant of contacts as the description has it, which is MuJoCo's, s."""


def floored(robot: RobotDescription, seeds: list[int]) -> Plant:
    """Robots in threes: on their own mats, on hard ones, and on level ones."""
    drawn = (draw(seed, len(robot.joints), bodies_of(robot)) for seed in seeds)
    return Plant(robot, [other for own in drawn for other in _threes(own)])


def _threes(own: Character) -> tuple[Character, ...]:
    mats = (own.mat, replace(own.mat, time=HARD, damping=1.0), replace(own.mat, tilt=np.zeros(2)))
    return tuple(replace(own, mat=mat) for mat in mats)


def moved(plant: Plant, motion: Motion) -> tuple[Array, Array]:
    """True joint angles and tilts at the motion's ticks, shapes (n_ticks, n_lanes, ...), rad."""
    lanes = range(len(plant.characters))
    plant.renew(0)
    plant.place(lanes)
    plant.drives.orders.power[:] = 1.0
    _ramp(plant, motion.target[0])
    joints, tilts = [], []
    for i, (time, target) in enumerate(zip(motion.time, motion.target, strict=True)):
        _order(plant, target)
        until = motion.time[i + 1] if i + 1 < len(motion.time) else time
        plant.step(round((until - time) / STEP))
        joints.append(plant.angles.copy())
        tilts.append(roll_pitch(plant.qpos[:, 3:7]))
    return np.array(joints), np.array(tilts)


def _order(plant: Plant, target: Array) -> None:
    for lane in range(len(plant.characters)):
        plant.order(lane, slice(None), np.rint(target / TICK) + CENTRE)


def _ramp(plant: Plant, target: Array) -> None:
    """Go to a motion's first pose, and come to rest there."""
    start = plant.angles[0].copy()
    for share in np.minimum(np.arange(0, RAMP + REST, PERIOD) / RAMP, 1.0):
        _order(plant, start + share * (target - start))
        plant.step(round(PERIOD / STEP))


def main() -> None:
    """Tell it of each robot and motion."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", default="darwin_op2")
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(1000, 1010)))
    asked = parser.parse_args()
    robot = RobotDescription.load(asked.robot)
    told = script(robot, ("standup:1.75", "standup:4", "stand"), np.random.default_rng(0))
    plant = floored(robot, asked.seeds)
    for motion in (*told, walk_on_the_spot(robot)):
        joints, tilts = moved(plant, motion)
        for i, seed in enumerate(asked.seeds):
            own, *others = range(len(KINDS) * i, len(KINDS) * (i + 1))
            apart = [
                f"{kind} {_apart(joints, tilts, own, lane)}"
                for kind, lane in zip(KINDS[1:], others, strict=True)
            ]
            print(f"{seed} {motion.id}: {', '.join(apart)}", flush=True)


def _apart(joints: Array, tilts: Array, one: int, other: int) -> str:
    """How far two lanes are apart until one of them leans too far."""
    leans = np.abs(tilts[:, [one, other]]).max(axis=(1, 2)) > FALLEN
    until = int(np.argmax(leans)) if leans.any() else len(leans)
    rms = [
        1e3 * float(np.sqrt(np.mean((x[:until, one] - x[:until, other]) ** 2)))
        for x in (joints, tilts)
    ]
    fell = f" until {PERIOD * until:.1f} s" if leans.any() else ""
    return f"joints {rms[0]:.2f} and tilt {rms[1]:.2f} mrad{fell}"


if __name__ == "__main__":
    main()
