"""The blind jobs: make a sealed set of concealed cases, and score the verdicts on one."""

import argparse
import sys
from pathlib import Path
from typing import Any

from pup.blind.make import make_set
from pup.files import write_atomic, write_json


def make(options: argparse.Namespace) -> dict[str, Any]:
    """Make a sealed set.

    Returns:
      The commitment.
    """
    terminal = sys.stderr.isatty()

    def report(id: str, done: int, total: int) -> None:
        line = f"blind make: {done}/{total} cases"
        print(f"\r{line}" if terminal else line, file=sys.stderr, end="" if terminal else "\n")

    commitment = make_set(
        dict(options.robot), dict(options.nulls), options.seed, options.out, options.key, report
    )
    if terminal:
        print(file=sys.stderr)
    return commitment


def score(options: argparse.Namespace) -> dict[str, Any]:
    """Score the verdicts on a set and write the table beside the scores.

    Returns:
      The scores, with the table under `table`.
    """
    from pup.blind.score import score_set
    from pup.blind.table import markdown

    scores = score_set(options.set, options.key, options.diagnoses)
    write_json(options.out, scores)
    table = markdown(scores)
    write_atomic(options.out.with_suffix(".md"), table)
    return {**scores, "table": table}


def show(shown: dict[str, Any]) -> None:
    """Print the outcome of either job."""
    print(shown["table"] if "table" in shown else _told(shown))


def _told(commitment: dict[str, Any]) -> str:
    cases = ", ".join(f"{robot} {count}" for robot, count in commitment["cases"].items())
    return f"cases: {cases}\ncommitment: {commitment['key_sha256']}"


def folder_of(options: argparse.Namespace) -> Path:
    """The folder that a job needs to write to."""
    out: Path = options.out
    return out if options.action == "make" else out.parent
