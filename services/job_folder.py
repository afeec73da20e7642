"""A job's folder in shared storage: where the gateway and the job's process meet.

    <shared>/jobs/<job>/
      order.json              what to run, which attempt may, whether to stop; the gateway's
      claim-<attempt>         made by the process that runs an attempt: there is but one
      beat.json               counted up by that process while it lives
      log.txt                 what the verb said, in all attempts
      outcome-<attempt>.json  how an attempt ended
      out/                    the verb's own --out folder: the artefacts

The gateway needs no answer of Ray to know how a job ended or to have it stopped, and an attempt
that was given up is shut out: its process reads in order.json that another one has the folder.
"""

import os
from collections.abc import Iterator
from dataclasses import MISSING, asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

from pup.errors import InputError
from pup.files import read_json, sha256, write_json

T = TypeVar("T")

SCHEMA = 1
JOBS = "jobs"
ORDER = "order.json"
BEAT = "beat.json"
REVOKED = 75
"""Exit code of a process whose attempt is another's, or was called off before it began."""


@dataclass(frozen=True)
class Order:
    """What a job's process shall do.

    Attributes:
      job: id.
      attempt: that alone may run.
      stop: nobody may.
      fresh: what an earlier attempt left in `out` is in the way, not a checkpoint.
      command: what stands behind `pup`.
    """

    job: str
    attempt: int
    stop: bool
    fresh: bool
    command: list[str]


@dataclass(frozen=True)
class Outcome:
    """How an attempt ended.

    Attributes:
      attempt: number.
      exit: code of the verb; 128 and more where a signal ended it.
      told: last line of its log.
      artifacts: SHA-256 by name, of a verb that was done.
    """

    attempt: int
    exit: int
    told: str = ""
    artifacts: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Beat:
    """A sign of life.

    Attributes:
      attempt: that lives.
      count: of its signs so far.
    """

    attempt: int
    count: int


@dataclass(frozen=True)
class JobFolder:
    """A job's folder.

    Attributes:
      path: of it.
    """

    path: Path

    @property
    def shared(self) -> Path:
        """Root of the shared storage."""
        return self.path.parent.parent

    @property
    def out(self) -> Path:
        """Where the verb writes."""
        return self.path / "out"

    @property
    def log(self) -> Path:
        """What it says."""
        return self.path / "log.txt"

    def write_order(self, order: Order) -> None:
        """Tell the job's process what to do."""
        write_json(self.path / ORDER, {"schema": SCHEMA} | asdict(order))

    def order(self) -> Order:
        """What to do.

        Raises:
          InputError: the file is absent or no order.
        """
        return _read(self.path / ORDER, Order)

    def revoke(self) -> None:
        """Have what runs stop, and nothing begin.

        Raises:
          OSError: the storage is not there, or takes no files now.
        """
        try:
            order = self.order()
        except InputError as error:
            there = self.path.parent.is_dir() and not (self.path / ORDER).exists()
            if there:  # without an order nothing begins either
                return
            raise OSError(str(error)) from error
        if not order.stop:
            self.write_order(replace(order, stop=True))

    def claim(self, attempt: int) -> bool:
        """Take an attempt; False where another process has it."""
        try:
            (self.path / f"claim-{attempt}").touch(exist_ok=False)
        except FileExistsError:
            return False
        return True

    def claimed(self, attempt: int) -> bool:
        """Whether a process took the attempt."""
        return (self.path / f"claim-{attempt}").exists()

    def beat(self, attempt: int, count: int) -> None:
        """Give a sign of life."""
        write_json(self.path / BEAT, {"schema": SCHEMA} | asdict(Beat(attempt, count)))

    def heard(self) -> tuple[int, int] | None:
        """Attempt and count of the last sign of life."""
        try:
            beat = _read(self.path / BEAT, Beat)
        except InputError:
            return None
        return beat.attempt, beat.count

    def write_outcome(self, outcome: Outcome) -> None:
        """Keep how an attempt ended."""
        write_json(self._outcome(outcome.attempt), {"schema": SCHEMA} | asdict(outcome))

    def outcome(self, attempt: int) -> Outcome | None:
        """How an attempt ended; None while nothing is known."""
        try:
            return _read(self._outcome(attempt), Outcome)
        except InputError:
            return None

    def files(self) -> Iterator[tuple[str, Path]]:
        """Artefacts by name, sorted."""
        return below(self.out)

    def file(self, name: str) -> Path | None:
        """An artefact by its name; None for whatever is none."""
        return inside(self.out, name)

    def digests(self) -> dict[str, str]:
        """SHA-256 of the artefacts by name."""
        return {name: sha256(path) for name, path in self.files()}

    def last_line(self) -> str:
        """The last line of the log, cut to what fits into a message."""
        return (self.tail(2048).strip().splitlines() or [""])[-1][:500]

    def log_size(self) -> int:
        """Of the log, bytes."""
        return self.log.stat().st_size if self.log.exists() else 0

    def tail(self, size: int) -> str:
        """The last bytes of the log as text, from the beginning of a line on."""
        try:
            with open(self.log, "rb") as file:
                at = max(0, file.seek(0, os.SEEK_END) - size)
                file.seek(at)
                told = file.read(size).decode(errors="replace")
        except OSError:
            return ""
        return told.partition("\n")[2] if at and "\n" in told else told

    def _outcome(self, attempt: int) -> Path:
        return self.path / f"outcome-{attempt}.json"


