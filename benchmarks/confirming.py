"""What walking the best eta once more is worth, on the concealed robots of an experiment.

Of each study of `pup experiment` the first walks are taken as they were; the last ones are of the
best so far, made by the same robot without its bus (`hardware_agent.virtual.walks`). What is then
chosen, and what was chosen by a search to the end, walk on with the same noise.

    python -m benchmarks.confirming experiment/cells/trials-r10*-forward-pup --again 0 3 6
"""

import argparse
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.post_sysid import Grid
from pup.files import read_json
from pup.policy.bundle import NumpyPolicy
from pup.robot import RobotDescription
from pup.transfer.optimizer import Search, choose

Array = NDArray[np.float64]

FIRST_AGAIN, FIRST_JUDGED = 50, 100
"""Draws of noise: of walks that make sure, and of those that judge."""


def searched(study: dict[str, Any]) -> Search:
    """What a study was told before it chose."""
    told = [t for t in study["trials"] if t["purpose"] in ("initial", "search")]
    settings = study["settings"]
    return Search(
        tuple(settings["lower"]),
        tuple(settings["upper"]),
        settings["initial"],
        settings["seed"],
        np.array([t["eta"] for t in told]),
        np.array([t["distance"] for t in told], dtype=float),
    )


def walker(cell: Path, study: dict[str, Any]) -> Grid:
    """The robot of a study's cell, without its bus."""
    found = re.search(r"-r(\d+)-(\w+)-(\w+)$", cell.name)
    assert found is not None, f"{cell} is no cell of trials"
    robot = RobotDescription.load(study["robot"])
    bundle = cell.parent / f"policy-{found[2]}-{found[3]}" / "files" / "policy"
    policy = NumpyPolicy.load(bundle, robot)
    return Grid(robot, policy, int(found[1]), study["settings"]["horizon"])


def chosen(search: Search, robot: Grid, again: int) -> Array:
    """The eta that is kept where the last walks are of the best so far."""
    first = len(search.distance) - again
    search = replace(search, eta=search.eta[:first], distance=search.distance[:first])
    for draw in range(FIRST_AGAIN, FIRST_AGAIN + again):
        best = np.array(choose(search).eta)[None]
        search = replace(
            search,
            eta=np.vstack([search.eta, best]),
            distance=np.append(search.distance, robot.walked(best, draw)),
        )
    return np.array(choose(search).eta)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cells", type=Path, nargs="+", help="folders of cells of trials")
    parser.add_argument("--again", type=int, nargs="+", default=[0, 3, 6], help="last walks")
    parser.add_argument("--walks", type=int, default=8, help="that judge each choice")
    given = parser.parse_args()
    means = []
    for cell in given.cells:
        study = read_json(cell / "files" / "study.json")
        robot, search = walker(cell, study), searched(study)
        eta = np.array([chosen(search, robot, again) for again in given.again])
        draws = range(FIRST_JUDGED, FIRST_JUDGED + given.walks)
        distance = np.array([robot.walked(eta, draw) for draw in draws])
        means.append(distance.mean(axis=0))
        told = {
            str(again): {"mean": round(float(mean), 3), "least": round(float(least), 3)}
            for again, mean, least in zip(given.again, means[-1], distance.min(axis=0), strict=True)
        }
        print(json.dumps({"robot": robot.seed} | told), flush=True)
    overall = np.mean(means, axis=0)
    for again, mean in zip(given.again, overall, strict=True):
        print(f"{again} of the walks made sure: {mean:.3f} m")


if __name__ == "__main__":
    main()
