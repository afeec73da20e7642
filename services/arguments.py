"""What can be written behind `pup`."""

import argparse
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pup.robot import built_in_robots

DEFAULT_ROBOT = "darwin_op2"


def parser() -> argparse.ArgumentParser:
    """The whole command line; the verb ends up in `name`."""
    whole = argparse.ArgumentParser(
        prog="pup",
        description="From recordings of a legged robot to bounds of its parameters.",
        epilog="`pup VERB --help` tells the options of a verb. Exit codes: 0 done, 2 bad input, "
        "130 stopped, 1 anything else.",
    )
    whole.add_argument("--version", action="version", version=f"pup {version('pup')}")
    verbs = whole.add_subparsers(title="verbs", required=True, dest="name", metavar="VERB")
    for name, told, fill in (
        ("run", "the whole job, stage by stage; run again, it resumes", _run),
        ("import", "turn other people's logs into recordings", _import),
        ("record", "record scripted motions of a virtual robot", _record),
        ("presysid", "fit a robot's parameters to recordings, with bounds", _presysid),
        ("replay", "simulate recordings and compare", _replay),
        ("diagnose", "say what physics the simulator leaves out, and model it", _diagnose),
        ("blind", "make or score a sealed set of concealed cases", _blind),
    ):
        verb = verbs.add_parser(name, help=told, description=f"{told[0].upper()}{told[1:]}.")
        fill(verb)
        verb.add_argument(
            "--json", action="store_true", help="print one JSON object last on standard output"
        )
    return whole


def _run(verb: argparse.ArgumentParser) -> None:
    _robot(verb, default=DEFAULT_ROBOT, more="; default: %(default)s")
    verb.add_argument(
        "--recordings",
        type=Path,
        metavar="DIR",
        help="folder of recordings; default: those that come with the robot",
    )
    _out(verb, "the results of all stages")
    _budget(verb, generations=100, subset_generations=30)
    _place(verb)


def _presysid(verb: argparse.ArgumentParser) -> None:
    _recordings(verb)
    _robot(verb, required=True)
    _out(verb, "bounds.json, report.html and checkpoints/")
    _budget(verb, generations=500, subset_generations=100)
    _place(verb)


def _replay(verb: argparse.ArgumentParser) -> None:
    _recordings(verb)
    _robot(verb, required=True)
    verb.add_argument(
        "--bounds",
        type=Path,
        metavar="FILE",
        help="bounds.json whose nominal values are replayed; default: the robot's own "
        "identified.json, without one the values of its robot.toml",
    )
    _out(verb, "replay.json and a plot per recording")
    _cores(verb)


def _diagnose(verb: argparse.ArgumentParser) -> None:
    _recordings(verb)
    _robot(verb, required=True)
    _out(verb, "diagnosis.json, report.html and corrected/, a robot with what was missing")
    _seed(verb)
    _place(verb)


def _import(verb: argparse.ArgumentParser) -> None:
    verb.add_argument(
        "format", metavar="FORMAT", help="bam, csv, darwin-hardware, emps, mcap, npz or sage"
    )
    verb.add_argument(
        "paths", type=Path, nargs="+", metavar="PATH", help="logs, or folders that hold some"
    )
    _out(verb, "a Parquet file per recording")
    told = verb.add_argument_group("what the logs do not tell; it wins over what they do")
    named = told.add_mutually_exclusive_group()
    _robot(named, more="; the recordings must fit it")
    named.add_argument("--robot-name", metavar="NAME", help="of a robot without a description")
    told.add_argument("--motion", help="motion type, such as step, hold or walk")
    told.add_argument("--support", choices=("suspended", "ground", "bench"))
    told.add_argument("--source", choices=("hardware", "simulation", "unknown"))
    told.add_argument(
        "--setup",
        type=_knob,
        nargs="+",
        action="extend",
        default=[],
        metavar="KNOB=NUMBER",
        help="what was knowingly changed on the robot, by its knobs",
    )
    told.add_argument("--notes", default="", metavar="TEXT", help="kept with the recordings")
    told.add_argument(
        "--joints", metavar="A,B,...", help="joint names in column order (npz without names)"
    )
    told.add_argument("--state-topic", metavar="TOPIC", help="of the readings (mcap)")
    told.add_argument("--command-topic", metavar="TOPIC", help="of the commands (mcap)")


def _record(verb: argparse.ArgumentParser) -> None:
    verb.add_argument(
        "motions",
        nargs="+",
        metavar="MOTION",
        help="step, standup, fall, hold, chirp or triangle; step:0.3 (rad), standup:2 (s) and "
        "fall:left are single variants",
    )
    _robot(verb, required=True)
    _out(verb, "a Parquet file per recording; it may hold no other recordings")
    verb.add_argument("--virtual", action="store_true", help="on a simulated robot (required)")
    _seed(verb, "; also which robot it is")
    _actuator(verb)
    verb.add_argument(
        "--repeats", type=_number(1, 100), default=1, metavar="N", help="of each motion; default: 1"
    )
    verb.add_argument("--noiseless", action="store_true", help="perfect sensors and clock")
    verb.add_argument(
        "--truth", type=Path, metavar="FILE", help="reveal the robot's parameters in this file"
    )


