"""An experiment with real processes: killed, gone on with, done again; minutes."""

import json
import os
import shutil
import signal
from pathlib import Path

import agents
import numpy as np
import pytest
from commandline import pup
from jobs import Job, until
from reports import Page

from pup.policy.shape import Method
from pup.recording import load_recordings
from pup.robot import RobotDescription
from pup.sysid.result import read_bounds

pytest.importorskip("fastapi")
pytest.importorskip("botorch")
pytest.importorskip("gymnasium")

DARWIN = RobotDescription.load("darwin_op2")
PLAN = """
schema = 1
seeds = [1000]
[[walk]]
direction = "forward"
methods = ["pup", "robust"]
robots = 1
[record]
motions = ["step:0.3", "standup:2", "fall:left"]
[presysid]
generations = 1
population = 4
subsets = 2
subset_generations = 1
fixed_network = true
compare = false
[fleet]
generations = 1
population = 4
subsets = 2
subset_generations = 1
fixed_network = true
[trials]
trials = 2
prior = 1
repeats = 1
horizon = 1.5
landscape = 2
"""


@pytest.fixture(scope="module")
def command(tmp_path_factory: pytest.TempPathFactory) -> tuple[object, ...]:
    """An experiment on policies that stand for a while, without the diagnosis."""
    folder = tmp_path_factory.mktemp("experiment")
    (folder / "plan.toml").write_text(PLAN)
    names, gait = read_bounds(DARWIN.identified_path, DARWIN).names, agents.standing()
    for method in (Method.PUP, Method.ROBUST):
        place = folder / "policies" / "forward" / method
        agents.bundle(place, gait, names, lively=True, method=method)
    robot = agents.described(folder / "darwin_op2", gait)
    given = ("--robot", robot, "--plan", folder / "plan.toml", "--policies", folder / "policies")
    return ("experiment", *given, "--stages", "record,presysid,trials,prior", "--local")


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_killed_and_gone_on_with_it_ends_as_an_undisturbed_one(
    command: tuple[object, ...], tmp_path: Path
) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    code, _, err = Job(*command, out=whole).end()
    assert code == 0, err
    for moment in (
        "cells/record-r1000/files/recordings/*.parquet",
        "cells/presysid-r1000/files/checkpoints/*.npz",
        "cells/trials-r1000-forward-pup/files/agent/recordings/*.parquet",
    ):
        job = Job(*command, out=parts)
        until(lambda m=moment, j=job: list(parts.glob(m)) or j.process.poll() is not None)
        os.kill(job.pid, signal.SIGKILL)
        assert job.end()[0] == -signal.SIGKILL
    code, printed, err = Job(*command, out=parts).end()
    assert code == 0, err
    found = [results(out) for out in (whole, parts)]
    assert found[0] == found[1] and len(found[0]) == 9
    told = json.loads(printed)["experiment"]
    assert told == json.loads((parts / "experiment.json").read_text())
    walked = told["directions"]["forward"]["walks"]
    assert walked.keys() == {"pup", "pup+fitted", "pup+prior", "robust"}
    assert all(
        0.3 < time <= 1.6 for arm in walked.values() for w in arm.values() for time in w["time"]
    )
    assert Page(parts / "report.html").tables
    recorded = load_recordings([parts / "cells" / "record-r1000" / "files" / "recordings"], DARWIN)
    by_motion = {r.motion: r for r in recorded}
    assert by_motion.keys() == {"step", "standup", "fall"}
    fall = by_motion["fall"].extras["imu/roll"]
    assert abs(fall[0]) < 0.3 and -1.6 < fall[-1] < -1.0  # to the left, and no further
    for one in recorded:
        assert np.abs(one.position[0] - one.target[0]).max() < 0.15  # it came to rest there
        assert 0.0299 < np.diff(one.time).min() < np.diff(one.time).max() < 0.041

    again = pup(*command, "--out", parts, "--cell", "trials-r1000-forward-robust", "--json").json()
    assert again["agree"], again
    fresh = tmp_path / "fresh"
    shutil.copytree(parts / "cells", fresh / "cells", ignore=shutil.ignore_patterns("record-*"))
    again = pup(*command, "--out", fresh, "--cell", "record-r1000", "--json").json()
    assert again["agree"] and set(again["results"].values()) == {
        told["cells"]["record-r1000"]["digest"]
    }


def results(out: Path) -> dict[str, str]:
    return {
        file.parents[1].name: file.read_text() for file in out.glob("cells/*/files/result.json")
    }
