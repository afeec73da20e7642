"""Cells of experiments whose work is play, for tests of when and how often they are done."""

from pathlib import Path
from typing import Any

import pytest

from pup.errors import InputError
from pup.files import write_json
from services import places
from services.experiment import work
from services.experiment.cells import Cell
from services.experiment.run import Outcome, run_cells


def told(*_: Any) -> None:
    """Nobody listens."""


class Workshop:
    """Kinds of cells that write down how often they are done, and stop or fail when told to."""

    def __init__(self) -> None:
        self.done: list[str] = []
        self.stops: set[str] = set()
        self.fails: set[str] = set()
        self.breaks: set[str] = set()
        self.chance: float = 0.0

    def work(self, task: work.Task) -> dict[str, Any]:
        name = task.cell.name
        (task.out / "half").touch()
        if name in self.stops:
            raise KeyboardInterrupt
        if name in self.fails:
            raise InputError("it cannot be done")
        if name in self.breaks:
            raise RuntimeError("the disk is full")
        self.done.append(name)
        for left in work.LEFT.get(task.cell.kind, ()):
            write_json(task.out / left, {})
        return {"of": name, "chance": self.chance}


def opened(monkeypatch: pytest.MonkeyPatch) -> Workshop:
    """A workshop that does all cells."""
    shop = Workshop()
    monkeypatch.setattr("services.experiment.run.KINDS", dict.fromkeys(work.KINDS, shop.work))
    return shop


def do(cells: dict[str, Cell], out: Path, redo: bool = False) -> dict[str, Outcome]:
    return run_cells(cells, out, places.OneByOne, told, redo)
