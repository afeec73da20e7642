"""Cells, done once each: several at once, each as soon as what it needs is there.

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
from services.experiment.inputs import different
from services.experiment.work import KINDS, LEFT, RESULT, Task
from services.failures import ERROR, SHOWN, caught, lost, mended, named
from services.held import LEASE, held
from services.places import Pools
from services.progress import Told
from services.provenance import ALSO, engine, now
from services.stages import JOURNAL, Journal, Stage

CELLS, AGAIN = "cells", "again"
NEEDS = "needs "
"""How what is told of a cell begins that could not be done as another had failed."""
FILES = "files"
"""Folder of a cell's files, within its own."""
MADE = "made.json"
UNKNOWN = "unknown"
"""When, where or by what a cell was done whose file of that is gone."""


@dataclass(frozen=True)
class Order:
    """A cell to be done.

    Attributes:
      cell: which.
      out: folder of the experiment.
      place: name of the folder in it for this cell, of CELLS or AGAIN.
      redo: whether what it found from other inputs may be deleted.
    """

    cell: Cell
    out: Path
    place: str = CELLS
    redo: bool = False

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
        inputs = self._inputs(self._needed())
        left = (RESULT, *LEFT.get(self.cell.kind, ()))
        files = tuple(f"{FILES}/{name}" for name in left)
        return Stage(self.cell.name, inputs, files, self._work, folder=FILES, remade=True)

    def _inputs(self, needed: Mapping[str, Path]) -> dict[str, str]:
        told = json.dumps(self.cell.told, sort_keys=True)
        found = {part: sha256(f / RESULT) for part, f in needed.items()}
        return {"kind": self.cell.kind, "told": told} | found

    @property
    def done(self) -> bool:
        """Whether it is done, from what those that it needs have found since."""
        if not all((f / RESULT).is_file() for f in self._needed().values()):
            return False
        return (self.folder / JOURNAL).is_file() and self._journal().kept(self.stage())

    @property
    def changed(self) -> tuple[str, ...]:
        """What is other than when it was done, as far as that is known; none where it is not."""
        if not ((self.folder / JOURNAL).is_file() and (self.files / RESULT).is_file()):
            return ()
        there = {part: f for part, f in self._needed().items() if (f / RESULT).is_file()}
        before = self._journal().inputs(self.cell.name)
        return different(before, self._inputs(there), self.cell.needs)

    def result(self) -> dict[str, Any]:
        """What it found."""
        return dict(read_json(self.files / RESULT)["result"])

    def made(self) -> dict[str, Any]:
        """When, where and by what it was done, as far as that is known."""
        try:
            told = read_json(self.folder / MADE)
            by = {"source_sha256": told["by"]["source_sha256"]}
            return {"by": by, "host": told["host"], "ended": told["ended"]}
        except (InputError, LookupError, TypeError):  # a result is one without it too
            return {"by": {"source_sha256": UNKNOWN}, "host": UNKNOWN, "ended": UNKNOWN}

    def seconds(self) -> float:
        """That it took, since it was last interrupted."""
        return self._journal().done(self.cell.name).seconds

    def _journal(self) -> Journal:
        """What the cell's folder tells of it.

        Raises:
          InputError: that is damaged. Nothing else says what its files were made from.
        """
        try:
            return Journal(self.folder)
        except InputError as error:
            raise InputError(
                f"{error}; with its folder {self.folder} deleted, this cell is done anew"
            ) from error

    def _needed(self) -> dict[str, Path]:
        needs = self.cell.needs.items()
        return {part: self.out / CELLS / name / FILES for part, name in needs}

    def _work(self) -> None:
        self.files.mkdir(parents=True, exist_ok=True)
        found = KINDS[self.cell.kind](Task(self.cell, self.files, self._needed()))
        made = {"by": engine(ALSO), "host": platform.node(), "ended": now()}
        write_json(self.folder / MADE, made)
        write_json(self.files / RESULT, {"schema": 1, "cell": self.cell.name, "result": found})


