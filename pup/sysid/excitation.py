"""Scripted motions that a robot plays to be identified, those of the paper among them.

A script is what is sent, before anything is measured: times and targets. Motions of the limbs are
played suspended (on the bench where the base is fixed), stand-ups and falls on the ground. Angles
are in rad; for a slide joint, read the share of its range that the angle has of half a turn.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.physics.model import joint_units
from pup.robot import RobotDescription
from pup.sysid.clearance import Clearance
from pup.sysid.lean import DIRECTIONS, falling_pose

Array = NDArray[np.float64]

PERIOD = 1 / 30  # s, between steady ticks
JITTERED = (1 / 33, 1 / 25)  # s; the paper's robot is driven at 25 to 33 Hz
LEAD = 0.1  # s at rest before a motion off the ground
GROUND = ("standup", "stand", "fall")  # kinds that are played there

STEP_SIZES = (0.1, 0.3, 0.6)  # rad (paper, section IV)
STEP_INTERVAL = 0.25  # s; four moves in a second, as the authors recorded them
STEP_MOVES = 4

STANDUP_TIMES = (1.75, 2.0, 4.0, 6.0)  # s; the authors' recordings
STILL = 0.5  # s at rest on the ground before anything moves, and after a stand-up
LEAN_TIME = 0.3  # s; the fall is driven, so that a little noise in the start changes little
FALL_TIME = 1.2  # s from the lean on

SHIFTS = {"left": 0.4, "right": 0.4, "forward": 0.15, "backward": 0.15}
"""How far a robot that stands leans to each side, a share of the way to the pose that topples it:
far, for the floor shows in how the feet turn under its weight, but weak servos stay up too."""
SHIFT_TIME = 0.8  # s, each way

HOLD_POSES = 3
HOLD_OFFSET = 0.15  # rad; friction holds a servo back by a tenth of it
HOLD_GAPS = (2.5, 0.4, 0.2, 1.0, 0.3, 0.4, 0.2, 1.0)  # s: there, stay, in, stay, across, ...

CHIRP_RANGE = (0.2, 5.0)  # Hz
CHIRP_AMPLITUDE = 0.06  # rad
CHIRP_TIME = 12.0  # s

MULTISINE_TONES = (0.3, 0.7, 1.1, 1.7, 2.3)  # Hz
MULTISINE_TIME = 10.0  # s, in which every tone turns a whole number of times
MULTISINE_GROWTH = 1.0  # s, in which it reaches its size

TRIANGLE_SPEED = (0.1, 0.2)  # rad/s
TRIANGLE_AMPLITUDE = 0.2  # rad
TRIANGLE_CYCLES = 2

ROOM = 0.002  # m between links; a robot under way sags off the straight line between its targets
WIDEST = 0.4  # share of a joint's range that an amplitude may take
TRIES = 20_000  # random poses before giving up
STEP_TRIES = 20  # random directions from one pose


@dataclass(frozen=True)
class Motion:
    """A script: what to send when.

    Attributes:
      id: its name within a set of scripts, and that of its recording.
      motion: motion type, as in a recording.
      support: `suspended`, `ground` or `bench`.
      time: shape (n_ticks,), s, from 0.
      target: shape (n_ticks, n_joints), in the robot's joint order. The robot is to be at rest in
        the first row.
    """

    id: str
    motion: str
    support: str
    time: Array
    target: Array


@dataclass(frozen=True)
class _Course:
    """A motion before it is put on ticks: targets (n, n_joints) at times (n,), and its end, s."""

    at: Callable[[Array], Array]
    end: float


_Make = Callable[[RobotDescription, np.random.Generator], _Course]


def possible_kinds(robot: RobotDescription) -> tuple[str, ...]:
    """The kinds of motion that a robot can play."""
    poses = {"stand", "squat"} <= robot.poses.keys()
    on_feet = robot.floating and robot.torso is not None and bool(robot.feet) and poses
    return ("step", *(GROUND if on_feet else ()), "hold", "chirp", "triangle", "multisine")


def script(
    robot: RobotDescription,
    kinds: Sequence[str],
    rng: np.random.Generator,
    jitter: bool = False,
) -> tuple[Motion, ...]:
    """Make scripts.

    Args:
      robot: who is to play them.
      kinds: `step`, `standup`, `stand`, `fall`, `hold`, `chirp`, `triangle` or `multisine`. One
        with variants may name one after a colon, as `step:0.3` (rad), `standup:2` (s) or
        `fall:left`; without it stands for all of the paper's. Every entry is drawn anew.
      rng: source of all that is random.
      jitter: ticks at random intervals of 25 to 33 Hz instead of a steady 30 Hz.

    Raises:
      InputError: a kind that is unknown or that the robot cannot play.
    """
    if not kinds:
        raise InputError(f"no motion given; use some of {', '.join(possible_kinds(robot))}")
    made = [(label, motion, make) for k in kinds for label, motion, make in _variants(robot, k)]
    repeated = Counter(label for label, _, _ in made)
    seen: Counter[str] = Counter()
    motions = []
    for label, motion, make in made:
        course = make(robot, rng)
        time = _ticks(course.end, rng if jitter else None)
        ground = motion in GROUND
        motions.append(
            Motion(
                id=f"{label}_{seen[label]}" if repeated[label] > 1 else label,
                motion=motion,
                support="ground" if ground else "suspended" if robot.floating else "bench",
                time=time,
                target=course.at(time),
            )
        )
        seen[label] += 1
    return tuple(motions)


def _variants(robot: RobotDescription, kind: str) -> list[tuple[str, str, _Make]]:
    """Label, motion type and maker of all that an entry such as `step` or `fall:left` means."""
    motion, _, variant = kind.partition(":")
    if motion not in possible_kinds(robot):
        known = ", ".join(possible_kinds(robot))
        raise InputError(f"motion {kind!r}: robot {robot.name!r} can play {known}")
    if motion == "step":
        sizes = (_number(kind, variant, 0.01, 1.0),) if variant else STEP_SIZES
        return [(f"step_{size:g}", motion, partial(_step, size=size)) for size in sizes]
    if motion == "standup":
        times = (_number(kind, variant, 0.5, 60.0),) if variant else STANDUP_TIMES
        return [(f"standup_{time:g}", motion, partial(_standup, time=time)) for time in times]
    if motion == "fall":
        if variant and variant not in DIRECTIONS:
            raise InputError(f"motion {kind!r}: directions are {', '.join(DIRECTIONS)}")
        ways = (variant,) if variant else DIRECTIONS
        return [(f"fall_{way}", motion, partial(_fall, direction=way)) for way in ways]
    if variant:
        raise InputError(f"motion {kind!r}: {motion} has no variants; use {motion!r}")
    return [(motion, motion, _ALONE[motion])]


def _number(kind: str, variant: str, lowest: float, highest: float) -> float:
    try:
        value = float(variant)
    except ValueError:
        value = np.nan
    if not lowest <= value <= highest:
        raise InputError(f"motion {kind!r}: after the colon goes {lowest:g} to {highest:g}")
    return value


def _ticks(end: float, rng: np.random.Generator | None) -> Array:
    """Tick times from 0 up to `end`, s; random intervals where a generator is given."""
    if rng is None:
        return np.arange(round(end / PERIOD) + 1, dtype=np.float64) * PERIOD
    gaps = rng.uniform(*JITTERED, size=int(end / JITTERED[0]) + 1)
    time = np.append(0.0, np.cumsum(gaps))
    return time[time <= end]


class _Room:
    """Where a robot's joints may go without touching each other, and random places in it."""

    def __init__(self, robot: RobotDescription, rng: np.random.Generator) -> None:
        self.name = robot.name
        self.rng = rng
        self.lower, self.upper = robot.limits
        self.unit = joint_units(robot)
        self.clearance = Clearance(robot, ROOM)

    def amplitude(self, angle: float) -> Array:
        """An angle per joint, less where the joint's range is narrow, shape (n_joints,)."""
        return np.minimum(angle * self.unit, WIDEST * (self.upper - self.lower))

    def signs(self) -> Array:
        """A random direction per joint, shape (n_joints,)."""
        return self.rng.choice((-1.0, 1.0), size=len(self.unit))

    def drawn(
        self, way: Callable[[Array], list[Array] | None], margin: Array | float = 0.0
    ) -> list[Array]:
        """The first way that is free of self-collision from a random pose.

        Args:
          way: poses from a random pose on, or None where there is no free way.
          margin: distance of the random pose to the limits, shape (n_joints,).
        """
        for _ in range(TRIES):
            pose = self.rng.uniform(self.lower + margin, self.upper - margin)
            if self.clearance.free(pose) and (poses := way(pose)) is not None:
                return poses
        raise InputError(
            f"robot {self.name!r}: no way free of self-collision from {TRIES} random poses; "
            "do neighbouring links overlap? exclude their contact in model.xml"
        )

    def stepped(self, pose: Array, size: float) -> Array | None:
        """A pose one step of every joint away, by a free way; None where none was found.

        Directions are random; a joint too near to a limit goes the other way, and one whose range
        is too narrow for both goes to the limit.
        """
        for _ in range(STEP_TRIES):
            step = self.signs() * size * self.unit
            beyond = (pose + step < self.lower) | (pose + step > self.upper)
            target = np.clip(pose + np.where(beyond, -step, step), self.lower, self.upper)
            if self.clearance.path_free(pose, target):
                return target
        return None


