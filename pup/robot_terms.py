"""What `robot.toml` adds to the nominal model: terms, each an effect at a place.

Which effects there are, and what they are told, the physics knows; here only the place is checked.
"""

from collections.abc import Collection
from typing import get_args

from pup.robot_mjcf import MjcfNames, absent
from pup.robot_parts import SINGLE_KINDS, Joint, PlaceKind, TermSpec
from pup.robot_toml import Table, listed


def read_terms(
    table: Table,
    joints: tuple[Joint, ...],
    groups: tuple[str, ...],
    feet: tuple[str, ...],
    imu_site: str | None,
    model: MjcfNames,
) -> tuple[TermSpec, ...]:
    """Read the terms; an effect stands once at a place."""
    names: dict[PlaceKind, Collection[str]] = {
        "joint": [joint.name for joint in joints],
        "group": groups,
        "foot": feet,
    }
    terms: list[TermSpec] = []
    for entry in table.tables("term"):
        effect = entry.name("effect")
        place = entry.table("place")
        kind = place.text("kind")
        kinds = [known for known in get_args(PlaceKind) if known == kind]
        if not kinds:
            raise place.mistake("kind", f"{kind!r} is none of {listed(get_args(PlaceKind))}")
        if kind == "sensor" and imu_site is None:
            raise place.mistake(
                "kind", "the robot has no IMU (imu_site); the term would do nothing"
            )
        if kind == "ground" and not feet:
            raise place.mistake("kind", "the robot has no feet; the term would do nothing")
        name = _name(place, kinds[0], names, model)
        place.close()
        quantities = entry.table("values")
        values = {quantity: quantities.number(quantity) for quantity in quantities.left()}
        entry.close()
        if (effect, kind, name) in [(other.effect, other.kind, other.name) for other in terms]:
            raise entry.mistake("effect", f"{effect} stands twice at this place; remove one")
        terms.append(TermSpec(effect, kinds[0], name, values))
    return tuple(terms)


def _name(
    place: Table,
    kind: PlaceKind,
    names: dict[PlaceKind, Collection[str]],
    model: MjcfNames,
) -> str:
    if kind in SINGLE_KINDS:
        if place.has("name"):
            raise place.mistake("name", f"there is one {kind}; leave the name out")
        return ""
    name = place.text("name")
    if kind == "body":
        if name not in model.bodies:
            raise place.mistake("name", absent("body", name))
    elif name not in names[kind]:
        known = listed(names[kind]) or "none"
        raise place.mistake("name", f"the robot has no {kind} {name!r}; it has: {known}")
    return name
