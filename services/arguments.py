"""What can be written behind `pup`."""

import argparse
from importlib.metadata import version
from pathlib import Path

from services.options import (
    actuator,
    budget,
    cores,
    count,
    engine,
    knob,
    number,
    numbers,
    out,
    place,
    recordings,
    robot,
    seed,
)

DEFAULT_ROBOT = "darwin_op2"
TRAINING = (
    ("--steps", (1000, 10**11), int, 10_000_000, "control steps of all simulations together"),
    ("--simulations", (1, 65536), int, 256, "at once, of each process that simulates"),
    ("--length", (2, 4096), int, 24, "control steps of each simulation between two updates"),
    ("--epochs", (1, 100), int, 4, "passes over the samples of an update"),
    ("--minibatch", (16, 2**20), int, 1536, "samples of a gradient step"),
    ("--learning-rate", (1e-7, 1.0), float, 1e-3, "at the beginning"),
    ("--entropy", (0.0, 10.0), float, 0.0, "weight of exploration, falling to 0"),
    ("--mirror", (0.0, 1000.0), float, 1.0, "weight of left-right symmetry; never sideways"),
)
"""Numbers of a training: option, limits, kind, default and what it is."""


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
        ("train", "train a policy that walks, within bounds; run again, it resumes", _train),
        ("transfer", "find what walks furthest on a robot, by a running service", _transfer),
        ("serve", "run the service that robots and studies talk to, or make its keys", _serve),
        ("replay", "simulate recordings and compare, or let a policy walk", _replay),
        ("diagnose", "say what physics the simulator leaves out, and model it", _diagnose),
        ("blind", "make, diagnose or score a sealed set of concealed cases", _blind),
        ("virtual-robot", "be a robot on pseudo-terminals, until stopped", _virtual_robot),
    ):
        verb = verbs.add_parser(name, help=told, description=f"{told[0].upper()}{told[1:]}.")
        fill(verb)
        verb.add_argument(
            "--json", action="store_true", help="print one JSON object last on standard output"
        )
    return whole


def _run(verb: argparse.ArgumentParser) -> None:
    robot(verb, default=DEFAULT_ROBOT, more="; default: %(default)s")
    verb.add_argument(
        "--recordings",
        type=Path,
        metavar="DIR",
        help="folder of recordings; default: those that come with the robot",
    )
    out(verb, "the results of all stages")
    budget(verb, generations=100, subset_generations=30)
    later = verb.add_argument_group("what follows, for robots with a gait")
    for name, limits, default, told in (
        ("--train-steps", (0, 10**11), None, "of training, on Ray in any case; default: 800000"),
        ("--trials", (0, 1000), None, "walks of a virtual robot, to choose eta by; default: 25"),
        ("--repeats", (0, 100), 5, "walks of the chosen eta and of the fitted one; default: 5"),
    ):
        later.add_argument(
            name,
            type=number(*limits),
            default=default,
            metavar="N",
            help=told if name == "--repeats" else f"{told}, 0 leaves it out",
        )
    verb.set_defaults(runners=0)
    place(verb)


def _presysid(verb: argparse.ArgumentParser) -> None:
    recordings(verb)
    robot(verb, required=True)
    out(verb, "bounds.json, report.html and checkpoints/")
    budget(verb, generations=500, subset_generations=100)
    place(verb)


def _train(verb: argparse.ArgumentParser) -> None:
    robot(verb, default=DEFAULT_ROBOT, more="; default: %(default)s")
    verb.add_argument(
        "--bounds",
        type=Path,
        metavar="FILE",
        help="bounds.json of pre-sysID; default: the robot's own identified.json",
    )
    out(verb, "policy/, best/, training.json, curve.png, tensorboard/ and checkpoint.npz")
    policy = verb.add_argument_group("what is trained, and how long")
    policy.add_argument(
        "--method",
        choices=("pup", "up", "robust", "nominal"),
        default="pup",
        help="the policy sees the parameters through a learnt projection, directly, not at all, or "
        "there is but one set of them; default: %(default)s",
    )
    policy.add_argument(
        "--direction", choices=("forward", "backward", "sideways"), default="forward"
    )
    policy.add_argument(
        "--start", type=Path, metavar="DIR", help="policy to train further; default: from scratch"
    )
    policy.add_argument(
        "--track",
        choices=("wandb", "mlflow"),
        action="append",
        default=[],
        help="tell Weights & Biases or MLflow too; TensorBoard's files are written in any case",
    )
    for name, limits, kind, default, told in TRAINING:
        policy.add_argument(
            name,
            type=number(*limits, kind),
            default=default,
            metavar="N" if kind is int else "X",
            help=f"{told}; default: %(default)s",
        )
    policy.add_argument(
        "--schedule",
        choices=("linear", "adaptive", "constant"),
        default="linear",
        help="of the learning rate: falling to a tenth, following the policy's divergence, or "
        "neither; default: %(default)s",
    )
    seed(policy)
    where = verb.add_argument_group("where it runs")
    where.add_argument("--address", help="of a running Ray cluster; default: an embedded Ray")
    where.add_argument(
        "--runners",
        type=number(0, 4096),
        default=0,
        metavar="N",
        help="processes that simulate, lost ones are replaced; default: none beside the learner's",
    )
    engine(where)
    cores(where)


