"""What each verb of the command line does: options in, what it prints out.

Imports of what takes long stand inside the verbs: `pup --help` needs none of it.
"""

import argparse
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pup.errors import InputError, how_to_install
from pup.robot import RobotDescription
from services import places
from services.held import held
from services.options import knobs


def _run(options: argparse.Namespace) -> dict[str, Any]:
    _quiet_torch()
    from pup.recording import load_recordings
    from pup.sysid.accuracy import JointUnits
    from services.mission import FURTHER, GENERATIONS, Means, Mission, default_recordings
    from services.pipeline import run
    from services.progress import reporter, stages, trained
    from workers.cluster import staying

    robot = RobotDescription.load(options.robot)
    given = options.recordings
    recordings = load_recordings([given], robot) if given else default_recordings(robot)
    known = options.start
    law = options.actuator or robot.actuator
    if known is None and not options.as_described and _identified(robot) == law:
        known = robot.identified_path
    if options.generations is None:
        options.generations = GENERATIONS if known is None else FURTHER
    budget = replace(_budget(options, robot), start=known)
    mission = Mission(
        budget,
        options.train_steps,
        options.trials,
        options.least_gain,
        options.repeats,
        options.effects,
    )
    means = Means(
        lambda: places.fits(options),
        lambda: places.replays(options),
        lambda: places.training(options),
        reporter,
        stages,
        trained,
        _tell,
        places.cores(options),
    )
    with _folder(options.out) as out, held(out), staying():
        done = run(robot, recordings, mission, out, means)
    return done | {
        "report": str(out / "report.html"),
        "unit": JointUnits.of(robot, recordings).position,
    }


def _presysid(options: argparse.Namespace) -> dict[str, Any]:
    from pup.recording import load_recordings
    from pup.sysid.accuracy import JointUnits
    from services.presysid import identify
    from services.progress import reporter

    robot = RobotDescription.load(options.robot)
    recordings = load_recordings(options.recordings, robot)
    wanted, cores = _budget(options, robot), places.cores(options)
    with _folder(options.out) as out, held(out), places.fits(options) as runner, reporter() as told:
        bounds = identify(robot, recordings, wanted, out, runner, told, cores)
    return {
        "presysid": bounds.document(),
        "report": str(out / "report.html"),
        "unit": JointUnits.of(robot, recordings).position,
    }


def _train(options: argparse.Namespace) -> dict[str, Any]:
    if find_spec("torch") is None or find_spec("gymnasium") is None:
        raise InputError(f"training needs PyTorch and RLlib; {how_to_install('learn')}")
    _quiet_torch()
    from services.progress import stages, trained
    from services.tracking import check
    from services.training import train
    from services.training_options import training_options

    check(tuple(options.track))
    robot = RobotDescription.load(options.robot)
    wanted = training_options(options)
    with _folder(options.out) as out, held(out), trained() as told, stages() as said:
        ray = partial(places.training, options)
        return train(robot, options.bounds, wanted, out, ray, told, said)


def _quiet_torch() -> None:
    """Torch's threads sleep while they wait: spinning takes the cores from the simulations."""
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def _transfer(options: argparse.Namespace) -> dict[str, Any]:
    _service()
    from services import transfer

    simulated = transfer.read_simulated(options.simulated) if options.simulated else None
    wanted = transfer.Wanted(
        options.policy,
        options.study,
        options.url,
        transfer.token_of(options.token_file),
        transfer.settings_of(options),
        simulated,
    )
    with _folder(options.out) as out:
        return transfer.transfer(wanted, out, lambda line: print(line, file=sys.stderr, flush=True))


def _submit(options: argparse.Namespace) -> dict[str, Any]:
    _service()
    from services.submit import submit

    return submit(options)


def _jobs(options: argparse.Namespace) -> dict[str, Any]:
    _service()
    from services.submit import jobs

    if options.action != "fetch":
        return jobs(options)
    with _folder(options.out):
        return jobs(options)


def _serve(options: argparse.Namespace) -> dict[str, Any]:
    _service()
    from services.gateway import verb

    return verb.serve(options)


