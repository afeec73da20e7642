"""What a job may run: a verb of the command line, parsed as there, with paths in shared storage."""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NoReturn, get_args

from pup.errors import InputError
from pup.robot import built_in_robots
from services.arguments import parser

Verb = Literal[
    "import", "export", "record", "presysid", "train", "replay", "diagnose", "run", "experiment"
]
"""Verbs that can be jobs: those that read and write files and end by themselves."""
VERBS: tuple[Verb, ...] = get_args(Verb)
RESUMABLE = ("presysid", "train", "diagnose", "run", "experiment")
"""Those that go on from what they find in their folder; others begin anew."""
REFUSED = {
    "out": "a job has a folder of its own",
    "address": "a job runs on the service's cluster",
    "truth": "a job writes to its own folder alone",
    "json": "it is the submitter's option: give it before the verb",
}
"""Options that are not a job's to choose, and why."""
COUNT, LENGTH = 256, 1024
"""Most arguments of a job, and characters of each."""


class _Parser(argparse.ArgumentParser):
    """A parser that raises instead of ending the process."""

    def error(self, message: str) -> NoReturn:
        raise InputError(message)

    def exit(self, status: int = 0, message: str | None = None) -> NoReturn:
        raise InputError("--help and --version are no job")

    def print_help(self, file: Any = None) -> None:
        """Print nothing."""


def command(
    verb: str, arguments: Sequence[str], out: Path, cpus: float = 1.0, shared: Path | None = None
) -> list[str]:
    """What to put behind `pup` for a job.

    Args:
      verb: one of VERBS.
      arguments: what a user would write behind it; paths are relative to the shared storage.
      out: folder that the job writes to.
      cpus: cores that are reserved for its process.
      shared: root of the shared storage; None leaves its paths unchecked.

    Raises:
      InputError: the verb would refuse them, or they lead out of the shared storage.
    """
    if verb not in VERBS:
        raise InputError(f"{verb[:40]!r} cannot be a job; there are {', '.join(VERBS)}")
    if len(arguments) > COUNT or any(len(a) > LENGTH for a in arguments):
        raise InputError(f"more than {COUNT} arguments, or one of more than {LENGTH} characters")
    if any(a == "--" or not a.isprintable() for a in arguments):
        raise InputError("an argument is '--' or has characters that cannot be printed")
    options = _parsed([verb, *arguments], verb, out)
    if shared is not None:
        for path in paths(options):
            _check(path, shared)
    told = [verb, *arguments, "--out", str(out)]
    if "address" in options and not getattr(options, "local", False):
        told += ["--address", "auto"]
    if "cores" in options and options.cores is None and not getattr(options, "runners", 0):
        told += ["--cores", str(max(1, int(cpus)))]
    _parsed(told, verb)
    return told


def tasks(told: Sequence[str]) -> int:
    """Cores that a command asks of Ray at least, beside those of its process.

    Args:
      told: as `command` gives it.
    """
    options = parser(_Parser).parse_args(list(told))
    if not getattr(options, "address", None):
        return 0
    runners = getattr(options, "runners", 0)
    least = 0 if options.name == "train" else 1
    return max(least, runners and max(runners, options.cores or 0))


def paths(options: argparse.Namespace) -> Iterator[Path]:
    """Files and folders that parsed arguments name."""
    for name, value in vars(options).items():
        if name == "out":
            continue
        for one in value if isinstance(value, list | tuple) else (value,):
            if isinstance(one, Path):
                yield one
    robot = getattr(options, "robot", None)
    if robot is not None and robot not in built_in_robots():
        yield Path(robot)


def _parsed(told: list[str], verb: str, out: Path | None = None) -> argparse.Namespace:
    """Parse, with an --out that a user's own one would win over."""
    whole = [told[0], "--out", str(out), *told[1:]] if out is not None else told
    options = parser(_Parser).parse_args(whole)
    if options.name != verb:
        raise InputError(f"{options.name} is not {verb}")
    given = {k: v for k, v in vars(options).items() if v not in (None, False)}
    if out is not None and given.get("out") == out:
        del given["out"]
    for name, why in REFUSED.items():
        if out is not None and name in given:
            raise InputError(f"--{name}: {why}")
    return options


def _check(path: Path, shared: Path) -> None:
    root = shared.resolve()
    try:
        place = (root / path).resolve()
    except (OSError, RuntimeError) as error:
        raise InputError(f"{path}: cannot be followed") from error
    if not place.is_relative_to(root):
        raise InputError(f"{path}: is not in the shared storage; give paths below its root")
    if not place.exists():
        raise InputError(f"{path}: is not in the shared storage")
