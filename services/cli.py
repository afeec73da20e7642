"""The command line `pup`: parse, call, print."""

import argparse
import json
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pup.errors import InputError
from pup.robot import RobotDescription, built_in_robots

DONE, FAILED, REFUSED, STOPPED = 0, 1, 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb.

    Returns:
      0 done, 2 bad input or usage, 130 stopped by the user, 1 anything else.
    """
    parser = _parser()
    options = parser.parse_args(arguments)
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGINT))
    try:
        shown = options.verb(options)
    except InputError as error:
        print(f"pup {options.name}: {error}", file=sys.stderr)
        return REFUSED
    except KeyboardInterrupt:
        print(f"pup {options.name}: stopped; the same command resumes", file=sys.stderr)
        return STOPPED
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        print(f"pup {options.name}: {place}{error.strerror or error}", file=sys.stderr)
        return REFUSED if error.filename else FAILED
    if options.json:
        print(json.dumps(shown, allow_nan=False))
    else:
        options.show(shown)
    return DONE


def _run(options: argparse.Namespace) -> dict[str, Any]:
    from pup.recording import load_recordings
    from services.pipeline import default_recordings, run
    from services.progress import reporter

    robot = RobotDescription.load(options.robot)
    given = options.recordings
    recordings = load_recordings([given]) if given else default_recordings(robot)
    out = _folder(options.out)
    with reporter() as progress:
        stages = run(
            robot,
            recordings,
            _budget(options),
            out,
            lambda: _runner(options),
            progress,
            _cores(options),
        )
    return stages | {"report": str(out / "presysid" / "report.html")}


def _presysid(options: argparse.Namespace) -> dict[str, Any]:
    from pup.recording import load_recordings
    from services.presysid import identify
    from services.progress import reporter

    robot = RobotDescription.load(options.robot)
    recordings = load_recordings(options.recordings)
    out = _folder(options.out)
    with _runner(options) as runner, reporter() as progress:
        bounds = identify(
            robot, recordings, _budget(options), out, runner, progress, _cores(options)
        )
    return {"presysid": bounds.document(), "report": str(out / "report.html")}


def _replay(options: argparse.Namespace) -> dict[str, Any]:
    from pup.recording import load_recordings
    from services.replay import replay

    robot = RobotDescription.load(options.robot)
    recordings = load_recordings(options.recordings)
    return replay(robot, recordings, options.bounds, _folder(options.out), _cores(options))


def _import(options: argparse.Namespace) -> dict[str, Any]:
    from pup.importers import ImportOptions, import_recordings

    robot = RobotDescription.load(options.robot) if options.robot else None
    read = import_recordings(
        options.format,
        options.paths,
        robot,
        ImportOptions(
            robot=options.robot_name,
            motion=options.motion,
            support=options.support,
            source=options.source,
            setup=dict(options.setup),
            notes=options.notes,
            joints=tuple(options.joints.split(",")) if options.joints else (),
            state_topic=options.state_topic,
            command_topic=options.command_topic,
        ),
    )
    out = _folder(options.out)
    for recording in read:
        recording.write(out / f"{recording.id}.parquet")
    return {"recordings": [str(out / f"{r.id}.parquet") for r in read]}


def _record(options: argparse.Namespace) -> dict[str, Any]:
    from pup.sysid.virtual import SensorNoise, record

    if not options.virtual:
        raise InputError("only virtual robots can be recorded by now; add --virtual")
    robot = RobotDescription.load(options.robot)
    made = record(
        robot,
        options.motions,
        _folder(options.out),
        options.seed,
        actuator=options.actuator,
        noise=SensorNoise(0.0, 0.0, 0.0, 0.0) if options.noiseless else SensorNoise(),
        repeats=options.repeats,
        truth=options.truth,
    )
    return {"recordings": [str(options.out / f"{r.id}.parquet") for r in made]}


@contextmanager
def _runner(options: argparse.Namespace) -> Iterator[Any]:
    """Where fits run: this process, an embedded Ray or a cluster."""
    from workers.fits import LocalRunner, RayRunner

    if options.local:
        yield LocalRunner()
        return
    from workers.cluster import connected

    with connected(options.address, options.cores):
        yield RayRunner()


def _budget(options: argparse.Namespace) -> Any:
    from services.presysid import Options

    return Options(
        actuator=options.actuator,
        generations=options.generations,
        population=options.population,
        subsets=options.subsets,
        subset_generations=options.subset_generations,
        fraction=options.fraction,
        folds=options.folds,
        compare=not options.no_comparison,
        seed=options.seed,
    )


def _cores(options: argparse.Namespace) -> int:
    return int(options.cores or len(os.sched_getaffinity(0)))


def _folder(path: Path) -> Path:
    """A folder that can be written to; made when absent."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise InputError(f"{path}: is a file; --out needs a folder") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be made ({error.strerror})") from error
    if not os.access(path, os.W_OK):
        raise InputError(f"{path}: cannot be written to")
    return path


def _show_bounds(shown: dict[str, Any]) -> None:
    from services.tables import bounds_table

    bounds_table(shown["presysid"])
    print(f"report: {shown['report']}")


def _show_replay(shown: dict[str, Any]) -> None:
    for name, rms in shown["per_recording"].items():
        print(f"{name:24} {1e3 * rms:8.2f} mrad")
    print(f"{'all':24} {1e3 * shown['rmse']:8.2f} mrad  ({shown['model']})")


def _show_recordings(shown: dict[str, Any]) -> None:
    for path in shown["recordings"]:
        print(path)


def _number(low: float, high: float, kind: type = int) -> Callable[[str], Any]:
    """An argument type: a number within limits."""

    def parse(text: str) -> Any:
        try:
            value = kind(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(f"{text!r} is no number") from error
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text} is not between {low:g} and {high:g}")
        return value

    return parse


