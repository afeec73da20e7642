"""A first `robot.toml`: what names of joints tell, and how it is written."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import tomlkit

from pup.robot_parts import Joint, ParameterSpec
from pup.robot_writer import entry_of, table, tables

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
WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|[^A-Za-z\d]+")


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
      timestep: of the physics, s; None for the usual one.
      notes: what was guessed, or is for the user to see to.
    """

    name: str
    joints: tuple[Joint, ...]
    parameters: tuple[ParameterSpec, ...]
    torso: str | None
    imu_site: str | None
    feet: tuple[str, ...]
    poses: dict[str, tuple[float, ...]]
    timestep: float | None
    notes: tuple[str, ...]


def partner(name: str) -> str:
    """What the joint on the other side would be called; the name itself on the mid-plane."""
    return "".join(_other(word) for word in WORD.findall(name))


def words_of(name: str) -> list[str]:
    """The words and numbers of a name in small letters, such as `left`, `hip` of `leftHip`."""
    return [word.lower() for word in WORD.findall(name) if word[0].isalnum()]


def group_of(name: str) -> str:
    """A joint's group: its name without side, end and axis, such as `knee` for `l_knee_pitch`."""
    own = [w for w in words_of(name) if w not in OTHER.keys() | ENDS and not w.isdigit()]
    told = [w for w in own if w not in AXES | FILLERS] or [w for w in own if w not in FILLERS]
    return "_".join(told or own) or name


def groups_of(names: Sequence[str], alike: Callable[[int, int], bool]) -> list[str]:
    """The group of each joint: by its name, divided where joints differ.

    Args:
      names: of the joints.
      alike: whether two joints, by their places, can share what a group shares.
    """
    groups = [group_of(name) for name in names]
    divided = list(groups)
    for group in dict.fromkeys(groups):
        parts: list[list[int]] = []
        for i in (i for i, own in enumerate(groups) if own == group):
            part = next((p for p in parts if all(alike(i, other) for other in p)), None)
            if part is None:
                parts.append([i])
            else:
                part.append(i)
        if len(parts) > 1:
            called = _told_apart([[names[i] for i in part] for part in parts], group)
            for part, name in zip(parts, called, strict=True):
                for i in part:
                    divided[i] = name
    return divided


def _told_apart(parts: list[list[str]], group: str) -> list[str]:
    """What the parts of a group are called: by the words that are left, or else by number."""
    aside = OTHER.keys() | ENDS | FILLERS | set(group.split("_"))
    told = []
    for part in parts:
        left = dict.fromkeys(word for name in part for word in words_of(name))
        told.append("_".join((group, *(w for w in left if w not in aside and not w.isdigit()))))
    if len(set(told)) == len(parts):
        return told
    return [f"{group}_{number}" for number in range(1, len(parts) + 1)]


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
    if draft.timestep is not None:
        document.add("timestep", tomlkit.item(draft.timestep))
    for key in ("torso", "imu_site"):
        if getattr(draft, key):
            document.add(key, tomlkit.item(getattr(draft, key)))
    if draft.feet:
        document.add("feet", tomlkit.item(list(draft.feet)))
    document.add("joint", tables([_of_joint(joint) for joint in draft.joints]))
    if draft.poses:
        document.add("poses", _poses(draft))
    document.add("parameter", tables([entry_of(spec) for spec in draft.parameters]))
    return tomlkit.dumps(document)


def _other(word: str) -> str:
    """The word for the other side, in the same case; any other word as it is."""
    other = OTHER.get(word.lower())
    if other is None:
        return word
    if word.isupper():
        return other.upper()
    return other.capitalize() if word[0].isupper() else other


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


def _poses(draft: Draft) -> Any:
    names = [joint.name for joint in draft.joints]
    poses = tomlkit.table(is_super_table=True)
    for pose, angles in draft.poses.items():
        poses.add(pose, table(dict(zip(names, angles, strict=True))))
    return poses
