"""The meshes and textures of a model that a robot is drafted from: found, and taken along."""

import shutil
from pathlib import Path
from urllib.parse import unquote

import mujoco

from pup.errors import InputError

HOLDERS = 4
"""Folders above a model in which its files are looked for."""
UNREAD = (".dae",)
"""Kinds of meshes that MuJoCo does not read."""


def find_files(spec: mujoco.MjSpec, source: Path, notes: list[str]) -> None:
    """Give every mesh, texture and height field the whole path of its file.

    A URDF names them by package, from some folder above it, which MuJoCo leaves out.

    Raises:
      InputError: a file is not there, or a mesh that tells a link's mass cannot be read.
    """
    _leave_out_unread(spec, source, notes)
    compiler, stripped = spec.compiler, spec.strippath
    for assets, folder in (
        (spec.meshes, compiler.meshdir),
        (spec.textures, compiler.texturedir),
        (spec.hfields, compiler.meshdir),
    ):
        for asset in assets:
            if asset.file:
                found = _found(source.absolute().parent, folder, asset.file, stripped)
                if found is None:
                    raise InputError(
                        f"{source}: {asset.file!r} is not there; put it beside the model, or leave "
                        "the geoms that use it out"
                    )
                asset.file = str(found)
    compiler.meshdir = compiler.texturedir = ""
    spec.strippath = False


def take_along(spec: mujoco.MjSpec, folder: Path) -> bool:
    """Copy the files of a model into a folder; whether there are any."""
    taken: dict[str, str] = {}
    for assets in (spec.meshes, spec.textures, spec.hfields):
        for asset in assets:
            if asset.file:
                asset.file = _copied(Path(asset.file), folder, taken)
    return bool(taken)


def _found(base: Path, folder: str, file: str, stripped: bool) -> Path | None:
    """A file where MuJoCo would look, or by as much of its path as some folder above has."""
    parts = Path(unquote(file.split("://")[-1])).parts
    own = [base / folder / (parts[-1] if stripped else file), base / file]
    holders = base / folder, base, *base.parents[:HOLDERS]
    above = [h.joinpath(*parts[i:]) for h in holders for i in range(len(parts))]
    return next((place for place in (*own, *above) if place.is_file()), None)


def _leave_out_unread(spec: mujoco.MjSpec, source: Path, notes: list[str]) -> None:
    """Delete meshes that MuJoCo does not read, and their geoms, where the robot keeps its mass."""
    unread = {m.name: m for m in spec.meshes if Path(m.file).suffix.lower() in UNREAD}
    geoms = [geom for geom in spec.geoms if geom.meshname in unread]
    for geom in geoms:
        if _weighs(spec, geom):
            raise InputError(
                f"{source}: MuJoCo does not read {unread[geom.meshname].file!r}, which tells the "
                f"mass of {geom.parent.name!r}; convert it to STL or OBJ, or give the link its "
                "inertial"
            )
    bare = dict.fromkeys(g.parent.name for g in geoms if g.contype or g.conaffinity)
    for part in (*geoms, *unread.values()):
        spec.delete(part)
    if unread:
        notes.append(f"meshes that MuJoCo does not read are left out: {', '.join(unread)}")
    if bare:
        notes.append(f"with them went shapes that touch: give others to {', '.join(bare)}")


def _weighs(spec: mujoco.MjSpec, geom: mujoco.MjsGeom) -> bool:
    """Whether a link's mass would be another without the geom."""
    body = geom.parent
    told = body.explicitinertial and spec.compiler.inertiafromgeom != 1
    return not (told or body.name == "world" or geom.mass == 0 or geom.density == 0)


def _copied(file: Path, folder: Path, taken: dict[str, str]) -> str:
    """The name in a folder of a file that is copied there, once; several may be called alike."""
    if str(file) not in taken:
        name, number = file.name, 1
        while name in taken.values():
            name, number = f"{file.stem}_{number}{file.suffix}", number + 1
        folder.mkdir(exist_ok=True)
        shutil.copyfile(file, folder / name)
        taken[str(file)] = name
    return taken[str(file)]
