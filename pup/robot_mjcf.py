"""The names in an MJCF file, read without a simulator and without trusting the file."""

import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pup.errors import InputError
from pup.robot_toml import read_text

MJCF_LIMIT = 16 * 2**20  # bytes, each file
FOLDER_KEYS = ("assetdir", "meshdir", "texturedir")


@dataclass(frozen=True)
class MjcfNames:
    """What an MJCF model calls its parts.

    Attributes:
      joints: hinge and slide joints, in file order.
      bodies: named bodies.
      geoms: named geoms.
      sites: named sites.
      floating: the body that carries the free joint; None for a fixed base.
      texts: the XML files read, the model first, then its includes.
      files: the includes and assets that are there, relative to the model's folder.
      assets: those of them that are no includes: meshes, textures and the like.
    """

    joints: tuple[str, ...]
    bodies: frozenset[str]
    geoms: frozenset[str]
    sites: frozenset[str]
    floating: str | None
    texts: tuple[str, ...]
    files: frozenset[Path]
    assets: frozenset[Path]


def read_mjcf(path: Path) -> MjcfNames:
    """Read the names of an MJCF model and of the files it includes.

    Raises:
      InputError: not XML, too large, a document type, a file outside the model's folder, a model
        that is attached, a joint without a name, of a kind other than hinge or slide, or a second
        free joint.
    """
    texts: list[str] = []
    root = _parse(path, texts)
    includes = _splice_includes(root, path, texts)
    assets = frozenset(_assets(root, path)) - includes
    joints: list[str] = []
    floating: list[str] = []
    names: dict[str, set[str]] = {"body": set(), "geom": set(), "site": set()}
    for element, body in _world(root):
        name = element.get("name", "")
        if element.tag in names and name:
            names[element.tag].add(name)
        elif element.tag == "freejoint" or (element.tag == "joint" and _type(element) == "free"):
            floating.append(body)
        elif element.tag == "joint":
            if not name:
                raise InputError(f"{path}: a joint of body {body!r} has no name; name every joint")
            joints.append(name)
    for element in root.iter("joint"):
        if _type(element) not in ("hinge", "slide", "free"):
            raise InputError(
                f"{path}: joint {element.get('name')!r} is of type {_type(element)!r}; "
                "only hinge and slide joints can be driven"
            )
    if len(floating) > 1:
        raise InputError(f"{path}: more than one free joint ({', '.join(floating)}); keep one")
    return MjcfNames(
        joints=tuple(joints),
        bodies=frozenset(names["body"]),
        geoms=frozenset(names["geom"]),
        sites=frozenset(names["site"]),
        floating=floating[0] if floating else None,
        texts=tuple(texts),
        files=assets | includes,
        assets=assets,
    )


def check_path(path: Path) -> None:
    """Refuse a path that MuJoCo cannot be told."""
    try:
        str(path.absolute()).encode()
    except UnicodeEncodeError as error:
        raise InputError(
            f"{path}: its name, or that of a folder above, is not UTF-8; rename it"
        ) from error


def absent(kind: str, name: str) -> str:
    """What to say of a name the model does not have."""
    return f"model.xml has no {kind} {name!r}; correct the name or add it there"


def _type(joint: ElementTree.Element) -> str:
    return joint.get("type", "hinge")


def _parse(path: Path, texts: list[str]) -> ElementTree.Element:
    text = read_text(path, MJCF_LIMIT)
    # An MJCF needs no document type, and entities are how an XML file of a few bytes grows to
    # gigabytes. The text is parsed decoded, so that no declared encoding can hide one.
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(f"{path}: document types and entities are not accepted; remove <!DOCTYPE>")
    texts.append(text)
    try:
        return ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(f"{path}: not an XML document ({error})") from error


def _inside(model: Path, file: str) -> Path:
    """A file named in a model, relative to the model's folder, in which it must lie."""
    folder = model.parent.resolve()
    place = Path(os.path.normpath(folder / file))
    if not (place.is_relative_to(folder) and (folder / file).resolve().is_relative_to(folder)):
        raise InputError(f"{model}: file {file!r} lies outside the robot's folder; copy it there")
    return place.relative_to(folder)


def _splice_includes(root: ElementTree.Element, model: Path, texts: list[str]) -> set[Path]:
    """Replace every <include> by the children of the file it names, as MuJoCo does."""
    seen = {Path(model.name)}
    waiting = [root]
    while waiting:
        element = waiting.pop()
        position = 0
        while position < len(element):
            child = element[position]
            if child.tag != "include":
                waiting.append(child)
                position += 1
                continue
            file = _inside(model, child.get("file", ""))
            if file in seen:
                raise InputError(f"{model}: includes {file.name!r} twice; include each file once")
            seen.add(file)
            element[position : position + 1] = list(_parse(model.parent / file, texts))
    return seen - {Path(model.name)}


def _assets(root: ElementTree.Element, model: Path) -> Iterator[Path]:
    """Meshes, textures and other files that are there; none may lie outside the model's folder."""
    folders = {key: "" for key in FOLDER_KEYS}
    for compiler in root.iter("compiler"):
        folders.update({key: compiler.get(key, folders[key]) for key in FOLDER_KEYS})
    for element in root.iter():
        if element.tag == "model":  # of an <attach>; its own files could lie anywhere
            raise InputError(
                f"{model}: attaches {element.get('file')!r}, which is not read; `pup describe` "
                "writes both as one file"
            )
        for attribute, file in element.items():
            if attribute.startswith("file"):
                for folder in ("", *folders.values()):
                    named = _inside(model, f"{folder}/{file}" if folder else file)
                    if (model.parent / named).is_file():
                        yield named


def _world(root: ElementTree.Element) -> Iterator[tuple[ElementTree.Element, str]]:
    """Every element below the world, in file order, with the name of the body it belongs to."""
    waiting = [(child, "world") for world in root.findall("worldbody") for child in world]
    waiting.reverse()
    while waiting:
        element, body = waiting.pop()
        yield element, body
        inner = element.get("name", "") if element.tag == "body" else body
        waiting.extend((child, inner) for child in reversed(element))
