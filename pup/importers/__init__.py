"""Other people's logs, turned into recordings: one module per format."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from pup.errors import InputError
from pup.importers import bam, csv_format, darwin_hardware, emps, mcap_format, npz, sage
from pup.importers.common import ImportOptions
from pup.recording import Recording, write_recordings
from pup.recording_file import visible
from pup.robot import RobotDescription

__all__ = [
    "FORMATS",
    "ImportOptions",
    "import_recordings",
    "overlooked",
    "unknown_repeats",
    "write_imported",
]

Importer = Callable[[Path, ImportOptions], list[Recording]]

FORMATS: dict[str, Importer] = {
    "bam": bam.read,
    "csv": csv_format.read,
    "darwin-hardware": darwin_hardware.read,
    "emps": emps.read,
    "mcap": mcap_format.read,
    "npz": npz.read,
    "sage": sage.read,
}
PATTERNS = {
    "bam": "*.json",
    "csv": "*.csv",
    "darwin-hardware": "*.json",
    "emps": "*.mat",
    "mcap": "*.mcap",
    "npz": "*.npz",
    "sage": "**/control.csv",
}
"""What is taken from a folder."""


def import_recordings(
    format: str,
    paths: Sequence[Path],
    robot: RobotDescription | None = None,
    options: ImportOptions | None = None,
) -> tuple[Recording, ...]:
    """Read logs of one format.

    Args:
      format: a key of `FORMATS`.
      paths: log files, or folders that hold some.
      robot: when given, every recording must be of exactly its joints and takes its name.
      options: what the logs do not say.

    Returns:
      The recordings, sorted by id.

    Raises:
      InputError: a log cannot be read or breaks a rule; the message names the file.
    """
    if format not in FORMATS:
        raise InputError(f"format {format!r} is unknown; use one of {', '.join(sorted(FORMATS))}")
    options = options or ImportOptions()
    if robot is not None:
        options = replace(options, robot=robot.name)
    origin: dict[str, Path] = {}
    recordings = []
    for path in _logs(paths, PATTERNS[format]):
        try:
            found = FORMATS[format](path, options)
            if robot is not None:
                for recording in found:
                    recording.validate(robot)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        for recording in found:
            if recording.id in origin:
                if path.resolve() == origin[recording.id].resolve():
                    raise InputError(f"{path}: is given twice; name it once")
                raise InputError(
                    f"{path}: id {recording.id!r} is also that of {origin[recording.id]}; "
                    "rename one of the files"
                )
            origin[recording.id] = path
        recordings += found
    if any(recording.id == options.repeat_of for recording in recordings):
        raise InputError(
            f"--repeat-of {options.repeat_of}: is the recording itself; name the first"
        )
    if options.repeat_of is not None and len(recordings) > 1:
        raise InputError(
            f"--repeat-of is of one recording, and here are {len(recordings)}; import it alone"
        )
    return tuple(sorted(recordings, key=lambda recording: recording.id))


def write_imported(recordings: Sequence[Recording], folder: Path) -> tuple[Path, ...]:
    """Write recordings into a folder where others may stand, named by their ids: all or none.

    Logs of two motions may bear one name, and the second must not take the place of the first.

    Returns:
      The files, in the order of the recordings.

    Raises:
      InputError: a file of such a name is there and holds something else.
    """
    for recording in recordings:
        file = folder / f"{recording.id}.parquet"
        if file.exists() and not _holds(file, recording):
            raise InputError(
                f"{file}: is another recording; rename the log, use another folder, or remove it"
            )
    return write_recordings(recordings, folder)


def _holds(file: Path, recording: Recording) -> bool:
    try:
        return Recording.read(file).digest == recording.digest
    except InputError:  # whatever it is, it is not this recording
        return False


def unknown_repeats(recordings: Sequence[Recording], folder: Path) -> list[Recording]:
    """Those that repeat a recording which is neither among them nor in a folder."""
    known = {recording.id for recording in recordings}
    known |= {file.stem for file in folder.glob("*.parquet")}
    return [r for r in recordings if r.repeat_of is not None and r.repeat_of not in known]


def overlooked(format: str, paths: Sequence[Path]) -> list[Path]:
    """Folders in those that are given, which hold logs of a format and are not given themselves."""
    given = [path for path in paths if path.is_dir()]
    own = {path.resolve() for path in given}
    below = [inner for path in given for inner in _below(path, PATTERNS[format])]
    return [inner for inner in below if inner.resolve() not in own]


def _below(folder: Path, pattern: str) -> list[Path]:
    """Folders in a folder that hold logs which are not taken from it; sorted."""
    if pattern.startswith("**"):
        return []
    return list(dict.fromkeys(log.parent for log in visible(folder, f"*/{_any_case(pattern)}")))


def _inside(folder: Path, pattern: str) -> list[Path]:
    """Logs of a folder; ROS 2 calls the folder of a log as another program does the log."""
    return [log for log in visible(folder, _any_case(pattern)) if not log.is_dir()]


def _any_case(pattern: str) -> str:
    """The pattern for a kind of file in small and in capital letters, as some loggers write it."""
    kind = pattern.removeprefix("*.")
    if kind == pattern:
        return pattern
    return "*." + "".join(f"[{letter}{letter.upper()}]" for letter in kind)


def _logs(paths: Sequence[Path], pattern: str) -> list[Path]:
    logs: list[Path] = []
    for path in map(Path, paths):
        if not path.exists():
            raise InputError(f"{path}: no such file or folder")
        if not path.is_dir() and not path.is_file():  # a pipe or device, which may never end
            raise InputError(f"{path}: not a file")
        found = _inside(path, pattern) if path.is_dir() else [path]
        if not found:
            inside = [f", but in {folder}; name that" for folder in _below(path, pattern)]
            raise InputError(f"{path}: no {pattern} in this folder{''.join(inside[:1])}")
        logs += found
    if not logs:
        raise InputError("no log given; name files or folders")
    return logs
