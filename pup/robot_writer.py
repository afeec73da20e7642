"""A robot's folder written anew: other nominal parameters, other terms, all else as it was."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.items import AoT

from pup.errors import InputError
from pup.files import write_atomic
from pup.robot import ROBOT_LIMIT, RobotDescription, TermSpec
from pup.robot_mjcf import read_mjcf
from pup.robot_parts import Actuator, ParameterSpec
from pup.robot_reader import USUAL_TIMESTEP
from pup.robot_toml import read_text

WEIGHT = "phi/"


def check_folder(robot: RobotDescription, folder: Path) -> None:
    """Refuse to write a robot over the one that it comes from, or where a file is."""
    if folder.resolve() == robot.folder.resolve():
        raise InputError(f"{folder}: is the folder of {robot.name!r} itself; name another")
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: a file is in the place of this folder; move it away")


def write_corrected(
    robot: RobotDescription,
    folder: Path,
    parameters: Mapping[str, float],
    terms: Sequence[TermSpec],
    notes: str = "",
    actuator: Actuator = "pd",
) -> RobotDescription:
    """Write a robot that differs from another by its nominal parameters and its terms.

    The name stays, so that recordings of the one are recordings of the other; `identified.json`
    is not taken along, for the new nominal values stand in its place.

    Args:
      robot: the other.
      folder: where to write; files of the same names are replaced.
      parameters: nominal values by name, network weights among them; those left out stay. A search
        range that does not contain its value is widened.
      terms: all the terms that the robot shall have.
      notes: comment at the head of `robot.toml`.
      actuator: the torque law that they were found beside; the robot's default from then on.

    Returns:
      The robot as it reads back.

    Raises:
      InputError: a parameter the robot does not have, a value or a term that is refused when read
        back, or the folder is the other robot's own.
    """
    check_folder(robot, folder)
    document = tomlkit.parse(read_text(robot.folder / "robot.toml", ROBOT_LIMIT))
    values = {name: float(value) for name, value in parameters.items()}
    for spec in robot.parameters:
        if spec.name in values and values[spec.name] != spec.nominal:
            _set_parameter(document, spec, values[spec.name])
    names = {spec.name for spec in robot.parameters}
    for name, value in values.items():
        if name not in names:
            _set_weight(document, robot, name, value)
    if float(document.get("timestep", USUAL_TIMESTEP)) != robot.timestep:
        document["timestep"] = robot.timestep
    if robot.actuator != actuator:
        document["actuator"] = actuator
    document.pop("term", None)
    if terms:
        document.append("term", tables([_of_term(term) for term in terms]))
    head = "".join(f"# {line}".rstrip() + "\n" for line in notes.splitlines())
    for file in (Path("model.xml"), *read_mjcf(robot.model_path).files):
        write_atomic(folder / file, (robot.folder / file).read_bytes())
    write_atomic(folder / "robot.toml", head + tomlkit.dumps(document))
    return RobotDescription.load(folder)


def _set_parameter(document: Any, spec: ParameterSpec, value: float) -> None:
    """Change a parameter's own table, or add one behind the pattern it comes from."""
    search = [min(spec.search[0], value), max(spec.search[1], value)]
    for entry in document["parameter"]:
        if entry["name"] == spec.name:
            entry["nominal"] = value
            if search != list(spec.search):
                entry["search"] = search
            return
    added = entry_of(replace(spec, nominal=value, search=(search[0], search[1])))
    entries = document["parameter"]
    entries.append(table(added) if isinstance(entries, AoT) else added)


def _set_weight(document: Any, robot: RobotDescription, name: str, value: float) -> None:
    """Change a weight of the network, which is no `[[parameter]]`."""
    index = name.removeprefix(WEIGHT)
    weights = () if robot.network is None else robot.network.weights
    if not name.startswith(WEIGHT) or not index.isdecimal() or int(index) >= len(weights):
        raise InputError(f"parameter {name!r}: robot {robot.name!r} has none of that name")
    if value != weights[int(index)]:
        document["network"]["weights"][int(index)] = value


def _of_term(term: TermSpec) -> dict[str, Any]:
    place = {"kind": term.kind, "name": term.name} if term.name else {"kind": term.kind}
    return {
        "effect": term.effect,
        "place": _inline(place),
        "values": _inline({name: float(value) for name, value in term.values.items()}),
    }


def _inline(values: Mapping[str, Any]) -> Any:
    table = tomlkit.inline_table()
    table.update(values)
    return table


def table(values: Mapping[str, Any]) -> Any:
    """A TOML table."""
    made = tomlkit.table()
    made.update(values)
    return made


def tables(entries: Sequence[Mapping[str, Any]]) -> Any:
    """A TOML array of tables."""
    several = tomlkit.aot()
    for entry in entries:
        several.append(table(entry))
    return several


def entry_of(spec: ParameterSpec) -> dict[str, Any]:
    """A parameter as its `[[parameter]]` has it."""
    return {
        "name": spec.name,
        "unit": spec.unit,
        "nominal": spec.nominal,
        "search": list(spec.search),
        "actuators": list(spec.actuators),
    }
