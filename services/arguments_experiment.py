"""What can be written behind `pup experiment`."""

import argparse
import re
from pathlib import Path

from services.options import out, place, robot_or_darwin


def experiment(verb: argparse.ArgumentParser) -> None:
    """Which plan, and which part of it."""
    robot_or_darwin(verb)
    what = verb.add_argument_group("the plan; what is given here wins over the file")
    source = what.add_mutually_exclusive_group()
    source.add_argument("--plan", type=Path, metavar="FILE", help="TOML; see docs/experiment.md")
    source.add_argument(
        "--small", action="store_true", help="two robots and the least work, in minutes"
    )
    what.add_argument(
        "--seeds",
        type=_seeds,
        metavar="A-B,...",
        help="of the concealed robots, all of which walk in every direction",
    )
    what.add_argument(
        "--methods",
        type=_words,
        metavar="M,...",
        help="some of the plan's: pup, up, robust, nominal",
    )
    what.add_argument(
        "--stages",
        type=_words,
        metavar="S,...",
        help="record, presysid, policy, trials, prior, diagnosis, corrected, diagnosed, "
        "undiagnosed; with what they need",
    )
    what.add_argument(
        "--policies",
        type=Path,
        metavar="DIR",
        help="policies that are trained already, DIR/DIRECTION/METHOD each; others are trained",
    )
    what.add_argument(
        "--real",
        type=Path,
        metavar="DIR",
        help="recordings of a real robot, to be identified and diagnosed beside",
    )
    out(verb, "cells/, experiment.json and report.html")
    done = verb.add_mutually_exclusive_group()
    done.add_argument(
        "--cell",
        type=_name,
        metavar="NAME",
        help="only do this one again, and compare with what it found before; all other options as "
        "it was done with",
    )
    done.add_argument(
        "--redo",
        action="store_true",
        help="delete what cells found that were done with another plan or other options, and do "
        "them anew; else they are refused",
    )
    place(verb)


MOST_ROBOTS = 10_000


def _name(text: str) -> str:
    """A cell, such as trials-r1000-forward-pup."""
    if not re.fullmatch(r"[a-z0-9-]{1,80}", text):
        raise argparse.ArgumentTypeError(
            f"{text!r} is no cell; there is a folder of each in cells/"
        )
    return text


def _words(text: str) -> tuple[str, ...]:
    words = tuple(word.strip() for word in text.split(",") if word.strip())
    if not words:  # none would be read as all, such as where a variable of a shell is empty
        raise argparse.ArgumentTypeError(f"{text!r} names nothing; leave the option out for all")
    return words


def _seeds(text: str) -> tuple[int, ...]:
    """Seeds such as 3,5,10-14."""
    told: list[int] = []
    for part in text.split(","):
        first, dash, last = part.partition("-")
        if not first.isdecimal() or (dash and not last.isdecimal()):
            raise argparse.ArgumentTypeError(f"{text!r} is not A-B,..., whole numbers from 0")
        begin, end = int(first), int(last or first)
        if end - begin >= MOST_ROBOTS:
            raise argparse.ArgumentTypeError(f"{text[:40]!r} names more than {MOST_ROBOTS} robots")
        told += range(begin, end + 1)
    if not told or len(set(told)) < len(told) or len(told) > MOST_ROBOTS:
        raise argparse.ArgumentTypeError(f"{text!r} does not name robots, each once")
    return tuple(told)