def _step(robot: RobotDescription, rng: np.random.Generator, size: float) -> _Course:
    room = _Room(robot, rng)

    def moves(pose: Array) -> list[Array] | None:
        poses = [pose]
        for _ in range(STEP_MOVES):
            target = room.stepped(poses[-1], size)
            if target is None:
                return None
            poses.append(target)
        return poses

    poses = np.array(room.drawn(moves))
    due = LEAD + STEP_INTERVAL * np.arange(STEP_MOVES + 1)
    # A move is sent with the first tick that is due; a tick is not missed for its last bit.
    return _Course(lambda time: poses[np.searchsorted(due[:-1], time + 1e-9)], float(due[-1]))


def _standup(robot: RobotDescription, rng: np.random.Generator, time: float) -> _Course:
    squat, stand = (np.array(robot.poses[name]) for name in ("squat", "stand"))
    return _ramped((0.0, STILL, time, STILL), (squat, squat, stand, stand))


def _fall(robot: RobotDescription, rng: np.random.Generator, direction: str) -> _Course:
    stand, lean = np.array(robot.poses["stand"]), falling_pose(robot, direction)
    return _ramped((0.0, STILL, LEAN_TIME, FALL_TIME), (stand, stand, lean, lean))


def _stand(robot: RobotDescription, rng: np.random.Generator) -> _Course:
    """Leans to all sides that it has, which shifts the weight over the feet."""
    stand = np.array(robot.poses["stand"])
    poses = [stand]
    for way, share in SHIFTS.items():
        with suppress(InputError):  # it does not lean that way
            poses += [stand + share * (falling_pose(robot, way) - stand), stand]
    if len(poses) == 1:
        raise InputError(f"robot {robot.name!r} cannot shift its weight; leave out 'stand'")
    gaps = (0.0, STILL, *[SHIFT_TIME] * (len(poses) - 1), STILL)
    return _ramped(gaps, (stand, *poses, stand))


