"""What can be written behind `pup`."""

import argparse
import re
from importlib.metadata import version
from pathlib import Path

from pup.usage import Usage
from services.arguments_experiment import experiment
from services.arguments_jobs import jobs, submit
from services.arguments_policies import replay, serve, train, transfer, virtual_robot
from services.arguments_recordings import (
    blind,
    describe,
    diagnose,
    export,
    import_logs,
    presysid,
    record,
)
from services.options import budget, number, out, place, robot_or_darwin

NEGATIVE = re.compile(r"-[\d.][\d.eE+,-]*$")
"""Numbers between commas of which the first has a minus, as an eta may be; no option begins so."""


def parser(
    kind: type[argparse.ArgumentParser] = Usage,
) -> argparse.ArgumentParser:
    """The whole command line, as a kind of parser; the verb ends up in `name`."""
    whole = kind(
        prog="pup",
        description="From recordings of a legged robot to parameter bounds, a policy that walks, "
        "and the physics that the simulator left out.",
        epilog="`pup VERB --help` tells the options of a verb. Exit codes: 0 done, 2 bad input, "
        "130 stopped, 1 anything else.",
    )
    whole.add_argument("--version", action="version", version=f"pup {version('pup')}")
    verbs = whole.add_subparsers(title="verbs", required=True, dest="name", metavar="VERB")
    for name, told, fill in (
        ("run", "the whole job, stage by stage; run again, it resumes", _run),
        ("describe", "draft a robot's folder from its MJCF or URDF", describe),
        ("import", "turn other people's logs into recordings", import_logs),
        ("export", "turn recordings, and replays of them, into other programs' files", export),
        ("record", "record scripted motions of a virtual robot, or script them", record),
        ("presysid", "fit a robot's parameters to recordings, with bounds", presysid),
        ("train", "train a policy that walks, within bounds; run again, it resumes", train),
        ("transfer", "find what walks furthest on a robot, by a running service", transfer),
        ("submit", "run a verb as a job on the cluster of a running service", submit),
        ("jobs", "list, watch, call off and fetch such jobs", jobs),
        ("serve", "run the service that robots and studies talk to, or make its keys", serve),
        ("replay", "simulate recordings and compare, or let a policy walk", replay),
        ("diagnose", "say what physics the simulator leaves out, and model it", diagnose),
        ("blind", "make, diagnose or score a sealed set of concealed cases", blind),
        (
            "experiment",
            "the paper's experiment on concealed robots; run again, it resumes",
            experiment,
        ),
        ("virtual-robot", "be a robot on pseudo-terminals, until stopped", virtual_robot),
    ):
        verb = verbs.add_parser(name, help=told, description=f"{told[0].upper()}{told[1:]}.")
        fill(verb)
        verb._negative_number_matcher = NEGATIVE  # argparse knows a single number only
        verb.add_argument(
            "--json", action="store_true", help="print one JSON object last on standard output"
        )
    return whole


def _run(verb: argparse.ArgumentParser) -> None:
    robot_or_darwin(verb)
    verb.add_argument(
        "--recordings",
        type=Path,
        metavar="DIR",
        help="folder of recordings; default: those that come with the robot",
    )
    out(verb, "the results of all stages")
    budget(
        verb,
        generations=None,
        subset_generations=10,
        comparison=False,
        start="the robot's own identified.json, without one the values of robot.toml",
        usual="8 where it begins at fitted values, else 20",
    )
    verb.add_argument(
        "--effects",
        type=number(0, 16),
        default=2,
        metavar="N",
        help="missing effects that recordings and first walks are searched for, to do it all again "
        "with the robot as it was found to be; default: 2, 0 leaves that out",
    )
    later = verb.add_argument_group("what follows, for robots with a gait")
    for name, most, default, told in (
        ("--train-steps", 10**11, None, "of training, on Ray in any case; default: 150000, 0 none"),
        ("--trials", 1000, None, "walks of a virtual robot at most, to choose eta by; default: 25, "
         "none where recordings are of hardware; 0 leaves them out"),
        ("--repeats", 100, 5, "walks of the chosen eta and of the fitted one; default: 5"),
    ):  # fmt: skip
        later.add_argument(name, type=number(0, most), default=default, metavar="N", help=told)
    later.add_argument(
        "--least-gain",
        type=number(0.0, 0.99, float),
        default=0.002,
        metavar="X",
        help="expected of a further walk, as a share of the best eta's distance, below which eta "
        "is chosen; default: %(default)s, 0 makes all --trials",
    )
    verb.set_defaults(runners=0)
    place(verb)
