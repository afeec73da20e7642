"""What could be missing: every effect of the physics library at every place the data can show."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import mujoco
import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.residuals import Measured
from pup.physics.model import compile_model
from pup.physics.terms import CLASS_OF, TERMS, Place, Quantity, column
from pup.physics.terms.scale import Scale
from pup.robot import RobotDescription

MODERATE = 0.5
"""A hypothesis is first looked at in this share of its typical size."""
FROM_OUTSIDE = frozenset(("external_force",))
"""Effects of a wrench: on the torso where it is free, on links where that is fixed. One joint alone
cannot tell a force on its link from a centre of mass elsewhere."""

LASTING = "lasting"
"""A shape that says what becomes of a state while the torque is off."""

EVERYWHERE = ("robot", "bus")
"""Kinds of places that all servos are at."""


@dataclass(frozen=True)
class Hypothesis:
    """One effect at one place, with the shape it is first tried in.

    Attributes:
      effect: its name.
      place: where it acts.
      scale: of the robot.
      shape: values of its shape quantities, by column.
      sign: of the sizes that it is first tried in.
      joint: of a link, the joint that moves it; else empty.
    """

    effect: str
    place: Place
    scale: Scale
    shape: tuple[tuple[str, float], ...] = ()
    sign: float = 1.0
    joint: str = ""

    @property
    def family(self) -> str:
        """The class of effects that scoring treats as one."""
        return CLASS_OF[self.effect]

    @property
    def key(self) -> tuple[str, Place]:
        """What it claims, whatever its shape."""
        return self.effect, self.place

    @property
    def seat(self) -> Place:
        """Where it shows: a link's flex bends what its joint's play would let go."""
        return Place("joint", self.joint) if self.joint else self.place

    def sibling_of(self, other: "Hypothesis") -> bool:
        """Whether both are forms of one class at one place; each is its own sibling."""
        everywhere = self.place.kind in EVERYWHERE and other.place.kind in EVERYWHERE
        return self.family == other.family and (self.seat == other.seat or everywhere)

    @property
    def form(self) -> tuple[float, ...]:
        """Its sign, and the values of its shape quantities."""
        return self.sign, *(value for _, value in self.shape)

    @property
    def moderate(self) -> float:
        """The size that it is first looked at in, in typical ones."""
        return self.sign * MODERATE

    @cached_property
    def magnitudes(self) -> tuple[str, ...]:
        """Columns that are zero where it is absent."""
        return tuple(
            column(self.effect, q.name, self.place) for q in TERMS[self.effect].magnitudes()
        )

    @cached_property
    def typical(self) -> tuple[float, ...]:
        """Typical sizes of the magnitudes, in their units."""
        return tuple(q.typical * self.scale.factor(q.unit) for q in TERMS[self.effect].magnitudes())

    @cached_property
    def signed(self) -> bool:
        """Whether its one magnitude may be negative; true where it has several."""
        sizes = TERMS[self.effect].magnitudes()
        return len(sizes) > 1 or sizes[0].signed

    @cached_property
    def continuous(self) -> tuple[str, ...]:
        """Columns of shapes that a refit may move: those that are not a choice of two."""
        return tuple(
            column(self.effect, q.name, self.place)
            for q in TERMS[self.effect].quantities
            if q.shape and not _choice(q)
        )

    @cached_property
    def choices(self) -> tuple[float, ...]:
        """Values of the other shapes, which no refit moves."""
        return tuple(value for name, value in self.shape if name not in self.continuous)

    @property
    def variant(self) -> tuple[tuple[str, Place], tuple[float, ...]]:
        """What it claims, in a shape that no refit leads away from."""
        return self.key, self.choices

    @cached_property
    def least(self) -> dict[str, float]:
        """Magnitudes below which it is another thing, whatever it explains, in their units."""
        share = TERMS[self.effect].least
        return {n: share * t for n, t in zip(self.magnitudes, self.typical, strict=True)}

    @property
    def telling(self) -> tuple[str, ...]:
        """Columns of shapes that tell it from other forms of its class."""
        return tuple(column(self.effect, n, self.place) for n in TERMS[self.effect].telling)

    def row(self, sizes: Mapping[str, float] | None = None) -> dict[str, float]:
        """The term's columns, at given magnitudes or at moderate ones."""
        given = sizes or {
            n: self.moderate * t for n, t in zip(self.magnitudes, self.typical, strict=True)
        }
        return {**dict(self.shape), **given}

    def probes(self, share: float = 1.0) -> list[dict[str, float]]:
        """One row for each magnitude alone, at a share of its moderate size."""
        return [
            self.row({name: share * self.moderate * typical})
            for name, typical in zip(self.magnitudes, self.typical, strict=True)
        ]


SEVERAL = frozenset(("scan_delay",))
"""Effects that need several joints."""