def _blind(verb: argparse.ArgumentParser) -> None:
    actions = verb.add_subparsers(title="actions", required=True, dest="action", metavar="ACTION")
    make = actions.add_parser("make", help="make a set", description="Make a sealed set.")
    for option, told in (("--robot", "with something missing"), ("--nulls", "without")):
        make.add_argument(
            option,
            type=_count,
            nargs="+",
            action="extend",
            default=[],
            metavar="NAME=COUNT",
            help=f"cases {told}, by robot",
        )
    make.add_argument(
        "--seed", required=True, metavar="KEY", help="any text; it tells the key, so conceal it"
    )
    _out(make, "the cases and commitment.json; it may hold nothing else")
    make.add_argument(
        "--key", type=Path, required=True, metavar="FILE", help="where the truth goes; conceal it"
    )
    score = actions.add_parser("score", help="score verdicts", description="Score verdicts.")
    for option, metavar, told in (
        ("--set", "DIR", "folder of the set"),
        ("--key", "FILE", "its key, revealed"),
        ("--diagnoses", "DIR", "folder with a folder case_<id> per case that holds diagnosis.json"),
        ("--out", "FILE", "where the scores go, as JSON; a table goes beside it"),
    ):
        score.add_argument(option, type=Path, required=True, metavar=metavar, help=told)
    for action in (make, score):
        action.add_argument(
            "--json",
            action="store_true",
            default=argparse.SUPPRESS,
            help="print one JSON object last on standard output",
        )


def _recordings(verb: argparse.ArgumentParser) -> None:
    verb.add_argument(
        "recordings",
        type=Path,
        nargs="+",
        metavar="RECORDING",
        help="Parquet file, or a folder of them",
    )


def _robot(to: Any, more: str = "", **options: Any) -> None:
    names = ", ".join(built_in_robots())
    to.add_argument("--robot", help=f"{names}, or a robot's folder{more}", **options)


def _out(verb: argparse.ArgumentParser, what: str) -> None:
    verb.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="DIR",
        help=f"folder for {what}; made when absent",
    )


def _actuator(to: Any) -> None:
    to.add_argument(
        "--actuator",
        choices=("nn_pd", "pd"),
        help="torque law; default: nn_pd where the robot has a network, else pd",
    )


def _seed(to: Any, more: str = "") -> None:
    to.add_argument(
        "--seed",
        type=_number(0, 2**31),
        default=0,
        metavar="N",
        help=f"of everything random{more}; default: %(default)s",
    )


def _budget(verb: argparse.ArgumentParser, generations: int, subset_generations: int) -> None:
    budget = verb.add_argument_group("what is fitted, and how long")
    _actuator(budget)
    for name, limits, default, told in (
        ("--generations", (1, 100_000), generations, "of each nominal fit"),
        ("--population", (4, 4096), 16, "candidates per generation"),
        ("--subsets", (1, 1000), 10, "random subsets of the recordings for the bounds"),
        ("--subset-generations", (1, 100_000), subset_generations, "of each subset's fit"),
        ("--folds", (0, 100), 0, "leave-recordings-out fits for a held-out error, 0 for none"),
    ):
        budget.add_argument(
            name,
            type=_number(*limits),
            default=default,
            metavar="N",
            help=f"{told}; default: %(default)s",
        )
    budget.add_argument(
        "--fraction",
        type=_number(0.0, 1.0, float),
        default=0.1,
        metavar="F",
        help="share of the recordings in a subset, at least two; default: %(default)s",
    )
    budget.add_argument(
        "--no-comparison", action="store_true", help="do not fit the other torque law"
    )
    budget.add_argument(
        "--fixed-network", action="store_true", help="keep the robot's network weights"
    )
    _seed(budget)


def _place(verb: argparse.ArgumentParser) -> None:
    place = verb.add_argument_group("where it runs")
    where = place.add_mutually_exclusive_group()
    where.add_argument("--address", help="of a running Ray cluster; default: an embedded Ray")
    where.add_argument("--local", action="store_true", help="in this process alone, without Ray")
    _cores(place)


def _cores(to: Any) -> None:
    to.add_argument(
        "--cores", type=_number(1, 4096), metavar="N", help="cores to use; default: all"
    )


def _number(low: float, high: float, kind: type = int) -> Callable[[str], Any]:
    """An argument type: a number within limits."""
    wanted = "a whole number" if kind is int else "a number"

    def parse(text: str) -> Any:
        try:
            value = kind(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(f"{text!r} is not {wanted}") from error
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text} is not between {low:.10g} and {high:.10g}")
        return value

    return parse


def _knob(text: str) -> tuple[str, float]:
    """An argument type: what a knob is set to."""
    name, _, value = text.partition("=")
    try:
        number = float(value)
    except ValueError:
        name = ""
    if not name:
        raise argparse.ArgumentTypeError(f"{text!r} is not KNOB=NUMBER")
    return name, number


def _count(text: str) -> tuple[str, int]:
    """An argument type: how many cases of a robot."""
    name, _, value = text.rpartition("=")
    if not name or not value.isdecimal() or not 0 <= int(value) <= 10_000:
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=COUNT, with 0 to 10000 cases")
    return name, int(value)
