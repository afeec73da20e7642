"""Options that several verbs share, and what can be written behind them."""

import argparse
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from pup.errors import InputError
from pup.robot import built_in_robots


def recordings(verb: argparse.ArgumentParser) -> None:
    """What is read."""
    verb.add_argument(
        "recordings",
        type=Path,
        nargs="+",
        metavar="RECORDING",
        help="Parquet file, or a folder of them",
    )


def robot(to: Any, more: str = "", **options: Any) -> None:
    """Whose recordings they are."""
    names = ", ".join(built_in_robots())
    to.add_argument("--robot", help=f"{names}, or a robot's folder{more}", **options)


def robot_or_darwin(verb: argparse.ArgumentParser) -> None:
    """Which robot, where there is a usual one."""
    robot(verb, default="darwin_op2", more="; default: %(default)s")


def out(verb: argparse.ArgumentParser, what: str) -> None:
    """Where files go."""
    verb.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="DIR",
        help=f"folder for {what}; made when absent",
    )


def actuator(to: Any) -> None:
    """Which torque law."""
    to.add_argument(
        "--actuator",
        choices=("nn_pd", "pd"),
        help="torque law; default: nn_pd where the robot has a network, else pd",
    )


def engine(to: Any) -> None:
    """What simulates."""
    to.add_argument(
        "--engine",
        choices=("mujoco", "brax"),
        default="mujoco",
        help="what simulates; brax is JAX with Brax's MJX pipeline, for accelerators, and needs "
        "the extra `brax`; default: %(default)s",
    )


def seed(to: Any, more: str = "") -> None:
    """What is drawn."""
    to.add_argument(
        "--seed",
        type=number(0, 2**31),
        default=0,
        metavar="N",
        help=f"of everything random{more}; default: %(default)s",
    )


def budget(
    verb: argparse.ArgumentParser,
    generations: int | None,
    subset_generations: int,
    comparison: bool,
    start: str = "values of robot.toml",
    usual: str = "%(default)s",
) -> None:
    """How much pre-sysID does, and in words where it begins and its `usual` generations."""
    budget = verb.add_argument_group("what is fitted, and how long")
    actuator(budget)
    for name, limits, default, told in (
        ("--generations", (1, 100_000), generations, f"of each nominal fit; default: {usual}"),
        ("--population", (4, 4096), 16, "candidates per generation; default: %(default)s"),
        ("--subsets", (1, 1000), 10, "random subsets for the bounds; default: %(default)s"),
        (
            "--subset-generations",
            (1, 100_000),
            subset_generations,
            "of each subset's fit; default: %(default)s",
        ),
        ("--folds", (0, 100), 0, "leave-recordings-out fits for a held-out error; default: none"),
    ):
        budget.add_argument(name, type=number(*limits), default=default, metavar="N", help=told)
    budget.add_argument(
        "--fraction",
        type=number(0.0, 1.0, float),
        default=0.1,
        metavar="F",
        help="share of the recordings in a subset, at least two; default: %(default)s",
    )
    budget.add_argument(
        "--comparison",
        action=argparse.BooleanOptionalAction,
        default=comparison,
        help="fit the other torque law too; default: %(default)s",
    )
    budget.add_argument(
        "--fixed-network", action="store_true", help="keep the robot's network weights"
    )
    budget.add_argument(
        "--imu",
        action="store_true",
        help="fit how the IMU sits and how late it tells beside the model",
    )
    budget.add_argument(
        "--start",
        type=Path,
        metavar="FILE",
        help=f"bounds.json or identified.json where the nominal fit begins; default: {start}",
    )
    budget.add_argument(
        "--as-described",
        action="store_true",
        help="keep the values that a diagnosis fits (kp, kd, tau_max, armature, ground_friction) "
        "as robot.toml has them, fit the others, and look for the bounds around both",
    )
    budget.add_argument(
        "--fitted-to",
        metavar="MOTION,...",
        help="types of motion that were diagnosed: what these cannot see, such as the floor where "
        "the robot hung, is fitted too; default: all",
    )
    seed(budget)


def place(verb: argparse.ArgumentParser) -> None:
    """Where a job runs."""
    place = verb.add_argument_group("where it runs")
    where = place.add_mutually_exclusive_group()
    where.add_argument("--address", help="of a running Ray cluster; default: an embedded Ray")
    where.add_argument("--local", action="store_true", help="in this process alone, without Ray")
    cores(place)


def cores(to: Any) -> None:
    """How many cores it takes."""
    to.add_argument("--cores", type=number(1, 4096), metavar="N", help="cores to use; default: all")


def service(verb: argparse.ArgumentParser) -> None:
    """Whom to ask."""
    where = verb.add_argument_group("the service")
    where.add_argument(
        "--url", default="http://127.0.0.1:8470", help="of `pup serve`; default: %(default)s"
    )
    where.add_argument(
        "--token-file", metavar="FILE", help="with an operator's token; default: PUP_TOKEN"
    )


def number(low: float, high: float, kind: type = int) -> Callable[[str], Any]:
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


def numbers(text: str) -> tuple[float, ...]:
    """An argument type: numbers between commas."""
    try:
        told = tuple(float(part) for part in text.split(","))
    except ValueError:
        told = ()
    if not told or not all(map(math.isfinite, told)):
        raise argparse.ArgumentTypeError(f"{text!r} is not A,B,..., numbers between commas")
    return told


def knob(text: str) -> tuple[str, float]:
    """An argument type: what a knob is set to."""
    name, _, value = text.partition("=")
    try:
        number = float(value)
    except ValueError:
        name = ""
    if not name:
        raise argparse.ArgumentTypeError(f"{text!r} is not KNOB=NUMBER")
    return name, number


def knobs(given: Sequence[tuple[str, float]]) -> dict[str, float]:
    """The knobs of --setup, each once."""
    setup: dict[str, float] = {}
    for name, value in given:
        if name in setup:
            raise InputError(
                f"--setup: {name} is given twice, {setup[name]:g} and {value:g}; give it once"
            )
        setup[name] = value
    return setup


def count(text: str) -> tuple[str, int]:
    """An argument type: how many cases of a robot."""
    name, _, value = text.rpartition("=")
    if not name or not value.isdecimal() or not 0 <= int(value) <= 10_000:
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=COUNT, with 0 to 10000 cases")
    return name, int(value)
