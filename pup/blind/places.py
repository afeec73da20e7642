"""Places of effects: what they cover, and how far a told one is right."""

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import mujoco

from pup.robot import RobotDescription

WHOLE = ("bus", "robot")  # places that cover all joints


def credit(robot: RobotDescription, told: Mapping[str, Any], true: Mapping[str, Any]) -> float:
    """1 for the place, half for its mirror, or for a group that holds it or that it holds."""
    here, there = covered(robot, told), covered(robot, true)
    if here == there:
        return 1.0
    mirrors = {joint.name: joint.mirror for joint in robot.joints}
    if here == {mirrors.get(name) or name for name in there}:
        return 0.5
    nested = here < there or there < here
    return 0.5 if nested and _groups(robot) & {here, there} else 0.0


def covered(robot: RobotDescription, place: Mapping[str, Any]) -> frozenset[str]:
    """What a place covers: joints where it can be told in joints, else its kind and names."""
    kind, names = str(place["kind"]), [str(n) for n in place["names"]]
    if kind == "group":
        return frozenset(j.name for j in robot.joints if j.group in names)
    if kind in WHOLE:
        return frozenset(robot.joint_names)
    if kind in ("sensor", "ground"):
        return frozenset((kind,))
    if kind in ("body", "foot"):
        return frozenset(_joint_of(robot).get(name, f"body {name}") for name in names)
    return frozenset(names)


def _groups(robot: RobotDescription) -> set[frozenset[str]]:
    """The joints of each group that is more than a joint and less than the robot."""
    groups = (covered(robot, {"kind": "group", "names": [name]}) for name in robot.groups)
    return {group for group in groups if 1 < len(group) < len(robot.joints)}


@lru_cache(maxsize=8)
def _joint_of(robot: RobotDescription) -> dict[str, str]:
    """The joint that moves each body; bodies above all joints are left out."""
    model = mujoco.MjSpec.from_file(str(robot.model_path)).compile()
    found = {}
    for body in range(1, model.nbody):
        above = body
        while above and not model.body_jntnum[above]:
            above = model.body_parentid[above]
        name = model.joint(model.body_jntadr[above]).name if above else ""
        if name in robot.joint_names:
            found[model.body(body).name] = name
    return found