def _hold(robot: RobotDescription, rng: np.random.Generator) -> _Course:
    room = _Room(robot, rng)
    reach = room.amplitude(HOLD_OFFSET)
    poses: list[Array] = []
    for _ in range(HOLD_POSES):
        way = partial(_both_sides, room, room.signs() * reach, poses[-1:])
        poses += room.drawn(way, reach)
    return _ramped((0.0, *(HOLD_GAPS * HOLD_POSES)[1:]), poses)


def _both_sides(room: _Room, aside: Array, before: list[Array], pose: Array) -> list[Array] | None:
    """To one side of a pose, into it, to the other side and back, each with a stay."""
    first, second = pose - aside, pose + aside
    lines = [(first, second), *((last, first) for last in before)]
    free = all(room.clearance.path_free(start, end) for start, end in lines)
    return [first, first, pose, pose, second, second, pose, pose] if free else None


def _chirp(robot: RobotDescription, rng: np.random.Generator) -> _Course:
    centre, swing = _swing(robot, rng, CHIRP_AMPLITUDE)
    low, high = CHIRP_RANGE
    growth = np.log(high / low) / CHIRP_TIME

    def at(time: Array) -> Array:
        turns = low * np.expm1(growth * np.clip(time - LEAD, 0, CHIRP_TIME)) / growth
        return np.asarray(centre + np.sin(2 * np.pi * turns)[:, None] * swing)

    return _Course(at, LEAD + CHIRP_TIME)


