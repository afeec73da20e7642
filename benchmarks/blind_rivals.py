"""Rivals of the diagnosis on the cases of a blind set, scored by the scorer of `pup blind score`.

    pip install -c constraints.txt -e '.[bench]'
    python -m benchmarks.blind_rivals --set blind_set --key key.json --diagnoses verdicts \
      --out rivals.json

Each rival is given the recordings of a case and the diagnosis's own nominal fit of them, and gives
a verdict in the form of `diagnosis.json`, under the name of `--out` without its suffix:

- `residual_rms`: the joint whose error is larger than its noise; it has no name for the cause.
- `friction_ladder`: BAM's nested friction models, Coulomb, Stribeck, load-dependent and quadratic
  in turn, fitted in simulation at each joint and chosen by BIC.
- `exhaustive_bic`: every effect of the library at every place and in every shape refitted with the
  nominal parameters, without a score test, and chosen by BIC.
- `sparse_regression`: PySINDy's thresholded least squares on the torque that inverse dynamics of
  smoothed positions misses; the threshold is tuned on types of motion left out.
- `residual_network`: a network that learns that torque and acts in the simulation's loop.

Beside `--out`, which has the scores of all, stands the table as Markdown. What is done is kept; the
same command goes on. The key is read for the scores alone.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from benchmarks.rivals.run import RIVALS, place_of, replay, robot_of, run_case
from benchmarks.rivals.table import costs, page
from pup.blind.score import score_set
from pup.blind.seal import verify
from pup.errors import InputError
from pup.files import read_json, write_atomic, write_json
from services.blind_journal import Journal, read_journal
from services.blind_run import Order, orders
from services.diagnosis import DIAGNOSIS
from services.progress import counted

OURS = "pup diagnose"
ROBOTS = ("servo_bench",)
NEEDS = {"sparse_regression": "pysindy", "residual_network": "torch"}


def main(arguments: Sequence[str] | None = None) -> int:
    given = _parser().parse_args(arguments)
    try:
        wanted, commitment = _wanted(given)
        folder = given.out.with_suffix("")
        folder.mkdir(parents=True, exist_ok=True)
        failed = run(wanted, given.rivals, folder, commitment)
        told = scored(wanted, given)
    except InputError as error:
        print(f"blind_rivals: {error}", file=sys.stderr)
        return 2
    write_json(given.out, told)
    table = page(told["cases"], told["methods"])
    write_atomic(given.out.with_suffix(".md"), table)
    print(table)
    for name, why in failed.items():
        print(f"failed: {name}: {why}", file=sys.stderr)
    return 1 if failed else 0


def run(
    wanted: Sequence[Order], rivals: Sequence[str], folder: Path, commitment: Mapping[str, Any]
) -> dict[str, str]:
    """Have rivals judge the cases that they have not judged yet.

    Args:
      wanted: the cases.
      rivals: their names.
      folder: of the verdicts.
      commitment: of the set.

    Returns:
      What failed, and why.
    """
    failed: dict[str, str] = {}
    left = {
        order: [r for r in rivals if not (place_of(folder, r, order) / DIAGNOSIS).is_file()]
        for order in wanted
    }
    begin = done = len(wanted) * len(rivals) - sum(map(len, left.values()))
    total = len(wanted) * len(rivals)
    journal = Journal(folder, commitment)
    if done == total:
        return failed
    with journal.session(1, failed), counted("blind rivals") as tell:
        for order, names in left.items():
            for rival, told in run_case(order, names, folder) if names else ():
                done += 1
                if told.startswith("failed"):
                    failed[f"{rival}/{order.name}"] = told
                note = f"{order.name}, {rival}: {told}"
                tell(done, total, note, (done - begin) / (total - begin))
    return failed


def scored(wanted: Sequence[Order], given: argparse.Namespace) -> dict[str, Any]:
    """The scores of the diagnosis and of the rivals on the same cases, as JSON values."""
    folder = given.out.with_suffix("")
    places = {OURS: given.diagnoses, **{name: folder / name for name in given.rivals}}
    cases = [order.name.removeprefix("case_") for order in wanted]
    documents = {
        name: {
            case: read_json(file)
            for case in cases
            if (file := place / f"case_{case}" / DIAGNOSIS).is_file()
        }
        for name, place in places.items()
    }
    truths = verify(given.set, given.key)["cases"]
    nulls = {t["id"] for t in truths if t["stratum"].startswith("null:")}
    missing = [case for case in cases if case not in nulls]
    methods = {}
    for name, place in places.items():
        scores = score_set(given.set, given.key, place, replay, only=cases)
        methods[name] = scores | {"costs": costs(documents[name], documents[OURS], missing)}
    engines = {
        name: read_journal(place) for name, place in ((OURS, given.diagnoses), ("rivals", folder))
    }
    return {
        "schema": 1,
        "benchmark": "blind_rivals",
        "cases": cases,
        "engine": {name: told["engine"] if told else None for name, told in engines.items()},
        "methods": methods,
    }


def _wanted(given: argparse.Namespace) -> tuple[list[Order], dict[str, Any]]:
    """The cases that are asked for, and the set's commitment."""
    for rival in given.rivals:
        needs = NEEDS.get(rival)
        if needs and find_spec(needs) is None:
            raise InputError(
                f"{rival} needs {needs}: pip install -c constraints.txt -e '.[bench]', or leave it "
                "out of --rivals"
            )
    if given.out.suffix in ("", ".md"):
        raise InputError(f"--out {given.out}: needs a file for JSON; the table goes to *.md")
    every, commitment = orders(given.set, given.out.with_suffix(""), None)
    wanted: list[Order] = []
    for order in every:
        if len(wanted) == given.limit:
            break
        if robot_of(order) in given.robots:
            wanted.append(order)
    if not wanted:
        raise InputError(f"{given.set}: no case of {', '.join(given.robots)}")
    return wanted, commitment


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.blind_rivals",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--set", type=Path, required=True, help="the set")
    parser.add_argument("--key", type=Path, required=True, help="its key")
    parser.add_argument("--diagnoses", type=Path, required=True, help="of `pup blind run`")
    parser.add_argument("--out", type=Path, required=True, help="JSON file of all scores")
    parser.add_argument("--limit", type=int, help="take only so many cases")
    parser.add_argument("--rivals", nargs="+", choices=RIVALS, default=list(RIVALS))
    parser.add_argument("--robots", nargs="+", default=ROBOTS, help="default: %(default)s")
    return parser


if __name__ == "__main__":
    sys.exit(main())
