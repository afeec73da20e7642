"""What could be recorded next: motions this robot can play, and what could be changed for them."""

from collections.abc import Iterator, Mapping
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.recording import Recording
from pup.robot import Knob, RobotDescription
from pup.sysid.excitation import PERIOD, Motion, possible_kinds, script

Array = NDArray[np.float64]

REST = 1.0
"""Time in the first pose before a motion, to come to rest, s."""
LASTS = 6.0
"""A motion is looked at for so long, s."""
SCRIPTS = {
    "step:0.02": "steps of 0.02 rad",
    "step:0.1": "steps of 0.1 rad",
    "step:0.3": "steps of 0.3 rad",
    "step:0.6": "steps of 0.6 rad",
    "triangle": "a slow triangle",
    "chirp": "a chirp to 5 Hz",
    "hold": "holds approached from both sides",
    "standup:2": "a stand-up within 2 s",
    "stand": "shifting the weight while standing",
    "multisine": "a multisine",
}
CHANGED = ("step:0.3", "triangle", "chirp", "hold", "standup:2")
"""Scripts that are also looked at with something else changed."""
FACTORS = (0.6, 1.6)
"""A knob is turned to these multiples of its default, within its limits."""
OFF = 0.5
"""Time at which a drop's torque goes off, s."""
DROP = 1.0
"""Time that it is off, s."""


@dataclass(frozen=True)
class Option:
    """One thing that could be recorded.

    Attributes:
      recording: its commands; what it would measure stands at the commands.
      words: what to do.
      other_floor: whether it is to be done on another floor.
    """

    recording: Recording
    words: str
    other_floor: bool = False

    @property
    def setup(self) -> Mapping[str, float]:
        """The knobs that are not as usual."""
        return self.recording.setup

    @property
    def plain(self) -> bool:
        """Whether nothing is changed but the motion."""
        return not self.setup and not self.other_floor


def options(robot: RobotDescription, seed: int = 0) -> list[Option]:
    """All that a robot could be asked to do, the least effort first."""
    made = {}
    possible = possible_kinds(robot)
    for kind in SCRIPTS:
        if kind.partition(":")[0] in possible:
            # It may have nothing to lean with; what else cannot be played is told as before.
            with suppress(InputError) if kind == "stand" else nullcontext():
                made[kind] = script(robot, (kind,), np.random.default_rng(seed))[0]
    told = [_option(robot, motion, SCRIPTS[kind]) for kind, motion in made.items()]
    told.append(_drop(robot, made["triangle"]))
    changed = [(made[kind], SCRIPTS[kind]) for kind in CHANGED if kind in made]
    for knob in robot.knobs:
        for value in _values(knob):
            note = f" with {knob.name} at {value:g}{_unit(knob)}"
            told += [_option(robot, m, words + note, {knob.name: value}) for m, words in changed]
    floors = [o for o in told if o.recording.support == "ground" and not o.setup]
    told += [replace(o, words=f"{o.words} on another floor", other_floor=True) for o in floors]
    return [replace(o, recording=replace(o.recording, id=f"next_{i}")) for i, o in enumerate(told)]


def _values(knob: Knob) -> Iterator[float]:
    """Other values of a knob that are worth trying."""
    for factor in FACTORS:
        value = float(np.clip(factor * knob.default, knob.lower, knob.upper))
        if abs(value - knob.default) > 0.1 * abs(knob.default):
            yield float(f"{value:.3g}")
    if knob.default == 0:
        yield float(f"{0.5 * knob.upper:.3g}")


def _unit(knob: Knob) -> str:
    return "" if knob.unit == "1" else f" {knob.unit}"


def _option(
    robot: RobotDescription,
    motion: Motion,
    words: str,
    setup: Mapping[str, float] | None = None,
    power: Array | None = None,
) -> Option:
    """A script as a recording that is yet to be made, after a rest in its first pose."""
    kept = motion.time <= LASTS
    time = np.concatenate([np.arange(0.0, REST, PERIOD), REST + motion.time[kept]])
    target = motion.target[kept]
    rest = len(time) - len(target)
    target = np.concatenate([np.repeat(target[:1], rest, axis=0), target])
    position = target.copy()
    position[1:rest] = np.nan  # what happens before it is at rest tells nothing
    extras = {}
    if power is not None:
        extras["torque_enabled"] = np.concatenate([np.ones(rest), power[kept]])
    if motion.support == "ground" and robot.imu_site is not None:
        upright = np.zeros(len(time))
        upright[:rest] = np.nan
        extras |= {"imu/roll": upright, "imu/pitch": upright}
    recording = Recording(
        id=motion.id,
        robot=robot.name,
        motion=motion.motion,
        support=motion.support,
        source="simulation",
        joints=robot.joint_names,
        time=time,
        target=target,
        position=position,
        extras=extras,
        setup=dict(setup or {}),
    )
    return Option(recording, words)


def _line(motion: Motion) -> tuple[Array, Array]:
    """Centre and swing of a motion along a straight line."""
    centre = motion.target[0]
    away = motion.target - centre
    return centre, away[np.argmax(np.abs(away).max(axis=1))]


def _drop(robot: RobotDescription, triangle: Motion) -> Option:
    """Torque off in a pose away from the middle."""
    centre, swing = _line(triangle)
    time = np.arange(round((OFF + DROP) / PERIOD), dtype=np.float64) * PERIOD
    target = np.repeat([centre + swing], len(time), axis=0)
    motion = replace(triangle, id="drop", motion="drop", time=time, target=target)
    power = np.where(time < OFF, 1.0, 0.0)
    return _option(robot, motion, "a drop with the torque off", power=power)