def _multisine(robot: RobotDescription, rng: np.random.Generator) -> _Course:
    centre, swing = _swing(robot, rng, CHIRP_AMPLITUDE)

    def waves(time: Array) -> Array:
        phases = np.pi * np.arange(len(MULTISINE_TONES)) ** 2 / len(MULTISINE_TONES)
        # Phases after Schroeder (1970), by which the sum's peak is low.
        turns = 2 * np.pi * time[:, None] * MULTISINE_TONES + phases
        return np.asarray(np.sin(turns).sum(axis=1))

    peak = np.abs(waves(np.arange(0.0, MULTISINE_TIME, PERIOD))).max()

    def at(time: Array) -> Array:
        height = np.clip(waves(time) / peak, -1.0, 1.0) * np.minimum(time / MULTISINE_GROWTH, 1.0)
        return np.asarray(centre + height[:, None] * swing)

    return _Course(at, MULTISINE_TIME)


def _triangle(robot: RobotDescription, rng: np.random.Generator) -> _Course:
    centre, swing = _swing(robot, rng, TRIANGLE_AMPLITUDE)
    quarter = TRIANGLE_AMPLITUDE / rng.uniform(*TRIANGLE_SPEED)
    heights = [0, 0, *([1, -1] * TRIANGLE_CYCLES), 0]
    gaps = [0, LEAD, quarter, *([2 * quarter] * (2 * TRIANGLE_CYCLES - 1)), quarter]
    return _ramped(gaps, [centre + height * swing for height in heights])


def _swing(robot: RobotDescription, rng: np.random.Generator, angle: float) -> tuple[Array, Array]:
    """A pose and a signed amplitude per joint whose straight line is free of self-collision."""
    room = _Room(robot, rng)
    reach = room.amplitude(angle)
    swing = room.signs() * reach

    def ends(pose: Array) -> list[Array] | None:
        return [pose] if room.clearance.path_free(pose - swing, pose + swing) else None

    return room.drawn(ends, reach)[0], swing


def _ramped(gaps: Sequence[float], poses: Sequence[Array]) -> _Course:
    """Straight from pose to pose, each reached `gaps` (s) after the one before it."""
    knots, corners = np.cumsum(gaps), np.array(poses)

    def at(time: Array) -> Array:
        return np.stack([np.interp(time, knots, column) for column in corners.T], axis=1)

    return _Course(at, float(knots[-1]))


_ALONE: dict[str, _Make] = {
    "stand": _stand,
    "hold": _hold,
    "chirp": _chirp,
    "triangle": _triangle,
    "multisine": _multisine,
}
"""Kinds without variants."""