def _transfer(verb: argparse.ArgumentParser) -> None:
    verb.add_argument(
        "--policy", type=Path, required=True, metavar="DIR", help="policy of `pup train`"
    )
    verb.add_argument(
        "--study", required=True, metavar="NAME", help="made, or joined where it is there"
    )
    verb.add_argument(
        "--out",
        type=Path,
        default=Path(),
        metavar="DIR",
        help="folder for study.json; default: the current one",
    )
    where = verb.add_argument_group("the service")
    where.add_argument(
        "--url", default="http://127.0.0.1:8470", help="of `pup serve`; default: %(default)s"
    )
    where.add_argument(
        "--token-file", metavar="FILE", help="with an operator's token; default: PUP_TOKEN"
    )
    study = verb.add_argument_group("the study, where it is made; defaults are the service's")
    for name, limits, kind, told in (
        ("--trials", (1, 1000), int, "walks until eta is chosen (25)"),
        ("--initial", (1, 1000), int, "uniform ones among them (5)"),
        ("--repeats", (0, 100), int, "walks of the chosen eta, and of each compared one (5)"),
        ("--horizon", (0.1, 600.0), float, "longest walk, s (15)"),
        ("--lease", (1.0, 86400.0), float, "silence after which a trial is lost, s (120)"),
        ("--failures", (1, 1000), int, "trials without a result until it pauses (1; --auto: 3)"),
        ("--seed", (0, 2**31 - 1), int, "of everything random (0)"),
    ):
        study.add_argument(
            name, type=number(*limits, kind), metavar="N" if kind is int else "X", help=told
        )
    study.add_argument("--agent", metavar="NAME", help="that shall run it; default: any that can")
    study.add_argument(
        "--auto", action="store_true", help="trials need no operator's release at the service"
    )
    study.add_argument(
        "--compare",
        type=numbers,
        action="append",
        default=[],
        metavar="A,B,...",
        help="an eta to compare with, such as that of the fitted parameters; may be repeated",
    )
    study.add_argument(
        "--simulated", type=Path, metavar="FILE", help="rollouts in simulation to start from"
    )
    study.add_argument(
        "--no-warm-start", action="store_true", help="keep them, but do not start from them"
    )


def _serve(verb: argparse.ArgumentParser) -> None:
    verb.add_argument(
        "action",
        nargs="?",
        choices=("run", "token", "revoke-token", "agent", "revoke-agent"),
        default="run",
        help="run the service; make or end a token, or the key of an agent; default: run",
    )
    verb.add_argument("who", nargs="?", metavar="NAME", help="of the token or agent")
    verb.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="TOML; variables PUP_DATA, PUP_HOST, PUP_PORT, PUP_LINK, ... win over it",
    )
    verb.add_argument(
        "--role",
        choices=("viewer", "operator", "admin"),
        default="viewer",
        help="of the token; default: %(default)s",
    )
    verb.add_argument("--out", metavar="DIR", help="folder for the files that go to the robot")


def _replay(verb: argparse.ArgumentParser) -> None:
    verb.add_argument(
        "recordings",
        type=Path,
        nargs="*",
        metavar="RECORDING",
        help="Parquet file, or a folder of them",
    )
    robot(verb, required=True)
    verb.add_argument(
        "--bounds",
        type=Path,
        metavar="FILE",
        help="bounds.json whose nominal values are replayed, or that a policy was trained on; "
        "default: the robot's own identified.json, without one the values of its robot.toml",
    )
    out(verb, "replay.json and a plot per recording, or of the walk and a video")
    engine(verb)
    cores(verb)
    walk = verb.add_argument_group("a policy instead of recordings")
    walk.add_argument("--policy", type=Path, metavar="DIR", help="policy of `pup train`")
    walk.add_argument(
        "--eta",
        type=numbers,
        metavar="A,B,...",
        help="what the policy is conditioned on; default: the projection of the true parameters",
    )
    walk.add_argument(
        "--episodes",
        type=number(1, 100_000),
        default=50,
        metavar="N",
        help="with parameters drawn from the bounds, for the numbers; default: %(default)s",
    )
    walk.add_argument(
        "--landscape",
        type=number(0, 4096),
        default=0,
        metavar="N",
        help="walk N etas on 16 draws of the parameters, for pup transfer --simulated",
    )
    seed(walk)


