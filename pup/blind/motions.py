"""What a laboratory's recording kit plays: commands only."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pup.blind.world import Array, Plan
from pup.errors import InputError
from pup.robot import RobotDescription
from pup.sysid.clearance import Clearance
from pup.sysid.excitation import script

GRID = 0.0005  # s; ticks stand at whole multiples
GAPS = (1 / 33, 1 / 25)  # s between ticks
ROUGH_GAPS = (1 / 40, 1 / 18)  # s, the same of rough sensors
LATE = 0.0003  # s by which a repeat's ticks differ
DURATION = (6.0, 10.0)  # s
ROOM = 0.004  # m between links
BASES, SHRINKS = 400, 5  # tries
STRIDE = 0.05  # s between poses that are checked
LIMB = ("step", "chirp", "triangle", "hold", "multisine", "drop")
FEET = ("stand", "standup", "multisine")
REST = 0.3  # s before anything moves
STILL = 0.6  # s, the same on the ground

Course = Callable[[Array], Array]


@dataclass(frozen=True)
class Reach:
    """How far a robot's motions go.

    Attributes:
      steps: sizes of steps, rad.
      swing: amplitude of slow motions, rad.
      shake: amplitude of fast ones, rad.
      limp: longest time without torque, s.
      span: largest angle from the middle of the range, rad.
    """

    steps: tuple[float, ...] = (0.1, 0.3, 0.6)
    swing: float = 0.3
    shake: float = 0.15
    limp: float = 0.35
    span: float = 1.6


BENCH = Reach(steps=(0.1, 0.3, 0.6, 1.0), swing=0.9, shake=0.25, limp=0.5, span=1.2)


class Choreographer:
    """Makes plans that are free of self-collision.

    Args:
      robot: who is to play them.
      rng: source of all that is random.
      gaps: shortest and longest time between ticks, s.
    """

    def __init__(
        self, robot: RobotDescription, rng: np.random.Generator, gaps: tuple[float, float] = GAPS
    ) -> None:
        self.robot, self.rng, self.gaps = robot, rng, gaps
        self.lower = np.array([joint.lower for joint in robot.joints])
        self.upper = np.array([joint.upper for joint in robot.joints])
        self.clearance = Clearance(robot, ROOM)
        self.reach = BENCH if len(robot.joints) == 1 else Reach()
        self.support = "suspended" if robot.floating else "bench"

    def limb(self, motion: str) -> Plan:
        """A motion of the limbs in the air.

        Raises:
          InputError: no free way was found.
        """
        end = float(self.rng.uniform(*DURATION))
        fast = motion in ("chirp", "multisine")
        size = max(self.reach.steps) if motion == "step" else self.reach.swing
        size = self.reach.shake if fast else 0.5 * size if motion == "drop" else size
        for _ in range(BASES):
            amplitude = np.minimum(size, 0.42 * (self.upper - self.lower))
            for _ in range(SHRINKS):
                base = self._base(amplitude, 0.4 if motion == "drop" else 1.0)
                course = self._course(motion, base, amplitude, end)
                if self._free(course, end):
                    return self._plan(motion, course, end)
                amplitude = 0.7 * amplitude
        raise InputError(f"robot {self.robot.name!r}: no {motion} free of self-collision was found")

    def feet(self, motion: str) -> Plan:
        """A motion on the ground that stays on its feet, or a `fall` or `walk`."""
        end = float(self.rng.uniform(*DURATION))
        if motion == "fall":
            way = str(self.rng.choice(["forward", "left", "right"]))
            made = script(self.robot, [f"fall:{way}"], self.rng)[0]
            time = self._ticks(float(made.time[-1]))
            row = np.searchsorted(made.time, time, side="right") - 1
            return Plan("", "fall", "ground", time, made.target[row])
        stand, squat, half = (
            np.array(self.robot.poses[p]) for p in ("stand", "squat", "half_squat")
        )
        if motion == "standup":
            pace = float(self.rng.uniform(1.2, 2.4))
            gaps = (0.0, STILL, pace, 1.0, pace, 0.8)
            course = _ramped(gaps, (squat, squat, stand, stand, squat, squat))
            end = sum(gaps)
        elif motion == "walk":
            course = self._walk(float(self.rng.uniform(0.35, 0.5)))
        else:
            centre = half if self.rng.uniform() < 0.5 else 0.5 * (stand + half)
            course = self._sway(motion, centre, end)
        return replace(self._plan(motion, course, end), support="ground")

    def again(self, plan: Plan, id: str) -> Plan:
        """The same once more, its ticks a little off."""
        late = np.abs(self.rng.normal(0.0, LATE, size=len(plan.time)))
        late[0] = 0.0
        time = _gridded(plan.time + late)
        return replace(plan, id=id, time=time, repeat_of=plan.id)

    def _base(self, amplitude: Array, share: float) -> Array:
        middle, span = 0.5 * (self.lower + self.upper), share * self.reach.span
        low = np.maximum(self.lower + amplitude, middle - span)
        high = np.minimum(self.upper - amplitude, middle + span)
        pose = self.rng.uniform(low, high)
        if "stand" in self.robot.poses and self.robot.floating:
            rest = np.clip(np.array(self.robot.poses["stand"]), low, high)
            pose = rest + self.rng.uniform(0.1, 0.5) * (pose - rest)
        return np.asarray(pose)

    def _free(self, course: Course, end: float) -> bool:
        path = course(np.arange(0.0, end + STRIDE, STRIDE))
        inside = (path >= self.lower - 1e-9).all() and (path <= self.upper + 1e-9).all()
        return bool(inside) and all(self.clearance.free(pose) for pose in path)

    def _course(self, motion: str, base: Array, amplitude: Array, end: float) -> Course:
        rng = self.rng
        sign = rng.choice((-1.0, 1.0), size=len(base))
        if motion == "step":
            return self._steps(base, amplitude, end)
        if motion == "triangle":
            quarter = float(rng.uniform(0.8, 1.6))
            count = int((end - REST) / quarter)
            heights = [0.0, 0.0, *([0.0, 1.0, 0.0, -1.0][(k + 1) % 4] for k in range(count))]
            gaps = [0.0, REST, *([quarter] * count)]
            return _ramped(gaps, [base + h * sign * amplitude for h in heights])
        if motion == "hold":
            heights, gaps, t = [0.0, 0.0], [0.0, REST], REST
            while t < end:
                move, stay = float(rng.uniform(0.3, 0.6)), float(rng.uniform(0.8, 1.4))
                others = [h for h in (-1.0, -0.5, 0.0, 0.5, 1.0) if h != heights[-1]]
                heights += [float(rng.choice(others))] * 2
                gaps += [move, stay]
                t += move + stay
            return _ramped(gaps, [base + h * sign * amplitude for h in heights])
        if motion == "drop":
            heights = [0.0, 0.0, *rng.uniform(-1, 1, size=6)]
            gaps = [0.0, REST, *([end / 6] * 6)]
            return _ramped(gaps, [base + h * sign * amplitude for h in heights])
        if motion == "chirp":
            low, high = 0.2, float(rng.uniform(3.0, 5.0))
            growth = np.log(high / low) / (end - REST)
            stagger = rng.uniform(0.85, 1.15, size=len(base))

            def chirp(time: Array) -> Array:
                turns = low * np.expm1(growth * np.maximum(time - REST, 0)) / growth
                return np.asarray(base + np.sin(2 * np.pi * turns[:, None] * stagger) * amplitude)

            return chirp
        return _multisine(rng, base, amplitude, rng.uniform(0.2, 2.5, size=5))

    def _steps(self, base: Array, amplitude: Array, end: float) -> Course:
        rng = self.rng
        poses, due, t = [base], [0.0], REST
        while t < end:
            size = rng.choice(self.reach.steps) / max(self.reach.steps)
            sign = rng.choice((-1.0, 1.0), size=len(base))
            step = poses[-1] + sign * size * amplitude
            far = np.abs(step - base) > amplitude
            poses.append(np.where(far, poses[-1] - sign * size * amplitude, step))
            poses[-1] = np.clip(poses[-1], base - amplitude, base + amplitude)
            due.append(t)
            t += float(rng.choice((0.25, 0.5, 1.0), p=(0.3, 0.5, 0.2))) * rng.uniform(0.9, 1.2)
        corners, times = np.array(poses), np.array(due)
        return lambda time: corners[np.searchsorted(times, time + 1e-9, side="right") - 1]

    def _sway(self, motion: str, centre: Array, end: float) -> Course:
        """Weight shifts on both feet: slow and held for `stand`, a sum of sines otherwise."""
        rng, names = self.rng, self.robot.joint_names
        side = np.array(["_roll" in n and ("hip" in n or "ank" in n) for n in names])
        front = np.array(["ank_pitch" in n for n in names])
        sign = np.array([-1.0 if n.startswith("r_") else 1.0 for n in names])
        lean, nod = 0.05 * side, 0.06 * front * sign
        free = np.array([not any(k in n for k in ("hip", "knee", "ank")) for n in names])
        arms = 0.25 * free * rng.choice((-1.0, 1.0), size=len(names))
        if motion == "stand":
            heights = rng.uniform(-1, 1, size=(int(end / 1.2), 2))
            corners = [centre, *(centre + a * lean + b * nod for a, b in heights)]
            knots = [c for corner in corners for c in (corner, corner)]
            return _ramped([0.0, STILL, *([0.4, 0.8] * len(heights))], knots)
        knee = np.array(["knee" in n for n in names]) * 0.1
        hip = np.array(["hip_pitch" in n for n in names]) * -0.05
        ankle = front * 0.05
        bend = (knee * -sign + hip * -sign + ankle * -sign) * 1.0
        shapes = [lean, 0.6 * nod, bend, arms]
        waves = [_multisine(rng, 0 * s, s, rng.uniform(0.15, 0.9, size=3), STILL) for s in shapes]

        def sway(time: Array) -> Array:
            moved = np.sum([wave(time) for wave in waves], axis=0)
            return np.asarray(np.clip(centre + moved, self.lower, self.upper))

        return sway

    def _walk(self, share: float) -> Course:
        gait = self.robot.gait
        if gait is None:
            raise InputError(f"robot {self.robot.name!r} has no gait to walk with")
        cycle = gait.angles(np.arange(200) / 200.0)
        centre = cycle.mean(axis=0)

        def walk(time: Array) -> Array:
            fade = np.clip((time - STILL) / 1.0, 0.0, 1.0)[:, None]
            swing = gait.angles((time - STILL) / gait.period) - centre
            return np.asarray(np.clip(centre + share * fade * swing, self.lower, self.upper))

        return walk

    def _ticks(self, end: float) -> Array:
        gaps = self.rng.uniform(*self.gaps, size=int(end / self.gaps[0]) + 1)
        time = np.append(0.0, np.cumsum(gaps))
        return _gridded(time[time <= end])

    def _plan(self, motion: str, course: Course, end: float) -> Plan:
        time = self._ticks(end)
        enabled = None
        if motion == "drop":
            enabled = np.ones(len(time), dtype=np.bool_)
            for start in self.rng.uniform(0.12, 0.4) * end + np.arange(2) * 0.4 * end:
                limp = self.rng.uniform(0.5, 1.0) * self.reach.limp
                enabled &= ~((time >= start) & (time < start + limp))
        return Plan("", motion, self.support, time, course(time), enabled)


def _gridded(time: Array) -> Array:
    """Times on the grid, strictly increasing."""
    ticks = np.round(time / GRID)
    floor = np.arange(len(ticks))
    return np.asarray((np.maximum.accumulate(ticks - floor) + floor) * GRID)


def _ramped(gaps: Sequence[float], poses: Sequence[Array]) -> Course:
    """Straight from pose to pose, each reached `gaps` (s) after the one before it."""
    knots, corners = np.cumsum(gaps), np.array(poses)
    return lambda time: np.stack([np.interp(time, knots, c) for c in corners.T], axis=1)


def _multisine(
    rng: np.random.Generator, base: Array, amplitude: Array, rates: Array, still: float = REST
) -> Course:
    """Sines of the rates (Hz), other phases for every joint, within the amplitude."""
    phases = rng.uniform(0, 2 * np.pi, size=(len(rates), len(base)))

    def course(time: Array) -> Array:
        fade = np.clip((time - still) / 0.5, 0, 1)[:, None]
        angle = 2 * np.pi * rates[:, None, None] * (time[None, :, None] - still)
        waves = np.sin(angle + phases[:, None]).sum(axis=0) / len(rates)
        return np.asarray(base + amplitude * fade * 1.5 * np.clip(waves, -2 / 3, 2 / 3))

    return course
