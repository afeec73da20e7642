"""Stages of a job, each done once: `run.json` tells from what, and what came of it."""

import shutil
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pup.errors import InputError
from pup.files import read_json, sha256, write_json

JOURNAL = "run.json"


@dataclass(frozen=True)
class Stage:
    """A step of a job.

    Attributes:
      name: of the step.
      inputs: all that its result depends on by what it is, such as a file; told by its SHA-256 or
        as it is written.
      files: what it leaves behind, relative to the job's folder.
      work: does it; goes on where it was interrupted.
      folder: that belongs to it alone, and is emptied before it is done with other inputs; empty
        for a step that sees to that itself.
      remade: whether it is also emptied where one of its files was changed.
      pictures: and reports that it may leave besides; without them it is done all the same.
      draw: makes pictures again where some are gone; None leaves it at that.
    """

    name: str
    inputs: Mapping[str, str]
    files: tuple[str, ...]
    work: Callable[[], object]
    folder: str = ""
    remade: bool = False
    pictures: tuple[str, ...] = ()
    draw: Callable[[], object] | None = None


@dataclass(frozen=True)
class Done:
    """What the journal tells of a step.

    Attributes:
      inputs: see Stage.
      seconds: that it took, since it was last interrupted.
      files: SHA-256 of those of its files and pictures that there are.
    """

    inputs: Mapping[str, str]
    seconds: float
    files: Mapping[str, str]


class Journal:
    """The steps of a job that are done; several may be at work at once.

    Args:
      out: folder of the job.

    Raises:
      InputError: there is another file in the journal's place.
    """

    def __init__(self, out: Path) -> None:
        self.out, self.file = out, out / JOURNAL
        told = read_json(self.file) if self.file.exists() else {"schema": 1, "stages": {}}
        self._told = {"begun": {}} | told if isinstance(told, dict) else {}
        if not all(isinstance(self._told.get(part), dict) for part in ("stages", "begun")):
            raise InputError(f"{self.file}: not the journal of a job; use another --out")
        self._writing = threading.Lock()

    def once(self, stage: Stage) -> None:
        """Do a step, unless it is done from the same inputs and its files are as it left them."""
        if self.kept(stage):
            drawn = self._left(stage, stage.pictures)
            if stage.draw is not None and self._files(drawn).keys() != drawn.keys():
                stage.draw()
            return
        inputs = dict(stage.inputs)
        same = self._entry(stage).get("inputs") == inputs
        if stage.folder:
            if self._told["begun"].get(stage.name, inputs) != inputs or (same and stage.remade):
                # Begun from nothing until it is empty: who is stopped in between empties it again.
                self._write("begun", stage, None)
                shutil.rmtree(self.out / stage.folder, ignore_errors=True)
            self._write("begun", stage, inputs)
        begin = time.time()
        stage.work()
        seconds = round(time.time() - begin, 1)
        files = self._files((*stage.files, *stage.pictures))
        done = {"inputs": inputs, "seconds": seconds, "files": files}
        self._write("stages", stage, done)

    def _write(self, part: str, stage: Stage, told: dict[str, Any] | None) -> None:
        with self._writing:
            if part == "begun":  # and so no longer done: what it leaves now is to be gone on from
                self._told["stages"].pop(stage.name, None)
            self._told[part][stage.name] = told
            write_json(self.file, self._told)

    def kept(self, stage: Stage) -> bool:
        """Whether a step is done from the same inputs and its files are as it left them."""
        same = self._entry(stage).get("inputs") == dict(stage.inputs)
        return same and self._left(stage, stage.files) == self._files(stage.files)

    def _entry(self, stage: Stage) -> dict[str, Any]:
        """What is told of a step; nothing where that was changed to something else."""
        entry = self._told["stages"].get(stage.name)
        if not isinstance(entry, dict) or not isinstance(entry.get("seconds"), int | float):
            return {}
        tables = (entry.get(name) for name in ("inputs", "files"))
        return entry if all(isinstance(table, dict) for table in tables) else {}

    def _left(self, stage: Stage, names: Sequence[str]) -> dict[str, str]:
        """SHA-256 of those of these files that the step left."""
        left = self._entry(stage).get("files", {})
        return {name: digest for name, digest in left.items() if name in names}

    def inputs(self, name: str) -> dict[str, str]:
        """What a step was done from; nothing where it is not done."""
        entry = self._told["stages"].get(name)
        return dict(entry.get("inputs", {})) if isinstance(entry, dict) else {}

    def done(self, name: str) -> Done:
        """What is told of a step that is done."""
        return Done(**self._told["stages"][name])

    def _files(self, names: Iterable[str]) -> dict[str, str]:
        """SHA-256 of those files that there are."""
        there = [name for name in names if (self.out / name).is_file()]
        return {name: sha256(self.out / name) for name in there}


def content(out: Path, name: str) -> dict[str, Any]:
    """The JSON document that a step left."""
    return dict(read_json(out / name))
