"""What the report of a diagnosis calls places, parameters and numbers."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pup.diagnosis.laws import WORDS
from pup.physics.terms import TERMS, Place
from pup.robot import RobotDescription
from pup.sysid.accuracy import JointUnits
from pup.sysid.wording import listed

SAID = 0.05
"""A nominal parameter that is wrong by less than this share is not worth a word."""

_TOKENS = {
    "l": "left",
    "r": "right",
    "fl": "front left",
    "fr": "front right",
    "rl": "rear left",
    "rr": "rear right",
    "hl": "hind left",
    "hr": "hind right",
    "ank": "ankle",
    "sho": "shoulder",
    "el": "elbow",
}
_SINGLE = {"ground": "the floor", "sensor": "the IMU", "bus": "all servos", "robot": "the robot"}
_EVERYWHERE = "all joints"
"""Where the whole robot is the place of what joints do: these stick and have gears, it does not."""
_PARAMETERS = {
    "kp": "stiffness kp",
    "kd": "damping kd",
    "tau_max": "torque limit tau_max",
    "armature": "rotor inertia",
    "ground_friction": "floor friction",
}
_QUANTITIES = {
    "gap": "half of the play",
    "rest": "more at rest",
    "drop": "drop per total torque",
    "slowness": "time per way",
    "sluggishness": "time per speed gained",
    "teeth": "ripples per turn",
    "behind": "encoder: 1 at the link, 0 at the motor",
    "lasting": "goes on without torque: 1 yes, 0 no",
    "load": "grows with the load: 1 yes, 0 with time",
    "astray": "error on motions left out, times the noise",
}
SLIDING = {
    "rad": "m",
    "rad/s": "m/s",
    "N m": "N",
    "N m/rad": "N/m",
    "N m s/rad": "N s/m",
    "N m s2/rad2": "N s2/m2",
    "N m/(rad s)": "N/(m s)",
    "rad/(N m)": "m/N",
    "1/(N m)": "1/N",
    "s/rad": "s/m",
    "s2/rad": "s2/m",
    "kg m2": "kg",
}
"""The units that are meant on a slide, by those of the library."""


def spoken(name: str) -> str:
    """A name of the MJCF as people say it: `l_ank_pitch` is the left ankle pitch."""
    words = re.sub(r"_(joint|link)$", "", name).replace("-", "_").split("_")
    return " ".join(_TOKENS.get(word.lower(), word) for word in words if word) or name


def parameter_words(name: str) -> str:
    """A nominal parameter: `kd/knee` is the damping kd of the knee."""
    kind, _, owner = name.partition("/")
    known = _PARAMETERS.get(kind, kind)
    return f"{known} of the {spoken(owner)}" if owner else known


def effect_words(effect: str) -> str:
    """An effect's name in a label."""
    words = effect.replace("_", " ")
    words = re.sub("^(coulomb|stribeck)", lambda name: capital(name[0]), words)
    return re.sub("^imu", "IMU", re.sub("^com ", "centre of mass ", words))


def quantity_words(name: str) -> str:
    """A quantity's name where people read it."""
    return _QUANTITIES.get(name, name)


def change(share: float) -> str:
    """A relative change, signed."""
    value = round(100 * share)
    return minus(f"{value:+d} %") if value else "0 %"


def digits(value: float, count: int = 2) -> str:
    """Significant digits, never with an exponent."""
    return np.format_float_positional(
        float(value), precision=count, unique=False, fractional=False, trim="-"
    )


def percent(share: float) -> str:
    """A share, to whole per cents where it has two digits of them."""
    value = 100 * share
    if abs(value) < 0.05:
        return "0 %"
    return f"{value:.0f} %" if abs(value) >= 9.5 else f"{digits(value)} %"


def minus(text: str) -> str:
    """The same with a real minus sign."""
    return re.sub(r"(?<![\w)])-(?=[\d.])", "\u2212", text)


def capital(text: str) -> str:
    """The same with a capital letter at its start."""
    return text[:1].upper() + text[1:]


