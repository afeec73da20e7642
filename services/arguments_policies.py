"""What can be written behind the verbs that train, walk and transfer policies."""

import argparse
from pathlib import Path

from services.options import (
    cores,
    engine,
    number,
    numbers,
    out,
    robot,
    robot_or_darwin,
    seed,
    service,
)

TRAINING = (
    ("--steps", (1000, 10**11), int, 3_000_000, "control steps of all simulations together"),
    ("--simulations", (1, 65536), int, 256, "at once, of each process that simulates"),
    ("--length", (2, 4096), int, 80, "control steps of each simulation between two updates"),
    ("--epochs", (1, 100), int, 5, "passes over the samples of an update"),
    ("--minibatch", (16, 2**20), int, 256, "samples of a gradient step"),
    ("--entropy", (0.0, 10.0), float, 0.0, "weight of exploration, falling to 0"),
    ("--mirror", (0.0, 1000.0), float, 1.0, "weight of left-right symmetry; never sideways"),
)
"""Numbers of a training: option, limits, kind, default and what it is."""


def train(verb: argparse.ArgumentParser) -> None:
    """What is trained, and where."""
    robot_or_darwin(verb)
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
        "--pattern",
        type=number(0, 10_000),
        metavar="N",
        help="generations of the search for a gait pattern, which a policy from scratch is shown "
        "before it explores; 0: none, as the paper; default: 120",
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
        "--learning-rate",
        type=number(1e-7, 1.0, float),
        metavar="X",
        help="at the beginning; default: 1e-4 for a policy that walks already, by --pattern or "
        "--start, else 3e-4",
    )
    policy.add_argument(
        "--sharpen",
        type=number(0.1, 10.0, float),
        metavar="X",
        help="by which exploration falls besides what is learnt; default: 2.5 from scratch, else 1",
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


def replay(verb: argparse.ArgumentParser) -> None:
    """What is simulated."""
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
    walk.add_argument(
        "--study",
        type=Path,
        metavar="FILE",
        help="study.json of pup transfer: make the walks of its trials again in simulation "
        "instead, and compare; writes rehearsal.json and rehearsal.png",
    )
    walk.add_argument(
        "--rate",
        type=number(1.0, 500.0, float),
        metavar="HZ",
        help="control rate of --landscape and --study, that of the robot's agent; default: that of "
        "the study's recordings, where they lie beside it in agent/recordings/, else the fastest "
        "that the policy was trained for, such as an agent's 33",
    )
    seed(walk)


def transfer(verb: argparse.ArgumentParser) -> None:
    """Which study, where."""
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
    service(verb)
    study = verb.add_argument_group("the study, where it is made; defaults are the service's")
    for name, limits, kind, told in (
        ("--trials", (1, 1000), int, "walks until eta is chosen (25)"),
        ("--initial", (1, 1000), int, "uniform ones among them (5, or all)"),
        ("--least-gain", (0.0, 0.99), float, "expected of a walk, of the best's distance (0)"),
        ("--repeats", (0, 100), int, "walks of the chosen eta, and of each compared one (5)"),
        ("--horizon", (0.1, 600.0), float, "longest walk, s (15)"),
        ("--lease", (1.0, 86400.0), float, "silence after which a trial is lost, s (120)"),
        ("--failures", (1, 1000), int, "trials without a result until it pauses (1; --auto: 3)"),
        ("--seed", (0, 2**31 - 1), int, "of everything random (0)"),
    ):
        study.add_argument(
            name, type=number(*limits, kind), metavar="N" if kind is int else "X", help=told
        )
    study.add_argument(
        "--agent", metavar="NAME", help="that shall run it; default: the first that can"
    )
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


def serve(verb: argparse.ArgumentParser) -> None:
    """Service and keys."""
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


def virtual_robot(verb: argparse.ArgumentParser) -> None:
    """Which robot, and where it is found."""
    robot_or_darwin(verb)
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