@dataclass(frozen=True)
class Outcome:
    """What became of a cell.

    Attributes:
      seconds: that it took.
      error: what went wrong; empty where nothing did.
      mistaken: whether that was bad input, which is as bad another time.
    """

    seconds: float = 0.0
    error: str = ""
    mistaken: bool = False


class _Agenda:
    """What is left to be done.

    Attributes:
      cells: all, each after those that it needs.
      redo: whether what was found from other inputs may be deleted.
      left: those of which nothing is known yet.
      done: those that are there.
      failed: those that are not to be had, and what became of them.
      whole: of all the work, what was not there at the beginning.
      spent: of it, what is done or failed.
    """

    def __init__(self, cells: Mapping[str, Cell], out: Path, redo: bool) -> None:
        self.cells, self.out, self.redo = cells, out.absolute(), redo
        self.left, self.done, self.failed = dict(cells), set[str](), dict[str, Outcome]()
        self.whole, self.spent = sum(cell.weight for cell in cells.values()), 0.0
        self._way: dict[str, float] = {}
        for cell in reversed(cells.values()):
            way = self._way.setdefault(cell.name, 0.0) + cell.weight
            self._way[cell.name] = way
            for need in cell.needs.values():
                self._way[need] = max(way, self._way.get(need, 0.0))

    def due(self) -> list[Order]:
        """Cells that can be begun since this was last asked, the longest way to the end first."""
        due = []
        for cell in list(self.left.values()):
            if missing := [need for need in cell.needs.values() if need in self.failed]:
                self.settle(self.left.pop(cell.name), Outcome(error=f"{NEEDS}{missing[0]}"))
            elif self.done.issuperset(cell.needs.values()):
                order = Order(self.left.pop(cell.name), self.out, redo=self.redo)
                if order.done:
                    self.done.add(cell.name)
                    self.whole -= cell.weight
                else:
                    due.append(order)
        return sorted(due, key=lambda order: -self._way[order.cell.name])

    def settle(self, cell: Cell, outcome: Outcome) -> None:
        """A cell is done, or failed where there is an error."""
        self.spent += cell.weight
        if outcome.error:
            self.failed[cell.name] = outcome
        else:
            self.done.add(cell.name)

    @property
    def share(self) -> float:
        """Of the work, what is done."""
        return self.spent / self.whole if self.whole else 1.0


def run_cells(
    cells: Mapping[str, Cell], out: Path, pools: Pools, tell: Told, redo: bool = False
) -> dict[str, Outcome]:
    """Do the cells that are not done.

    Args:
      cells: each after those that it needs.
      out: folder of the experiment.
      pools: of what does several at once.
      tell: told how many are done.
      redo: whether what was found from other inputs may be deleted; else such cells fail.

    Returns:
      The cells that failed, or could not be done as others had failed, and what became of them.
    """
    agenda, running, note = _Agenda(cells, out, redo), 0, ""
    with closing(pools(work_on)) as pool:
        while True:
            for order in agenda.due():
                pool.begin(order)
                running += 1
            tell(len(agenda.done), len(cells), note, agenda.share)
            if not running:
                return agenda.failed
            order, outcome = pool.settled()
            running -= 1
            told = _settled(order, outcome)
            agenda.settle(order.cell, told)
            end = f"failed, {told.error}" if told.error else f"in {told.seconds:.0f} s"
            note = f"{order.cell.name} {end}"


def work_on(order: Order) -> Outcome:
    """Do a cell; what goes wrong is written down instead of raised."""
    begin = time.monotonic()
    try:
        order.folder.mkdir(parents=True, exist_ok=True)
        # Ray repeats a cell whose node it lost; that one may work on for a while.
        with held(order.folder, LEASE):
            _spare(order)
            Journal(order.folder).once(order.stage())
    except Exception as error:  # whatever it is, other cells go on
        why = caught(order.folder, error)
        return Outcome(error=why, mistaken=isinstance(error, InputError))
    mended(order.folder)
    return Outcome(time.monotonic() - begin)