@dataclass(frozen=True)
class Speech:
    """How to speak of one robot.

    Attributes:
      robot: the robot.
      units: of its joints.
    """

    robot: RobotDescription
    units: JointUnits

    def place(self, place: Place, effect: str = "") -> str:
        """A place, with its article, of an effect that acts there."""
        if place.kind == "robot" and effect in TERMS and "joint" in TERMS[effect].kinds:
            return _EVERYWHERE
        if place.kind in _SINGLE:
            return _SINGLE[place.kind]
        if place.kind == "group":
            return f"the {spoken(place.name)} joints"
        if place.kind == "foot":
            side = spoken(place.name).split()[0]
            return f"the {side} foot" if side in ("left", "right") else f"the {spoken(place.name)}"
        if place.kind == "body":
            if place.name == self.robot.torso:
                return "the torso"
            link = " link" if place.name.endswith("_link") else ""
            return f"the {spoken(place.name)}{link}"
        return f"the {spoken(place.name)}"

    def places(self, effect: str, places: Sequence[Place]) -> str:
        """Several places of one effect: groups share their noun, all others their article."""
        if all(place.kind == "group" for place in places):
            return f"the {listed([spoken(place.name) for place in places])} joints"
        names = [self.place(place, effect) for place in places]
        if all(name.startswith("the ") for name in names):
            return f"the {listed([name.removeprefix('the ') for name in names])}"
        return listed(names)

    def lack(self, effect: str, places: Sequence[Place]) -> str:
        """What a simulator lacks: an effect by its name, at its places."""
        at = "on" if places[0].kind in ("bus", "robot") else "at"
        return f"{effect_words(effect)} {at} {self.places(effect, places)}"

    def short(self, effect: str, place: Place) -> str:
        """An effect at a place, for a label."""
        where = self.place(place, effect).removeprefix("the ")
        return f"{effect_words(effect)}, {where}"

    def heading(self, effect: str, place: Place) -> str:
        """An effect at a place, over a paragraph."""
        return f"{capital(self.place(place, effect))}: {WORDS[effect]}"

    def words(self, effect: str, place: Place) -> str:
        """An effect at a place, in a sentence."""
        at = "on" if place.kind in ("bus", "robot") else "at"
        return f"{WORDS[effect]} {at} {self.place(place, effect)}"

    def channels(self) -> list[str]:
        """What is read: the joints, then the torso's angles."""
        return [*(spoken(name) for name in self.robot.joint_names), "torso roll", "torso pitch"]

    @property
    def slides(self) -> bool:
        """Whether joints slide: their positions are in m."""
        return not self.units.turning

    def unit(self, unit: str) -> str:
        """The unit meant where the library says `unit`."""
        return SLIDING.get(unit, unit) if self.units.position == "m" else unit

    def angle(self, value: float, count: int = 2) -> str:
        """A position, in degrees or mm, to some digits."""
        if self.slides:
            return f"{digits(1000 * value, count)} {self.units.small}"
        degrees = float(np.degrees(value))
        small = f" ({digits(1000 * value, count)} mrad)" if 0 < abs(degrees) < 0.1 else ""
        return f"{digits(degrees, count)}°{small}"

    def speed(self, value: float) -> str:
        """A speed, in degrees or mm per second."""
        return f"{self.angle(value)}/s"

    def torque(self, value: float) -> str:
        """A torque or force."""
        unit = self.unit("N m")
        return f"{digits(1000 * value)} m{unit}" if abs(value) < 0.01 else f"{digits(value)} {unit}"

    def quantity(self, value: float, unit: str, count: int = 2) -> str:
        """A number in the unit that a mechanic would use, to some digits."""
        if unit in ("rad", "rad/s"):
            return minus(self.angle(value, count) + unit.removeprefix("rad"))
        everyday = {"s": (1000, "ms"), "m": (1000, "mm"), "kg": (1000, "g"), "1/s": (100, "%/s")}
        factor, name = everyday.get(unit, (1, self.unit(unit)))
        if unit == "s" and abs(value) >= 1:
            factor, name = 1, "s"
        return minus(f"{digits(factor * value, count)} {name}".removesuffix(" 1"))

    def shifts(self, absorbed: Mapping[str, float], most: int = 2) -> str:
        """Which nominal parameters were how wrong; empty where none was by much."""
        worst = [(n, s) for n, s in absorbed.items() if abs(s) >= SAID][:most]
        return listed([f"{parameter_words(n)} ({shift(s)})" for n, s in worst])


def shift(share: float) -> str:
    """By how much something is wrong."""
    if share > 2:
        return f"{digits(1 + share)} times what it should be"
    return f"{abs(100 * share):.0f} % too {'high' if share > 0 else 'low'}"