def _diagnose(verb: argparse.ArgumentParser) -> None:
    recordings(verb)
    robot(verb, required=True)
    out(verb, "diagnosis.json, report.html and corrected/, a robot with what was missing")
    verb.add_argument(
        "--rivals",
        action="store_true",
        help="also fit the paper's NN-PD and a residual network to the same recordings and judge "
        "all by motions left out; takes longer and needs PyTorch (the extra `learn`)",
    )
    seed(verb)
    place(verb)


def _import(verb: argparse.ArgumentParser) -> None:
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
    told.add_argument(
        "--setup",
        type=knob,
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
    robot(verb, required=True)
    out(verb, "a Parquet file per recording; it may hold no other recordings")
    verb.add_argument("--virtual", action="store_true", help="on a simulated robot (required)")
    seed(verb, "; also which robot it is")
    actuator(verb)
    verb.add_argument(
        "--repeats", type=number(1, 100), default=1, metavar="N", help="of each motion; default: 1"
    )
    verb.add_argument("--noiseless", action="store_true", help="perfect sensors and clock")
    verb.add_argument(
        "--truth", type=Path, metavar="FILE", help="reveal the robot's parameters in this file"
    )


def _blind(verb: argparse.ArgumentParser) -> None:
    actions = verb.add_subparsers(title="actions", required=True, dest="action", metavar="ACTION")
    for name, told, fill in (
        ("make", "make a sealed set", _blind_make),
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
        "--seed", required=True, metavar="KEY", help="any text; it tells the key, so conceal it"
    )
    out(action, "the cases and commitment.json; it may hold nothing else")
    action.add_argument(
        "--key", type=Path, required=True, metavar="FILE", help="where the truth goes; conceal it"
    )


def _blind_run(action: argparse.ArgumentParser) -> None:
    _paths(action, ("--set", "DIR", "folder of the set"))
    out(action, "run.json and, for each case, what `pup diagnose` writes but the report")
    action.add_argument(
        "--limit",
        type=number(1, 1_000_000),
        metavar="N",
        help="only the first N cases by their random ids; default: all",
    )
    place(action)


def _blind_score(action: argparse.ArgumentParser) -> None:
    _paths(
        action,
        ("--set", "DIR", "folder of the set"),
        ("--key", "FILE", "its key, revealed"),
        ("--diagnoses", "DIR", "what `pup blind run` wrote: a case_<id>/diagnosis.json each"),
        ("--out", "FILE", "where the scores go, as JSON; a table goes beside it"),
    )


def _paths(action: argparse.ArgumentParser, *wanted: tuple[str, str, str]) -> None:
    for option, metavar, told in wanted:
        action.add_argument(option, type=Path, required=True, metavar=metavar, help=told)


def _virtual_robot(verb: argparse.ArgumentParser) -> None:
    robot(verb, default=DEFAULT_ROBOT, more="; default: %(default)s")
    seed(verb, ", its physics included")
    for name, told in (
        ("--link", "where the Dynamixel bus shall be found, a link to a pseudo-terminal"),
        ("--imu", "the same for the BNO055's UART"),
        ("--side", "Unix socket for what is done by hand: reset, pose, faults"),
    ):
        verb.add_argument(name, type=Path, required=True, metavar="PATH", help=told)
    verb.add_argument(
        "--speed",
        type=number(0.0, 100.0, float),
        default=1.0,
        metavar="X",
        help="of time; 0: it stands still but for a control period per write of goals; default: 1",
    )
    verb.add_argument(
        "--period",
        type=number(0.001, 1.0, float),
        default=0.03,
        metavar="S",
        help="control period at --speed 0; default: %(default)s",
    )
    verb.add_argument(
        "--protocol",
        type=int,
        choices=(1, 2),
        default=1,
        help="of the servos' firmware: Dynamixel 1.0 or 2.0; default: 1",
    )