def _service() -> None:
    wanted = ("fastapi", "uvicorn", "sqlalchemy", "alembic", "botorch", "httpx")
    if missing := [name for name in wanted if find_spec(name) is None]:
        raise InputError(f"the service needs {missing[0]}; {how_to_install('service')}")


def _replay(options: argparse.Namespace) -> dict[str, Any]:
    if bool(options.recordings) == bool(options.policy):
        raise InputError("give either recordings or --policy DIR")
    if options.study and not options.policy:
        raise InputError("--study needs the policy that walked; give it with --policy DIR")
    if options.policy and options.engine != "mujoco":
        raise InputError(f"--engine {options.engine} replays recordings; a policy walks in mujoco")
    if options.policy:
        return _walk(options)
    from pup.physics.engine import Engine
    from pup.recording import load_recordings
    from services.replay import replay

    robot = RobotDescription.load(options.robot)
    recordings = load_recordings(options.recordings, robot)
    with _folder(options.out) as out:
        cores, engine = places.cores(options), Engine(options.engine)
        return replay(robot, recordings, options.bounds, out, cores, engine)


def _walk(options: argparse.Namespace) -> dict[str, Any]:
    from services.walk import Shown, walk

    robot = RobotDescription.load(options.robot)
    if options.study:
        return _rehearse(robot, options)
    if options.rate is not None and not options.landscape:
        raise InputError("--rate is that of --landscape and --study; give one of them too")
    shown = Shown(
        options.policy,
        options.bounds,
        options.eta,
        options.episodes,
        options.landscape,
        options.seed,
        options.rate,
    )
    with _folder(options.out) as out:
        return walk(robot, shown, out, places.cores(options))


def _rehearse(robot: RobotDescription, options: argparse.Namespace) -> dict[str, Any]:
    from services.rehearsal import rehearse

    if options.eta is not None or options.landscape:
        raise InputError("--study walks the etas of its trials; leave out --eta and --landscape")
    bounds, cores = options.bounds or robot.identified_path, places.cores(options)
    given = options.policy, bounds, options.study
    with _folder(options.out) as out:
        return rehearse(robot, *given, out, options.seed, cores, options.rate)


def _diagnose(options: argparse.Namespace) -> dict[str, Any]:
    from pup.recording import load_recordings
    from pup.recording_cuts import beginning
    from services.diagnosis import run_diagnosis
    from services.progress import stages

    if options.rivals and find_spec("torch") is None:
        raise InputError(
            "--rivals needs PyTorch, which is not installed; leave it out or, "
            f"{how_to_install('learn')}"
        )
    robot = RobotDescription.load(options.robot)
    recordings = load_recordings(options.recordings, robot)
    if options.seconds is not None:
        recordings = [beginning(recording, options.seconds) for recording in recordings]
    wanted = {"seed": options.seed, "rivals": options.rivals, "effects": options.effects}
    with _folder(options.out) as out, held(out), places.replays(options) as where, stages() as told:
        return run_diagnosis(robot, recordings, out, where, told, **wanted)


def _import(options: argparse.Namespace) -> dict[str, Any]:
    from pup import importers

    robot = RobotDescription.load(options.robot) if options.robot else None
    read = importers.import_recordings(
        options.format,
        options.paths,
        robot,
        importers.ImportOptions(
            robot=options.robot_name,
            motion=options.motion,
            support=options.support,
            source=options.source,
            repeat_of=options.repeat_of,
            setup=knobs(options.setup),
            notes=options.notes,
            joints=tuple(map(str.strip, options.joints.split(","))) if options.joints else (),
            state_topic=options.state_topic,
            command_topic=options.command_topic,
        ),
    )
    with _folder(options.out) as out:
        files = importers.write_imported(read, out)
        for one in importers.unknown_repeats(read, out):
            _tell(f"warning: {one.id!r} repeats {one.repeat_of!r}, which is not in {out}")
        for folder in importers.overlooked(options.format, options.paths):
            _tell(f"warning: {folder} holds logs too, which are not imported; name it as well")
        return {"recordings": [str(file) for file in files]}


