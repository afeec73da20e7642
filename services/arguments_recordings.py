"""What can be written behind the verbs that make, read or explain recordings."""

import argparse
from pathlib import Path

from services.options import (
    actuator,
    budget,
    cores,
    count,
    knob,
    number,
    out,
    place,
    recordings,
    robot,
    seed,
)


def describe(verb: argparse.ArgumentParser) -> None:
    """Which model, and what it does not tell."""
    verb.add_argument("model", type=Path, metavar="MODEL", help="MJCF or URDF")
    out(verb, "robot.toml, model.xml and its meshes")
    verb.add_argument(
        "--name", dest="called", default="", help="of the robot; default: the model's"
    )
    verb.add_argument(
        "--free",
        action="store_true",
        help="let a base that the model fixes move, with a floor below: URDF does not tell",
    )


def import_logs(verb: argparse.ArgumentParser) -> None:
    """What is read, and what the logs do not tell."""
    verb.add_argument(
        "format", metavar="FORMAT", help="bam, csv, darwin-hardware, emps, mcap, npz or sage"
    )
    verb.add_argument(
        "paths", type=Path, nargs="+", metavar="PATH", help="logs, or folders that hold some"
    )
    out(verb, "a Parquet file per recording")
    told = verb.add_argument_group("what the logs do not tell; it wins over what they do")
    named = told.add_mutually_exclusive_group()
    robot(named, more="; the recordings must fit it")
    named.add_argument("--robot-name", metavar="NAME", help="of a robot without a description")
    told.add_argument("--motion", help="motion type, such as step, hold or walk")
    told.add_argument("--support", choices=("suspended", "ground", "bench"))
    told.add_argument("--source", choices=("hardware", "simulation", "unknown"))
    _setup(told, "what was knowingly changed on the robot, by its knobs")
    told.add_argument(
        "--repeat-of", metavar="ID", help="of the recording that this one repeats; for one log"
    )
    told.add_argument("--notes", default="", metavar="TEXT", help="kept with the recordings")
    told.add_argument(
        "--joints", metavar="A,B,...", help="joint names in column order (npz without names)"
    )
    told.add_argument("--state-topic", metavar="TOPIC", help="of the readings (mcap)")
    told.add_argument("--command-topic", metavar="TOPIC", help="of the commands (mcap)")


def export(verb: argparse.ArgumentParser) -> None:
    """What is read, in which format it is written, and what is simulated beside it."""
    verb.add_argument(
        "format", metavar="FORMAT", help="lerobot (LeRobotDataset v3), mcap (Foxglove), rrd (Rerun)"
    )
    recordings(verb)
    out(verb, "a file per recording, or for lerobot one data set")
    verb.add_argument(
        "--fps",
        type=number(1, 1000),
        metavar="N",
        help="frames per second (lerobot); default: what the recordings have",
    )
    replayed = verb.add_argument_group("beside each recording, its replay in simulation")
    robot(replayed, more="; it is simulated, and drawn in rrd")
    replayed.add_argument(
        "--bounds",
        type=Path,
        metavar="FILE",
        help="bounds.json whose nominal values are replayed; default: as of `pup replay`",
    )
    cores(replayed)


def _setup(group: argparse._ActionsContainer, help: str) -> None:
    """Knobs of a robot and their values."""
    group.add_argument(
        "--setup",
        type=knob,
        nargs="+",
        action="extend",
        default=[],
        metavar="KNOB=NUMBER",
        help=help,
    )


def record(verb: argparse.ArgumentParser) -> None:
    """What a robot does."""
    verb.add_argument(
        "motions",
        nargs="+",
        metavar="MOTION",
        help="step, standup, stand, fall, hold, chirp, triangle or multisine; step:0.3 (rad), "
        "standup:2 (s) and fall:left are single variants",
    )
    robot(verb, required=True)
    out(verb, "a file per recording or script; it may hold no others")
    where = verb.add_mutually_exclusive_group(required=True)
    where.add_argument("--virtual", action="store_true", help="on a simulated robot")
    where.add_argument(
        "--scripts",
        action="store_true",
        help="by the robot itself: only make scripts, which `pup-agent play` plays there",
    )
    seed(verb, "; also which virtual robot it is")
    actuator(verb)
    verb.add_argument(
        "--repeats", type=number(1, 100), default=1, metavar="N", help="of each motion; default: 1"
    )
    _setup(verb, "what is changed on the simulated robot, by its knobs, such as kp=20")
    verb.add_argument("--noiseless", action="store_true", help="perfect sensors and clock")
    verb.add_argument(
        "--truth", type=Path, metavar="FILE", help="reveal the robot's parameters in this file"
    )