def folder_of(shared: Path, job: str) -> JobFolder:
    """The folder of a job."""
    return JobFolder(shared / JOBS / job)


def below(folder: Path) -> Iterator[tuple[str, Path]]:
    """Files by name, sorted; links are none, nor are files being written or in locked folders."""
    for place, folders, files in os.walk(folder):
        folders.sort()
        for name in sorted(files):
            path = Path(place) / name
            # Unlike `Path.is_file`, this is False and no error in a folder that may not be entered.
            if not name.startswith(".") and os.path.isfile(path) and not path.is_symlink():
                yield path.relative_to(folder).as_posix(), path


def turn(name: str) -> tuple[tuple[bool, str], ...]:
    """What `below` sorts names by: the files of a folder come before those of folders in it."""
    *folders, file = name.split("/")
    return (*((True, folder) for folder in folders), (False, file))


def inside(folder: Path, name: str) -> Path | None:
    """A file of `below` by its name; None for whatever is none, such as a way out of the folder."""
    parts = name.split("/")
    if "\0" in name or "\\" in name or any(p in ("", ".", "..") for p in parts):
        return None
    path = folder.joinpath(*parts)
    try:
        within = path.resolve().is_relative_to(folder.resolve())
        there = within and path.is_file() and not path.is_symlink()
    except (OSError, RuntimeError):  # a name that is too long, a loop of links
        return None
    return path if there and not parts[-1].startswith(".") else None


def _read(path: Path, kind: type[T]) -> T:
    """The data class that a file holds; what a newer program added to it is left out.

    Raises:
      InputError: the file is absent or holds something else.
    """
    told, known = read_json(path), {}
    if not isinstance(told, dict) or told.get("schema") != SCHEMA:
        raise InputError(f"{path}: not of schema {SCHEMA}")
    for f in fields(kind):  # type: ignore[arg-type]  # no type says that it is a data class
        if f.name in told:
            if not _is(f.type, told[f.name]):
                raise InputError(f"{path}: {f.name} is of another type")
            known[f.name] = told[f.name]
        elif f.default is MISSING and f.default_factory is MISSING:
            raise InputError(f"{path}: {f.name} is missing")
    return kind(**known)


def _is(kind: Any, value: Any) -> bool:
    """Whether a JSON value is of a type, such as `dict[str, str]`; True is no whole number."""
    if type(value) is not (get_origin(kind) or kind):
        return False
    entries = value.values() if isinstance(value, dict) else value if get_args(kind) else ()
    return all(_is(get_args(kind)[-1], entry) for entry in entries)
