"""Recordings, with or without their replays, as files of other programs: a module per format."""

import os
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pup.errors import InputError, how_to_install
from pup.exporters.common import Take
from pup.recording import check_distinct
from pup.robot import RobotDescription

__all__ = ["FORMATS", "Take", "export_takes"]

FORMATS = ("lerobot", "mcap", "rrd")


def require(format: str, rate: int | None = None) -> None:
    """Refuse a format that is unknown or whose library is not installed.

    Raises:
      InputError: it is, or a rate is given to a format that keeps the recording's own times.
    """
    if format not in FORMATS:
        raise InputError(f"format {format!r} is unknown; use one of {', '.join(FORMATS)}")
    if format == "rrd" and find_spec("rerun") is None:
        raise InputError(f"rrd files need rerun-sdk; {how_to_install('export')}")
    if format != "lerobot" and rate is not None:
        raise InputError(f"--fps: {format} keeps the times of a recording; only lerobot needs it")


def export_takes(
    format: str,
    takes: Sequence[Take],
    folder: Path,
    robot: RobotDescription | None = None,
    rate: int | None = None,
) -> dict[str, Any]:
    """Write recordings in another format: all of them or, on an error, none.

    Args:
      format: one of `FORMATS`.
      takes: the recordings.
      folder: made when absent; gets a file per recording, or a whole data set.
      robot: that they are of, to be drawn in `rrd`.
      rate: frames per second of `lerobot`; None for what the recordings have.

    Returns:
      `files`, and what else the format tells.

    Raises:
      InputError: the format cannot hold these recordings, two of them have one id, or the folder
        is not free for them.
    """
    require(format, rate)
    check_distinct(take.recording for take in takes)
    _check_name(format, folder)
    folder.mkdir(parents=True, exist_ok=True)
    if format == "lerobot":
        return _data_set(takes, folder, rate)
    files = [folder / f"{take.recording.id}.{format}" for take in takes]
    if format == "mcap":
        _keep_others(files)
    with TemporaryDirectory(dir=folder, prefix=".new-") as new:
        for take, file in zip(takes, files, strict=True):
            if format == "rrd":
                from pup.exporters import rerun_format

                rerun_format.write(take, Path(new) / file.name, robot)
            else:
                from pup.exporters import mcap_format

                mcap_format.write(take, Path(new) / file.name)
        for file in files:
            os.replace(Path(new) / file.name, file)
    return {"files": [str(file) for file in files]}


def _check_name(format: str, folder: Path) -> None:
    """Refuse a name that pyarrow and Rerun cannot write under."""
    try:
        str(folder).encode()
    except UnicodeEncodeError as error:
        if format != "mcap":
            raise InputError(f"{folder}: its name is not UTF-8; use another folder") from error


def _keep_others(files: Sequence[Path]) -> None:
    """Refuse to write over logs that are not ours, such as those that the recordings come from."""
    from pup.exporters import mcap_format

    for file in files:
        if file.exists() and not mcap_format.is_own(file):
            raise InputError(f"{file}: is not of `pup export`; use another folder")


def _data_set(takes: Sequence[Take], folder: Path, rate: int | None) -> dict[str, Any]:
    """A LeRobot data set; readers take a folder for one by its `meta`, which comes last."""
    from pup.exporters import lerobot

    for part in ("data", "meta"):
        if (folder / part).exists():
            raise InputError(f"{folder}: holds {part}/ already; use an empty folder")
    with TemporaryDirectory(dir=folder, prefix=".new-") as new:
        told = lerobot.write(takes, Path(new), rate)
        for part in ("data", "meta"):
            os.replace(Path(new) / part, folder / part)
    return {"files": [str(folder)], **told}