def presysid(verb: argparse.ArgumentParser) -> None:
    """What is fitted."""
    recordings(verb)
    robot(verb, required=True)
    out(verb, "bounds.json, report.html and checkpoints/")
    budget(verb, generations=500, subset_generations=100, comparison=True)
    place(verb)


def diagnose(verb: argparse.ArgumentParser) -> None:
    """What is explained."""
    recordings(verb)
    robot(verb, required=True)
    out(verb, "diagnosis.json, report.html and corrected/, a robot with what was missing")
    verb.add_argument(
        "--rivals",
        action="store_true",
        help="also fit the paper's NN-PD and a residual network to the same recordings and judge "
        "all by motions left out; takes longer and needs PyTorch (the extra `learn`)",
    )
    verb.add_argument(
        "--effects",
        type=number(1, 16),
        default=8,
        metavar="N",
        help="missing effects that are looked for at most, one after the other, minutes for each "
        "where a robot has many joints; default: 8",
    )
    verb.add_argument(
        "--seconds",
        type=number(1.0, 1e6, float),
        metavar="S",
        help="of each recording that are used, from its start; time and memory grow with them; "
        "default: all",
    )
    seed(verb)
    place(verb)


def blind(verb: argparse.ArgumentParser) -> None:
    """The actions on sealed sets."""
    actions = verb.add_subparsers(title="actions", required=True, dest="action", metavar="ACTION")
    for name, told, fill in (
        ("make", "make a sealed set; run again after a stop, it resumes", _blind_make),
        ("run", "diagnose all cases of a set; run again, it resumes", _blind_run),
        ("score", "score the verdicts on a set", _blind_score),
    ):
        action = actions.add_parser(name, help=told, description=f"{told[0].upper()}{told[1:]}.")
        fill(action)
        action.add_argument(
            "--json",
            action="store_true",
            default=argparse.SUPPRESS,
            help="print one JSON object last on standard output",
        )


def _blind_make(action: argparse.ArgumentParser) -> None:
    for option, told in (("--robot", "with something missing"), ("--nulls", "without")):
        action.add_argument(
            option,
            type=count,
            nargs="+",
            action="extend",
            default=[],
            metavar="NAME=COUNT",
            help=f"cases {told}, by robot",
        )
    action.add_argument(
        "--seed",
        required=True,
        metavar="KEY",
        help="any text of 16 characters or more; it tells the key, so conceal it",
    )
    out(action, "the cases and commitment.json; it may hold nothing else")
    action.add_argument(
        "--key", type=Path, required=True, metavar="FILE", help="where the truth goes; conceal it"
    )
    place(action)


def _blind_run(action: argparse.ArgumentParser) -> None:
    _paths(action, ("--set", "DIR", "folder of the set"))
    out(action, "run.json and, for each case, what `pup diagnose` writes but the report")
    _limit(action)
    place(action)


def _blind_score(action: argparse.ArgumentParser) -> None:
    _paths(
        action,
        ("--set", "DIR", "folder of the set"),
        ("--key", "FILE", "its key, revealed"),
        ("--diagnoses", "DIR", "what `pup blind run` wrote: a case_<id>/diagnosis.json each"),
        ("--out", "FILE", "where the scores go, as JSON; a table goes beside it"),
    )
    _limit(action)


def _limit(action: argparse.ArgumentParser) -> None:
    action.add_argument(
        "--limit",
        type=number(1, 1_000_000),
        metavar="N",
        help="only the first N cases by their random ids; default: all",
    )


def _paths(action: argparse.ArgumentParser, *wanted: tuple[str, str, str]) -> None:
    for option, metavar, told in wanted:
        action.add_argument(option, type=Path, required=True, metavar=metavar, help=told)
