"""What jobs of all kinds left in shared storage, and recordings: for the pages that show them.

Bounds, reports and the diagnosis of poor recordings are those of the real verbs; the diagnosis of a
mismatch is a real document of made-up numbers, and so is the curve, whose verb needs a Ray.
"""

import asyncio
import json
import math
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import stored_jobs
from blind_sets import poor
from commandline import TINY, pup
from diagnoses import Maker

from pup.diagnosis.document import document
from pup.diagnosis.report import write_report
from pup.files import write_json
from pup.physics.terms import Place
from pup.recording import Recording, write_recordings
from pup.robot import RobotDescription
from services.gateway.jobs import Job, JobState
from services.gateway.store import Store
from services.job_folder import Order, folder_of

SHIPPED = RobotDescription.load("darwin_op2").folder / "recordings"
SCRIPT = "<script>document.title='taken'</script>"


@dataclass(frozen=True)
class Lab:
    """Where everything is."""

    data: Path
    shared: Path

    @property
    def recordings(self) -> Path:
        return self.shared / "recordings"

    def out(self, job: str) -> Path:
        return folder_of(self.shared, f"job-{job}").out


def job(name: str, verb: str, state: JobState = JobState.SUCCEEDED) -> Job:
    return replace(stored_jobs.of(name, state), verb=verb)


JOBS = (
    job("fit", "presysid"),
    job("mission", "run"),
    job("torn", "presysid", JobState.FAILED),
    job("begun", "presysid", JobState.RUNNING),
    job("walker", "train"),
    job("learner", "train", JobState.RUNNING),
    job("sick", "diagnose"),
    job("short", "diagnose"),
)


def curve(iterations: int, steps: int = 1_000_000) -> dict[str, Any]:
    """A document of `training.json` after some iterations of 1000 steps."""
    rows = range(1, iterations + 1)
    return {
        "schema": 1,
        "robot": "darwin_op2",
        "method": "pup",
        "direction": "forward",
        "done": iterations * 1000 >= steps,
        "steps": iterations * 1000,
        "lost_steps": 0,
        "seconds": 2.0 * iterations,
        "curve": {
            "steps": [1000 * i for i in rows],
            "return": [None if i == 1 else 10.0 * math.log(i) for i in rows],
            "distance": [None if i == 1 else 0.01 * i for i in rows],
            "time": [None if i == 1 else 5 - 4 / i for i in rows],
        },
        "provenance": {"options": {"steps": steps}},
    }


def currents() -> Recording:
    """A servo at 100 Hz whose current is read every other tick, with a pause of its encoder."""
    time = 0.01 * np.arange(600)
    target = 0.4 * np.sign(np.sin(2 * time))
    position = np.convolve(target, np.ones(12) / 12, "same")
    current = np.where(np.arange(600) % 2, np.nan, 0.2 + abs(target - position))
    position[300:380] = np.nan
    return Recording(
        id="currents",
        robot="servo_bench",
        motion="step",
        support="bench",
        source="hardware",
        joints=("servo",),
        time=time,
        target=target[:, None],
        position=position[:, None],
        extras={"current/servo": current},
        setup={"mass": 0.5},
        notes=f"a new gear {SCRIPT}",
    )


def keep(folder: Path, runs: Path) -> Lab:
    """Write everything, before the gateway starts.

    Args:
      folder: to write to.
      runs: recordings of a servo_bench, for the real verbs.
    """
    lab = Lab(folder / "data", folder / "shared")
    lab.data.mkdir(parents=True)
    _store(lab, JOBS)
    _fit(lab, runs)
    _diagnose(lab, folder)
    (lab.out("torn")).mkdir()
    (lab.out("torn") / "bounds.json").write_text('{"schema": 1, "robot": "darwin_op2", "para')
    for name, iterations in (("walker", 1000), ("learner", 20), ("mission/train", 30)):
        base, _, stage = name.partition("/")
        write_json(lab.out(base) / stage / "training.json", curve(iterations))
    _recordings(lab)
    return lab


def _store(lab: Lab, jobs: Sequence[Job]) -> None:
    store = Store(f"sqlite:///{lab.data.absolute() / 'gateway.db'}")
    for one in jobs:
        asyncio.run(store.write_job(one))
        place = folder_of(lab.shared, one.id)
        place.write_order(Order(one.id, 1, False, False, [one.verb, *one.arguments]))
        place.claim(1)
        place.log.write_text("training: 2%, 0.02 of 1.00 M steps\n")
    store.close()


def _fit(lab: Lab, runs: Path) -> None:
    out = lab.out("fit")
    done = pup("presysid", runs, "--robot", "servo_bench", *TINY, "--out", out)
    assert done.code == 0, done.err
    stage = lab.out("mission") / "presysid"
    shutil.copytree(out, stage)
    link = '<p><a id="stage" href="presysid/report.html">bounds</a></p>'
    hostile = "<script>document.title='taken'</script><form action='/logout' method='post'></form>"
    (lab.out("mission") / "report.html").write_text(
        f"<!doctype html><title>mission</title><h1>Job</h1>{link}{hostile}"
        "<p><a href='run.json' id='file'>journal</a></p>"
    )
    (lab.out("mission") / "run.json").write_text("{}")


def _diagnose(lab: Lab, folder: Path) -> None:
    write_recordings(poor(3), folder / "poor")
    told = ("--robot", "servo_bench", "--local", "--cores", 1, "--out", lab.out("short"))
    done = pup("diagnose", folder / "poor", *told)
    assert done.code == 0, done.err
    found = Maker(RobotDescription.load("servo_bench")).missing("backlash", Place("joint", "servo"))
    write_json(lab.out("sick") / "diagnosis.json", document(found, "corrected"))
    write_report(found, lab.out("sick") / "report.html", {})


def _recordings(lab: Lab) -> None:
    shutil.copytree(SHIPPED, lab.recordings)
    currents().write(lab.recordings / "bench" / "currents.parquet")
    (lab.recordings / "torn.parquet").write_bytes(b"PAR1 and nothing more")
    secret = lab.data / "secret.parquet"
    currents().write(secret)
    (lab.recordings / "link.parquet").symlink_to(secret)
    shutil.copy(SHIPPED / "fall_left.parquet", lab.data / "sent.parquet")
    robots = lab.data / "recordings" / "op-1"
    robots.mkdir(parents=True)
    (lab.data / "sent.parquet").rename(robots / "walk_7.parquet")


def grow(lab: Lab, iterations: int) -> None:
    """Let the training under way come on."""
    write_json(lab.out("learner") / "training.json", curve(iterations))
    with open(folder_of(lab.shared, "job-learner").log, "a") as log:
        print(f"training: {iterations / 10:.0f}%", file=log)


def as_json(path: Path, **changed: Any) -> None:
    """Write a JSON document again with other values."""
    path.write_text(json.dumps(json.loads(path.read_text()) | changed))
