"""A first `robot.toml`: what names of joints tell, and how it is written."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import tomlkit

from pup.robot_parts import Joint, ParameterSpec

SIDES = {
    "l": "r",
    "left": "right",
    "lf": "rf",
    "fl": "fr",
    "lh": "rh",
    "hl": "hr",
    "rl": "rr",
    "bl": "br",
    "lb": "rb",
}
"""Words for left, each with its right: also of legs, as `fl` is front left and `rl` rear left."""
ENDS = {"front", "rear", "hind", "back", "middle"}
AXES = {"pitch", "roll", "yaw", "tilt", "pan", "x", "y", "z"}
FILLERS = {"joint", "motor", "servo", "act", "j", "dof"}
OTHER = SIDES | {right: left for left, right in SIDES.items()}
WORD = re.compile(r"[A-Za-z]+|\d+|[^A-Za-z\d]+")


@dataclass(frozen=True)
class Draft:
    """A description without knobs, terms and a gait, which no model tells.

    Attributes:
      name: of the robot.
      joints: in the order of the model.
      parameters: the parameter space.
      torso: the body whose motion counts; None for a fixed base.
      imu_site: a site of the torso.
      feet: bodies that touch the floor.
      poses: joint angles by name of the pose, rad.
      notes: what was guessed, or is for the user to see to.
    """

    name: str
    joints: tuple[Joint, ...]
    parameters: tuple[ParameterSpec, ...]
    torso: str | None
    imu_site: str | None
    feet: tuple[str, ...]
    poses: dict[str, tuple[float, ...]]
    notes: tuple[str, ...]


def partner(name: str) -> str:
    """What the joint on the other side would be called; the name itself on the mid-plane."""
    words = WORD.findall(name)
    swapped = [_cased(OTHER.get(word.lower(), word), word) for word in words]
    return "".join(swapped)


def group_of(name: str) -> str:
    """A joint's group: its name without side, end and axis, such as `knee` for `l_knee_pitch`."""
    words = [w.lower() for w in WORD.findall(name) if w[0].isalnum()]
    own = [w for w in words if w not in OTHER.keys() | ENDS and not w.isdigit()]
    told = [w for w in own if w not in AXES | FILLERS] or [w for w in own if w not in FILLERS]
    return "_".join(told or own) or name


def written(draft: Draft, source: str) -> str:
    """The text of `robot.toml`.

    Args:
      draft: what it says.
      source: what it was drafted from.
    """
    document = tomlkit.document()
    for line in (f"Drafted from {source}. Look at:", *(f"- {note}" for note in draft.notes)):
        document.add(tomlkit.comment(line))
    document.add("schema", tomlkit.item(1))
    document.add("name", tomlkit.item(draft.name))
    for key in ("torso", "imu_site"):
        if getattr(draft, key):
            document.add(key, tomlkit.item(getattr(draft, key)))
    if draft.feet:
        document.add("feet", tomlkit.item(list(draft.feet)))
    document.add("joint", _tables([_of_joint(joint) for joint in draft.joints]))
    if draft.poses:
        document.add("poses", _poses(draft))
    document.add("parameter", _tables([_of_parameter(spec) for spec in draft.parameters]))
    return tomlkit.dumps(document)


def _cased(word: str, like: str) -> str:
    if like.isupper():
        return word.upper()
    return word.capitalize() if like[:1].isupper() else word


def _of_joint(joint: Joint) -> dict[str, Any]:
    told: dict[str, Any] = {"name": joint.name}
    if joint.servo_id is not None:
        told["servo_id"] = joint.servo_id
    told |= {"group": joint.group, "lower": joint.lower, "upper": joint.upper}
    if joint.mirror is not None:
        told["mirror"] = joint.mirror
        if joint.mirror_sign < 0:
            told["mirror_sign"] = -1
    return told


def _of_parameter(spec: ParameterSpec) -> dict[str, Any]:
    return {
        "name": spec.name,
        "unit": spec.unit,
        "nominal": spec.nominal,
        "search": list(spec.search),
        "actuators": list(spec.actuators),
    }


def _poses(draft: Draft) -> Any:
    names = [joint.name for joint in draft.joints]
    poses = tomlkit.table(is_super_table=True)
    for pose, angles in draft.poses.items():
        table = tomlkit.table()
        table.update(dict(zip(names, angles, strict=True)))
        poses.add(pose, table)
    return poses


def _tables(entries: Sequence[dict[str, Any]]) -> Any:
    tables = tomlkit.aot()
    for entry in entries:
        table = tomlkit.table()
        table.update(entry)
        tables.append(table)
    return tables
