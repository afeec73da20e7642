"""The blind jobs: make a sealed set of concealed cases, diagnose it, and score the verdicts."""

import argparse
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

from pup.blind.make import Order, make_set, parts_of
from pup.blind.seal import read_set
from pup.errors import InputError
from pup.files import write_atomic, write_json
from services import places
from services.blind_journal import JOURNAL, SAME_SET, Journal, doubts, read_journal
from services.held import held
from services.progress import counted


def make(options: argparse.Namespace) -> dict[str, Any]:
    """Make a sealed set.

    Returns:
      The commitment.
    """

    def each(
        job: Callable[[Order], str], orders: Sequence[Order]
    ) -> Generator[tuple[Order, Any], None, None]:
        if not orders:
            return
        with places.cases(options) as (pools, _), closing(pools(job)) as pool:
            for order in orders:
                pool.begin(order)
            for _ in orders:
                yield pool.settled()

    wanted = _counts("--robot", options.robot), _counts("--nulls", options.nulls)
    parts = parts_of(options.key)
    with _concealed(parts), held(parts), counted("blind make") as tell:
        return make_set(
            *wanted,
            options.seed,
            options.out,
            options.key,
            lambda id, done, total: tell(done, total),
            each,
        )


def _counts(option: str, given: Sequence[tuple[str, int]]) -> dict[str, int]:
    """Cases by robot, each robot once."""
    counts = dict(given)
    if len(counts) < len(given):
        raise InputError(f"{option}: a robot is named twice; name it once, with all of its cases")
    return counts


@contextmanager
def _concealed(folder: Path) -> Iterator[None]:
    """A folder that its owner alone can read; gone again if nothing came of it."""
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    try:
        yield
    finally:
        with suppress(OSError):  # some are not empty
            for path in made:
                path.rmdir()


def run(options: argparse.Namespace) -> dict[str, Any]:
    """Diagnose all cases of a set.

    Returns:
      How many cases there are, and the run's journal.
    """
    from services.blind_run import orders, run_cases

    wanted, commitment = orders(options.set, options.out, options.limit)
    with held(options.out):
        journal = Journal(options.out, commitment)
        if not all(order.done for order in wanted):
            with places.cases(options) as (pools, lanes), counted("blind run") as tell:
                run_cases(wanted, journal, pools, lanes, tell)
        return {"cases": len(wanted), "out": str(options.out), **journal.document()}


def score(options: argparse.Namespace) -> dict[str, Any]:
    """Score the verdicts on a set and write the table beside the scores.

    Returns:
      The scores, with the engine that diagnosed, and the table under `table`.
    """
    from pup.blind.score import score_set
    from pup.blind.table import markdown
    from services.blind_oracle import replayed
    from services.blind_run import cases_of

    table = options.out.with_suffix(".md")
    if options.out.is_dir() or options.out == table:
        raise InputError(f"--out {options.out}: needs a file for JSON; the table goes to *.md")
    _spare(options, options.out, table)
    commitment, journal = read_set(options.set), read_journal(options.diagnoses)
    if journal and any(journal["set"].get(name) != commitment.get(name) for name in SAME_SET):
        raise InputError(f"{options.diagnoses / JOURNAL}: tells of a run over another set")
    with counted("blind score") as tell:
        first = [c.name.removeprefix("case_") for c in cases_of(options.set, options.limit)]
        only = None if options.limit is None else first
        scores = score_set(options.set, options.key, options.diagnoses, replayed, only, tell)
    scores["engine"] = journal["engine"] if journal else None
    scores["doubts"] = list(doubts(options.diagnoses, journal, commitment)) if journal else []
    write_json(options.out, scores)
    page = markdown(scores)
    write_atomic(table, page)
    return {**scores, "table": page}


def _spare(options: argparse.Namespace, *written: Path) -> None:
    """Refuse to write scores in the place of what they are made from."""
    inputs = (options.key, options.diagnoses / JOURNAL)
    for path in map(Path.resolve, written):
        if path in map(Path.resolve, inputs) or path.is_relative_to(options.set.resolve()):
            raise InputError(f"{path}: is of what is scored; use another --out")


ACTIONS = {"make": make, "run": run, "score": score}


def show(shown: dict[str, Any]) -> None:
    """Print the outcome of any of these jobs."""
    if "table" in shown:
        print(shown["table"])
    elif "sessions" in shown:
        print(f"{shown['cases']} cases diagnosed: {shown['out']}")
    else:
        cases = ", ".join(f"{robot} {count}" for robot, count in shown["cases"].items())
        print(f"cases: {cases}\ncommitment: {shown['key_sha256']}")


def folder_of(options: argparse.Namespace) -> Path:
    """The folder that a job needs to write to."""
    out: Path = options.out
    return out.parent if options.action == "score" else out