def _knob(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name, float(value)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not KNOB=NUMBER") from error


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="pup", description="From recordings of a legged robot to bounds of its parameters."
    )
    verbs = parser.add_subparsers(title="verbs", required=True, dest="name", metavar="VERB")
    _run_arguments(verbs.add_parser("run", help="the whole job, stage by stage, resumable"))
    _import_arguments(verbs.add_parser("import", help="other people's logs into recordings"))
    _record_arguments(verbs.add_parser("record", help="scripted motions on a virtual robot"))
    _presysid_arguments(verbs.add_parser("presysid", help="bounds of the parameters"))
    _replay_arguments(verbs.add_parser("replay", help="simulate recordings and compare"))
    return parser


def _common(parser: argparse.ArgumentParser, verb: Any, show: Any) -> None:
    parser.add_argument("--json", action="store_true", help="print one JSON object last")
    parser.set_defaults(verb=verb, show=show)


def _robot(parser: argparse.ArgumentParser, **more: Any) -> None:
    names = ", ".join(built_in_robots())
    parser.add_argument("--robot", help=f"{names}, or a robot's folder", **more)


def _run_arguments(parser: argparse.ArgumentParser) -> None:
    from services.pipeline import DEFAULT_ROBOT

    _common(parser, _run, _show_bounds)
    _robot(parser, default=DEFAULT_ROBOT)
    parser.add_argument(
        "--recordings", type=Path, help="folder of recordings; default: those of the robot"
    )
    parser.add_argument("--out", type=Path, required=True)
    _budget_arguments(parser, generations=150, subset_generations=40)


def _presysid_arguments(parser: argparse.ArgumentParser) -> None:
    _common(parser, _presysid, _show_bounds)
    parser.add_argument("recordings", type=Path, nargs="+", metavar="RECORDING")
    _robot(parser, required=True)
    parser.add_argument("--out", type=Path, required=True)
    _budget_arguments(parser, generations=500, subset_generations=100)


def _budget_arguments(
    parser: argparse.ArgumentParser, generations: int, subset_generations: int
) -> None:
    budget = parser.add_argument_group("budget")
    many = _number(1, 100_000)
    budget.add_argument("--actuator", choices=("nn_pd", "pd"), default="nn_pd")
    budget.add_argument("--generations", type=many, default=generations)
    budget.add_argument("--population", type=_number(4, 4096), default=16)
    budget.add_argument("--subsets", type=_number(1, 1000), default=10)
    budget.add_argument("--subset-generations", type=many, default=subset_generations)
    budget.add_argument(
        "--fraction", type=_number(0.0, 1.0, float), default=0.1, help="of recordings in a subset"
    )
    budget.add_argument(
        "--folds", type=_number(0, 100), default=0, help="leave-recordings-out fits"
    )
    budget.add_argument(
        "--no-comparison", action="store_true", help="do not fit the other actuator"
    )
    budget.add_argument("--seed", type=_number(0, 2**31), default=0)
    place = parser.add_argument_group("where it runs")
    where = place.add_mutually_exclusive_group()
    where.add_argument("--address", help="of a running Ray cluster; default: an embedded Ray")
    where.add_argument("--local", action="store_true", help="this process alone, no Ray")
    _cores_argument(place)


def _cores_argument(parser: Any) -> None:
    parser.add_argument("--cores", type=_number(1, 4096), help="default: all")


def _replay_arguments(parser: argparse.ArgumentParser) -> None:
    _common(parser, _replay, _show_replay)
    parser.add_argument("recordings", type=Path, nargs="+", metavar="RECORDING")
    _robot(parser, required=True)
    parser.add_argument("--bounds", type=Path, help="default: the robot's identified.json")
    parser.add_argument("--out", type=Path, required=True)
    _cores_argument(parser)


def _import_arguments(parser: argparse.ArgumentParser) -> None:
    _common(parser, _import, _show_recordings)
    parser.add_argument(
        "format", metavar="FORMAT", help="csv, mcap, npz, bam, sage, emps, darwin-hardware"
    )
    parser.add_argument("paths", type=Path, nargs="+", metavar="PATH")
    parser.add_argument("--out", type=Path, required=True)
    told = parser.add_argument_group("what the logs do not say")
    _robot(told)
    told.add_argument("--robot-name", help="name of a robot without a description")
    told.add_argument("--motion", help="motion type, such as step, hold or walk")
    told.add_argument("--support", choices=("suspended", "ground", "bench"))
    told.add_argument("--source", choices=("hardware", "simulation", "unknown"))
    told.add_argument("--setup", type=_knob, nargs="*", default=[], metavar="KNOB=NUMBER")
    told.add_argument("--notes", default="")
    told.add_argument("--joints", help="names in column order, separated by commas")
    told.add_argument("--state-topic", help="MCAP topic of the readings")
    told.add_argument("--command-topic", help="MCAP topic of the commands")


def _record_arguments(parser: argparse.ArgumentParser) -> None:
    _common(parser, _record, _show_recordings)
    parser.add_argument(
        "motions",
        nargs="+",
        metavar="MOTION",
        help="step, standup, fall, hold, chirp, triangle, or a variant such as step:0.3",
    )
    _robot(parser, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--virtual", action="store_true", help="on a simulated robot")
    parser.add_argument("--seed", type=_number(0, 2**31), default=0)
    parser.add_argument("--actuator", choices=("nn_pd", "pd"), default="nn_pd")
    parser.add_argument("--repeats", type=_number(1, 100), default=1)
    parser.add_argument("--noiseless", action="store_true")
    parser.add_argument("--truth", type=Path, help="file to reveal the parameters in")


if __name__ == "__main__":
    sys.exit(main())
