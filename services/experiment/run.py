"""Cells, done once each: in waves of those that need nothing more, several at once.

Every cell has a folder of its own with a journal, so that no two write to one file, and whatever
was interrupted goes on where it was.
"""

import hashlib
import json
import platform
import shutil
import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pup.errors import InputError
from pup.files import read_json, sha256, write_json
from services.experiment.cells import Cell, chosen
from services.experiment.work import KINDS, LEFT, RESULT, Task
from services.failures import ERROR, SHOWN, caught, lost, mended, named
from services.places import Each
from services.progress import Told
from services.provenance import engine, now
from services.stages import Journal, Stage

CELLS, AGAIN = "cells", "again"
FILES = "files"
"""Folder of a cell's files, within its own."""
MADE = "made.json"


@dataclass(frozen=True)
class Order:
    """A cell to be done.

    Attributes:
      cell: which.
      out: folder of the experiment.
      place: name of the folder in it for this cell, of CELLS or AGAIN.
    """

    cell: Cell
    out: Path
    place: str = CELLS

    @property
    def folder(self) -> Path:
        """Of the cell."""
        return self.out / self.place / self.cell.name

    @property
    def files(self) -> Path:
        """Folder of what it leaves."""
        return self.folder / FILES

    def stage(self) -> Stage:
        """The cell as the journal has it; what it needs must be done."""
        told = json.dumps(self.cell.told, sort_keys=True)
        inputs = {"kind": self.cell.kind, "told": told}
        inputs |= {part: sha256(f / RESULT) for part, f in self._needed().items()}
        left = (RESULT, *LEFT.get(self.cell.kind, ()))
        files = tuple(f"{FILES}/{name}" for name in left)
        return Stage(self.cell.name, inputs, files, self._work, folder=FILES, remade=True)

    @property
    def done(self) -> bool:
        """Whether it is done, from what those that it needs have found since."""
        if not all((f / RESULT).is_file() for f in self._needed().values()):
            return False
        return (self.folder / "run.json").is_file() and Journal(self.folder).kept(self.stage())

    def result(self) -> dict[str, Any]:
        """What it found."""
        return dict(read_json(self.files / RESULT)["result"])

    def made(self) -> dict[str, Any]:
        """When and by what it was done."""
        return dict(read_json(self.folder / MADE))

    def seconds(self) -> float:
        """That it took, since it was last interrupted."""
        return Journal(self.folder).done(self.cell.name).seconds

    def _needed(self) -> dict[str, Path]:
        needs = self.cell.needs.items()
        return {part: self.out / CELLS / name / FILES for part, name in needs}

    def _work(self) -> None:
        self.files.mkdir(parents=True, exist_ok=True)
        found = KINDS[self.cell.kind](Task(self.cell, self.files, self._needed()))
        write_json(self.folder / MADE, {"by": engine(), "host": platform.node(), "ended": now()})
        write_json(self.files / RESULT, {"schema": 1, "cell": self.cell.name, "result": found})


@dataclass(frozen=True)
class Outcome:
    """What became of a cell: how long it took, s, or what went wrong."""

    seconds: float = 0.0
    error: str = ""


def run_cells(
    cells: Mapping[str, Cell], out: Path, each: Each, lanes: int, tell: Told
) -> dict[str, str]:
    """Do the cells that are not done, and those that need them after them.

    Args:
      cells: each after those that it needs.
      out: folder of the experiment.
      each: does several at once.
      lanes: how many.
      tell: told how many are done.

    Returns:
      The cells that failed, or could not be done as others had failed, and why.
    """
    left, failed, share = dict(cells), dict[str, str](), 0.0
    whole = sum(cell.weight for cell in cells.values())
    while left:
        ready = [c for c in left.values() if not any(n in left for n in c.needs.values())]
        for cell in ready:
            del left[cell.name]
        orders = [Order(cell, out.absolute()) for cell in ready if not _blocked(cell, failed)]
        kept = {order.cell.name: order.done for order in orders}
        todo = [order for order in orders if not kept[order.cell.name]]
        todo.sort(key=lambda order: -order.cell.weight)
        whole -= sum(order.cell.weight for order in orders if kept[order.cell.name])
        done = len(cells) - len(left) - len(failed) - len(todo)
        tell(done, len(cells))
        with closing(each(work_on, todo)) as outcomes:
            for i, outcome in outcomes:
                order, told = todo[i], _settled(todo[i], outcome)
                share += order.cell.weight / max(whole, order.cell.weight)
                done += not told.error
                if told.error:
                    failed[order.cell.name] = told.error
                note = f"failed, {told.error}" if told.error else f"in {told.seconds:.0f} s"
                tell(done, len(cells), f"{order.cell.name} {note}", share)
    return failed


def _blocked(cell: Cell, failed: dict[str, str]) -> bool:
    """Whether something that a cell needs has failed; it then has failed too."""
    missing = [name for name in cell.needs.values() if name in failed]
    if missing:
        failed[cell.name] = f"needs {missing[0]}"
    return bool(missing)


def work_on(order: Order) -> Outcome:
    """Do a cell; what goes wrong is written down instead of raised."""
    begin = time.monotonic()
    try:
        order.folder.mkdir(parents=True, exist_ok=True)
        Journal(order.folder).once(order.stage())
    except Exception as error:  # whatever it is, other cells go on
        return Outcome(error=caught(order.folder, error))
    mended(order.folder)
    return Outcome(time.monotonic() - begin)


def complaint(failed: Mapping[str, str], out: Path) -> str:
    """Which cells failed, in a line."""
    own = {name: why for name, why in failed.items() if not why.startswith("needs ")}
    return (
        f"{out}: {len(own)} cells failed and {len(failed) - len(own)} need them, see "
        f"{CELLS}/*/{ERROR}; the same command tries them again: {named(own)}"
    )


def run_again(
    cells: Mapping[str, Cell], name: str, out: Path, each: Each, lanes: int, tell: Told
) -> dict[str, Any]:
    """Do one cell anew, beside what it left before, and compare.

    Cells that it needs are done first where they are not. One that was never done is done twice,
    so that there is something to compare.

    Args:
      cells: of the experiment.
      name: of the cell.
      out: folder of the experiment.
      each: does several at once.
      lanes: how many.
      tell: told how many are done.

    Returns:
      Whether both `agree`, the digests of what they found, and their folders.

    Raises:
      InputError: there is no such cell, or it fails.
    """
    if name not in cells:
        raise InputError(f"--cell {name}: there is none; {', '.join(list(cells)[:SHOWN])}, ...")
    needed = chosen(cells, [name])
    failed = run_cells(needed, out, each, lanes, tell)
    if failed:
        raise InputError(complaint(failed, out))
    first = Order(cells[name], out.absolute())
    second = Order(cells[name], out.absolute(), AGAIN)
    if second.done:
        shutil.rmtree(second.folder)
    with closing(each(work_on, [second])) as outcomes:
        told = next(_settled(second, outcome) for _, outcome in outcomes)
    if told.error:
        raise InputError(f"{second.folder}: {told.error}")
    found = {str(o.folder): digest(o.result()) for o in (first, second)}
    return {"cell": name, "agree": len(set(found.values())) == 1, "results": found}


def digest(result: Mapping[str, Any]) -> str:
    """SHA-256 of what a cell found."""
    return hashlib.sha256(json.dumps(result, sort_keys=True).encode()).hexdigest()


def _settled(order: Order, outcome: Any) -> Outcome:
    """An outcome; a cell whose process was lost has none, and gets its error file here."""
    if isinstance(outcome, Outcome):
        return outcome
    return Outcome(error=lost(order.folder, outcome))