def _describe(options: argparse.Namespace) -> dict[str, Any]:
    from pup.drafting.draft import draft_robot

    with _folder(options.out) as out:
        drafted = draft_robot(options.model, out, options.called, options.free)
    robot = drafted.robot
    return {
        "robot": robot.name,
        "folder": str(options.out),
        "joints": list(robot.joint_names),
        "groups": list(robot.groups),
        "notes": list(drafted.notes),
    }


def _export(options: argparse.Namespace) -> dict[str, Any]:
    from services.export import export

    if options.bounds and not options.robot:
        raise InputError("--bounds needs --robot, which is simulated; give both or none")
    robot = RobotDescription.load(options.robot) if options.robot else None
    wanted = options.format, options.recordings, robot, options.bounds, options.fps
    with _folder(options.out) as out:
        return export(*wanted, out, places.cores(options))


def _record(options: argparse.Namespace) -> dict[str, Any]:
    from services.record import scripted, virtual

    robot = RobotDescription.load(options.robot)
    truth = options.truth
    if truth is not None and truth.is_dir():
        raise InputError(f"{truth}: is a folder; --truth needs a file")
    with _folder(options.out) as out, _folder(truth.parent if truth else out):
        return (scripted if options.scripts else virtual)(options, robot, out)


def _blind(options: argparse.Namespace) -> dict[str, Any]:
    from services import blind

    with _folder(blind.folder_of(options)):
        return blind.ACTIONS[options.action](options)


def _experiment(options: argparse.Namespace) -> dict[str, Any]:
    _service()
    if find_spec("torch") is None or find_spec("gymnasium") is None:
        raise InputError(
            f"the experiment trains policies with PyTorch and RLlib; {how_to_install('learn')}"
        )
    from services.experiment import verb

    with _folder(options.out) as out:
        return verb.run(options, out)


def _virtual_robot(options: argparse.Namespace) -> dict[str, Any]:
    from services.virtual_robot import Wanted, serve

    given = ("seed", "protocol", "speed", "period", "link", "imu", "side")
    wanted = Wanted.of(**{name: getattr(options, name) for name in given})
    return serve(RobotDescription.load(options.robot), wanted, _tell)


def _tell(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _budget(options: argparse.Namespace, robot: RobotDescription) -> Any:
    from services.presysid_options import Options

    return Options(
        actuator=options.actuator or robot.actuator,
        generations=options.generations,
        population=options.population,
        subsets=options.subsets,
        subset_generations=options.subset_generations,
        fraction=options.fraction,
        folds=options.folds,
        compare=options.comparison,
        fixed_network=options.fixed_network,
        seed=options.seed,
        start=options.start,
        as_described=options.as_described,
        fitted_to=tuple(options.fitted_to.split(",")) if options.fitted_to else (),
        imu=options.imu,
    )


def _identified(robot: RobotDescription) -> str | None:
    """The torque law of a robot's own fit, where it has one."""
    from pup.sysid.result import read_fitted

    return read_fitted(robot.identified_path, robot)[0] if robot.identified_path.is_file() else None


@contextmanager
def _folder(path: Path) -> Iterator[Path]:
    """A folder that can be written to; made when absent, and gone again if nothing came of it."""
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise InputError(f"{path}: there is a file in its place; use another folder") from error
    except OSError as error:
        raise InputError(
            f"{path}: cannot be made ({error.strerror}); use another folder"
        ) from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise InputError(f"{path}: cannot be written to; use another folder or change its rights")
    try:
        yield path
    finally:
        with suppress(OSError):  # some are not empty
            for folder in made:
                folder.rmdir()


VERBS: dict[str, Callable[[argparse.Namespace], dict[str, Any]]] = {
    "run": _run,
    "describe": _describe,
    "import": _import,
    "export": _export,
    "record": _record,
    "presysid": _presysid,
    "train": _train,
    "transfer": _transfer,
    "submit": _submit,
    "jobs": _jobs,
    "serve": _serve,
    "replay": _replay,
    "diagnose": _diagnose,
    "blind": _blind,
    "experiment": _experiment,
    "virtual-robot": _virtual_robot,
}