def hypotheses(measured: Measured) -> list[Hypothesis]:
    """All hypotheses about some measurements, but for what the robot's description has already."""
    scale = Scale.of(measured.robot)
    known = {(term.effect, Place(term.kind, term.name)) for term in measured.robot.terms}
    model = _compiled(measured)
    movers = _movers(measured.robot, model)
    return [
        Hypothesis(effect, place, scale, shape, sign, movers.get(place, ""))
        for effect, term in TERMS.items()
        for place in _places(effect, measured, model)
        if (effect, place) not in known
        for shape in _shapes(effect, place, measured, scale)
        for sign in ((1.0, -1.0) if term.one_way else (1.0,))
    ]


def _shapes(
    effect: str, place: Place, measured: Measured, scale: Scale
) -> Iterator[tuple[tuple[str, float], ...]]:
    """Combinations of shape values to look at."""
    if effect == "joint_stop":
        yield from _stops(place, measured)
        return
    quantities = [q for q in TERMS[effect].quantities if q.shape]
    grids = [q.grid if q.name != LASTING or _goes_limp(measured) else (0.0,) for q in quantities]
    for values in product(*grids):
        yield tuple(
            (column(effect, q.name, place), v * scale.factor(q.unit))
            for q, v in zip(quantities, values, strict=True)
        )


def _goes_limp(measured: Measured) -> bool:
    """Whether the torque goes off in any recording."""
    power = (r.extras.get("torque_enabled") for r in measured.recordings)
    return any(told is not None and bool((told < 1).any()) for told in power)


def _stops(place: Place, measured: Measured) -> Iterator[tuple[tuple[str, float], ...]]:
    """Stops just inside the ends of where a joint has been."""
    joint = measured.robot.joint_names.index(place.name)
    visited = measured.values[measured.channel == joint]
    if not len(visited):
        return
    usual = {q.name: q.nominal for q in TERMS["joint_stop"].quantities if q.shape}
    for side, quantile in ((-1.0, 0.03), (1.0, 0.97)):
        told = usual | {"angle": float(np.quantile(visited, quantile)), "side": side}
        yield tuple((column("joint_stop", name, place), value) for name, value in told.items())


def _places(effect: str, measured: Measured, model: mujoco.MjModel) -> Iterator[Place]:
    """Places where an effect would show."""
    robot, kinds = measured.robot, TERMS[effect].kinds
    ground = any(r.support == "ground" for r in measured.recordings)
    one = len(robot.joints) == 1
    if one and effect in SEVERAL:
        return
    for kind in kinds:
        if kind == "joint":
            yield from (Place("joint", name) for name in robot.joint_names)
        elif kind == "group":
            members = np.bincount(robot.group_index, minlength=len(robot.groups))
            whole = len(robot.joints) if set(kinds) & set(EVERYWHERE) else np.inf  # told once
            yield from (
                Place("group", g)
                for g, n in zip(robot.groups, members, strict=True)
                if 1 < n < whole
            )
        elif kind == "body":
            yield from _bodies(effect, measured, model)
        elif kind in ("ground", "sensor", "foot") and ground:
            names = robot.feet if kind == "foot" else ("",)
            yield from (Place(kind, name) for name in names)
        elif kind in ("bus", "robot") and (not one or kinds == (kind,)):
            yield Place(kind)


def _compiled(measured: Measured) -> mujoco.MjModel:
    """The robot on the ground if it ever is, else as it was recorded."""
    supports = {r.support for r in measured.recordings}
    support = "ground" if "ground" in supports else next(iter(supports))
    return compile_model(measured.robot, support).compiled


def _movers(robot: RobotDescription, model: mujoco.MjModel) -> dict[Place, str]:
    """Of each link that a joint of the robot moves, that joint: the nearest one above it."""
    moved = {int(model.joint(name).bodyid[0]): name for name in robot.joint_names}
    nearest: dict[int, str] = {}
    for body in range(1, model.nbody):  # parents come before their children
        joint = moved.get(body) or nearest.get(int(model.body_parentid[body]))
        if joint:
            nearest[body] = joint
    return {Place("body", model.body(body).name): joint for body, joint in nearest.items()}


def _bodies(effect: str, measured: Measured, model: mujoco.MjModel) -> Iterator[Place]:
    """Bodies whose motion the data can show: links that joints move, and a free torso."""
    robot = measured.robot
    supports = {r.support for r in measured.recordings}
    carried = [int(model.joint(name).bodyid[0]) for name in robot.joint_names]
    if effect == "structural_flex":
        yield from (Place("body", model.body(b).name) for b in dict.fromkeys(carried))
        return
    outside = effect in FROM_OUTSIDE
    least = 2 if outside else 1
    for body in range(1, model.nbody):
        joints = sum(_is_below(model.body_parentid, body, c) for c in carried)
        free = "ground" in supports and model.body(body).name == robot.torso
        held = joints >= least and not (outside and supports == {"ground"})
        if (held or free) and model.body_mass[body] > 0.01:
            yield Place("body", model.body(body).name)


def _is_below(parents: NDArray[np.int32], body: int, ancestor: int) -> bool:
    """Whether a body is another one or hangs on it."""
    while body:
        if body == ancestor:
            return True
        body = int(parents[body])
    return False


def _choice(shape: Quantity) -> bool:
    return shape.unit == "1" and len(shape.grid) == 2