def _spare(order: Order) -> None:
    """Refuse to delete what was found; `refuse_changed` does not know what others will find."""
    if not order.redo and (changed := order.changed):
        raise InputError(
            f"is done, with another {', '.join(changed)}; --redo, without --cell, does it anew"
        )


def refuse_changed(cells: Mapping[str, Cell], out: Path, redo: str) -> None:
    """Refuse cells that are done, but from other inputs than are asked for now.

    What they found would be deleted, for a plan that was changed or an option that was forgotten.

    Args:
      cells: of which each would be done if it were not.
      out: folder of the experiment.
      redo: how to have them done anew all the same, in words.

    Raises:
      InputError: there are such cells.
    """
    orders = [Order(cell, out.absolute()) for cell in cells.values()]
    if changed := {o.cell.name: f"another {', '.join(o.changed)}" for o in orders if o.changed}:
        raise InputError(
            f"{out}: {len(changed)} finished cells were done with other inputs, and what they "
            f"found would be deleted: {named(changed)}; give the options and the plan of before, "
            f"use another --out, or {redo}"
        )


def failure(failed: Mapping[str, Outcome], out: Path) -> InputError | ChildProcessError:
    """What to raise of cells that failed: bad input only where nothing else went wrong.

    What was lost with a node may be done by the same command.
    """
    own = {name: told for name, told in failed.items() if not told.error.startswith(NEEDS)}
    line = (
        f"{out}: {len(own)} cells failed and {len(failed) - len(own)} need them, see "
        f"{CELLS}/*/{ERROR}; the same command tries them again: "
        f"{named({name: told.error for name, told in own.items()})}"
    )
    return _raised(line, all(told.mistaken for told in own.values()))


def with_needed(cells: Mapping[str, Cell], name: str) -> dict[str, Cell]:
    """A cell, after those that it needs.

    Raises:
      InputError: there is no such cell.
    """
    if name not in cells:
        raise InputError(f"--cell {name}: there is none; {', '.join(list(cells)[:SHOWN])}, ...")
    return chosen(cells, [name])


def run_again(
    cells: Mapping[str, Cell], name: str, out: Path, pools: Pools, tell: Told
) -> dict[str, Any]:
    """Do one cell anew, beside what it left before, and compare.

    Cells that it needs are done first where they are not. One that was never done is done twice,
    so that there is something to compare. Nothing is deleted that was done from other inputs.

    Args:
      cells: of the experiment.
      name: of the cell.
      out: folder of the experiment.
      pools: of what does several at once.
      tell: told how many are done.

    Returns:
      Whether both `agree`, the digests of what they found, and their folders.

    Raises:
      InputError: there is no such cell, or what it is given is bad.
      ChildProcessError: it fails otherwise.
    """
    failed = run_cells(with_needed(cells, name), out, pools, tell)
    if failed:
        raise failure(failed, out)
    first = Order(cells[name], out.absolute())
    second = Order(cells[name], out.absolute(), AGAIN, redo=True)
    if second.done:
        shutil.rmtree(second.folder)
    with closing(pools(work_on)) as pool:
        pool.begin(second)
        told = _settled(*pool.settled())
    if told.error:
        raise _raised(f"{second.folder}: {told.error}", told.mistaken)
    found = {str(o.folder): digest(o.result()) for o in (first, second)}
    return {"cell": name, "agree": len(set(found.values())) == 1, "results": found}


def digest(result: Mapping[str, Any]) -> str:
    """SHA-256 of what a cell found."""
    return hashlib.sha256(json.dumps(result, sort_keys=True).encode()).hexdigest()


def _raised(line: str, mistaken: bool) -> InputError | ChildProcessError:
    return InputError(line) if mistaken else ChildProcessError(line)


def _settled(order: Order, outcome: Any) -> Outcome:
    """An outcome; a cell whose process was lost has none, and gets its error file here."""
    if isinstance(outcome, Outcome):
        return outcome
    return Outcome(error=lost(order.folder, outcome))
