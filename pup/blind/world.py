"""What a concealed robot is: nominal parameters, what was added to them, and how it is integrated.

SI units and radians throughout.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pup.robot import RobotDescription

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Indices = NDArray[np.int64]

STEP = 0.0005  # s, of the truth
STEADY = 0.8  # of a step times the rate of servo damping; from 1 on it is unstable
SETTLING = 0.8  # s at rest before a recording on a fixed base, after the static sag is solved for
SETTLING_ON_FEET = 1.5  # s


def spanned(places: Sequence[int] | Indices) -> slice | Indices:
    """Places as a slice where they follow one another, which arrays are indexed by faster."""
    first, count = int(places[0]), len(places)
    if list(places) == list(range(first, first + count)):
        return slice(first, first + count)
    return np.array(places, dtype=np.int64)


@dataclass(frozen=True)
class Place:
    """Where an effect sits, as in a finding.

    Attributes:
      kind: `joint`, `group`, `body`, `foot`, `ground`, `sensor`, `bus` or `robot`.
      names: what of that kind; one name unless told otherwise.
    """

    kind: str
    names: tuple[str, ...]

    def document(self) -> dict[str, Any]:
        """As in a diagnosis."""
        return {"kind": self.kind, "names": list(self.names)}


@dataclass(frozen=True)
class Effect:
    """One thing that the nominal model does not have.

    Attributes:
      name: of the contract's list; `unknown` for what the list does not have.
      place: where it sits.
      size: the one number that says how much of it there is.
      size_name: what that number is called.
      unit: of that number.
      shape: further numbers of its form; part of the key, never scored.
      form: which of several physical forms it takes; names an unlisted one.
      inverse: whether a smaller number means more of it, as with a stiffness.
    """

    name: str
    place: Place
    size: float
    size_name: str
    unit: str
    shape: Mapping[str, float] = field(default_factory=dict)
    form: str = ""
    inverse: bool = False

    def scaled(self, factor: float) -> "Effect":
        """The same effect with `factor` times as much of it."""
        return replace(self, size=self.size / factor if self.inverse else self.size * factor)

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> "Effect":
        """From the key, to be simulated; which way its size counts is not in there."""
        place, size = document["place"], document["size"]
        return cls(
            document["effect"],
            Place(place["kind"], tuple(place["names"])),
            size["value"],
            size["name"],
            size["unit"],
            document["shape"],
            document["form"],
        )

    def document(self) -> dict[str, Any]:
        """As in the key."""
        return {
            "effect": self.name,
            "place": self.place.document(),
            "size": {"name": self.size_name, "value": self.size, "unit": self.unit},
            "shape": dict(self.shape),
            "form": self.form,
        }


@dataclass(frozen=True, eq=False)
class Nominal:
    """The parameters that a nominal fit may move, each of shape (n_joints,) but for the last two.

    Attributes:
      kp: N m/rad.
      kd: N m s/rad.
      tau_max: N m.
      armature: kg m2, of all joints.
      friction: sliding coefficient of the floor.
    """

    kp: Array
    kd: Array
    tau_max: Array
    armature: float
    friction: float

    @classmethod
    def of(cls, robot: RobotDescription, values: Mapping[str, float]) -> "Nominal":
        """Spread parameters by name (`kp/<group>`, ..., `armature`, `ground_friction`)."""
        kp, kd, tau_max = (
            np.array([values[f"{kind}/{joint.group}"] for joint in robot.joints])
            for kind in ("kp", "kd", "tau_max")
        )
        return cls(kp, kd, tau_max, values["armature"], values.get("ground_friction", 1.0))


def nominal_names(robot: RobotDescription, ground: bool) -> tuple[str, ...]:
    """The parameters that a nominal fit of this robot may move, in the order of `robot.toml`."""
    kinds = {"kp", "kd", "tau_max", "armature"} | ({"ground_friction"} if ground else set())
    return tuple(s.name for s in robot.parameters if s.name.partition("/")[0] in kinds)


def steady(nominal: Nominal, step: float) -> float:
    """A step, halved until even a rotor without a link is damped without ringing."""
    rate = float(nominal.kd.max()) / nominal.armature
    halvings = max(0, math.ceil(math.log2(step * rate / STEADY)))
    return step * 0.5**halvings


@dataclass(frozen=True)
class Engine:
    """How the truth is integrated.

    Attributes:
      step: s.
      integrator: `euler`, `rk4`, `implicit` or `implicitfast`.
      predicted: whether the servos see the speed of the middle of a kick; without it the speed of
        the beginning, as in most simulators.
      native: MuJoCo's own position servos instead of ours; for worlds without effects.
      cone: `pyramidal` or `elliptic`.
      solver: `newton`, `cg` or `pgs`.
      impratio: of friction to normal impedance.
      contact_time: time constant of contacts, s.
    """

    step: float = STEP
    integrator: str = "euler"
    predicted: bool = True
    native: bool = False
    cone: str = "pyramidal"
    solver: str = "newton"
    impratio: float = 1.0
    contact_time: float = 0.02

    def document(self) -> dict[str, Any]:
        """As in the key."""
        return dict(vars(self))


@dataclass(frozen=True, eq=False)
class World:
    """A concealed robot.

    Attributes:
      robot: its description.
      nominal: its parameters.
      effects: what the nominal model lacks.
      engine: how it is integrated.
      seed: of the noise that is part of its physics.
    """

    robot: RobotDescription
    nominal: Nominal
    effects: tuple[Effect, ...] = ()
    engine: Engine = Engine()
    seed: int = 0

    def joints_at(self, place: Place) -> list[int]:
        """The joints that a place covers, by their order in the robot."""
        joints = self.robot.joints
        if place.kind == "joint":
            return [i for i, joint in enumerate(joints) if joint.name in place.names]
        if place.kind == "group":
            return [i for i, joint in enumerate(joints) if joint.group in place.names]
        return list(range(len(joints)))


@dataclass(frozen=True, eq=False)
class Plan:
    """What is done in one recording.

    Attributes:
      id: of the recording.
      motion: motion type.
      support: `suspended`, `ground` or `bench`.
      time: ticks, s from 0, shape (n_ticks,).
      target: shape (n_ticks, n_joints), rad; at rest in the first row.
      enabled: torque on or off at each tick, shape (n_ticks,); None is on throughout.
      setup: the robot's knobs, as set.
      repeat_of: id of the plan this one repeats.
      test: kept from the engine for the held-out score.
    """

    id: str
    motion: str
    support: str
    time: Array
    target: Array
    enabled: Bools | None = None
    setup: Mapping[str, float] = field(default_factory=dict)
    repeat_of: str | None = None
    test: bool = False
