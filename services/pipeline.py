"""`pup run`: the whole job, stage by stage, each a call a user could make alone."""

import hashlib
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pup.errors import InputError
from pup.files import read_json, write_json
from pup.recording import Recording, load_recordings
from pup.robot import RobotDescription
from services.presysid import Options, Progress, identify
from services.replay import replay
from workers.fits import Runner

SHIPPED = "recordings"
"""Folder of a built-in robot with recordings of our own, from a concealed virtual robot."""


@dataclass(frozen=True)
class Stage:
    """A step of the job.

    Attributes:
      name: of the step.
      inputs: identifies everything its result depends on.
      files: what it leaves behind, relative to the job's folder.
      work: does it and returns what the summary shows of it.
    """

    name: str
    inputs: str
    files: tuple[str, ...]
    work: Callable[[], dict[str, Any]]


def run(
    robot: RobotDescription,
    recordings: Sequence[Recording],
    options: Options,
    out: Path,
    runner: Callable[[], AbstractContextManager[Runner]],
    progress: Progress,
    threads: int,
) -> dict[str, Any]:
    """Run the job; stages whose inputs and files have not changed since are kept.

    Args:
      robot: the robot.
      recordings: of that robot.
      options: budget of pre-sysID.
      out: folder of the job; a stage that was interrupted resumes in it.
      runner: opens where fits run, for a stage that needs it.
      progress: told how far a stage is.
      threads: cores for what runs in this process.

    Returns:
      What each stage had to show.
    """
    digests = [robot.digest, *(r.digest for r in recordings)]

    def presysid() -> dict[str, Any]:
        with runner() as fits:
            bounds = identify(robot, recordings, options, out / "presysid", fits, progress, threads)
        return bounds.document()

    def replayed() -> dict[str, Any]:
        return replay(robot, recordings, out / "presysid" / "bounds.json", out / "replay", threads)

    stages = (
        Stage(
            "presysid",
            _digest([*digests, repr(sorted(asdict(options).items()))]),
            ("presysid/bounds.json", "presysid/report.html"),
            presysid,
        ),
        Stage(
            "replay",
            _digest([*digests, repr(sorted(asdict(options).items())), "replay"]),
            ("replay/replay.json",),
            replayed,
        ),
    )
    return {stage.name: _once(stage, out) for stage in stages}


def _digest(parts: Sequence[str]) -> str:
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _once(stage: Stage, out: Path) -> dict[str, Any]:
    """Do a stage, or take what an earlier run left of it."""
    journal = out / "run.json"
    done = read_json(journal) if journal.exists() else {"schema": 1, "stages": {}}
    if not isinstance(done, dict) or not isinstance(done.get("stages"), dict):
        raise InputError(f"{journal}: not the journal of a job; use another --out")
    entry = done["stages"].get(stage.name)
    known = {"inputs": stage.inputs, "files": _files(stage, out)}
    if isinstance(entry, dict) and {k: entry.get(k) for k in known} == known:
        return dict(read_json(out / stage.files[0]))
    begin = time.time()
    shown = stage.work()
    done["stages"][stage.name] = {
        "inputs": stage.inputs,
        "seconds": round(time.time() - begin, 1),
        "files": _files(stage, out),
    }
    write_json(journal, done)
    return shown


def _files(stage: Stage, out: Path) -> dict[str, str]:
    """SHA-256 of those of a stage's files that are there."""
    there = [file for file in stage.files if (out / file).is_file()]
    return {file: hashlib.sha256((out / file).read_bytes()).hexdigest() for file in there}


def default_recordings(robot: RobotDescription) -> tuple[Recording, ...]:
    """The recordings that come with a robot.

    Raises:
      InputError: none come with it.
    """
    folder = robot.folder / SHIPPED
    if not folder.is_dir():
        raise InputError(
            f"robot {robot.name!r} comes without recordings; give some with --recordings DIR"
        )
    return load_recordings([folder], robot)
