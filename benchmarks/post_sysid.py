"""Post-sysID on concealed virtual robots, against a dense grid over eta on the same robots.

Each robot is walked through the real chain: gateway, agent, Dynamixel packets on a pseudo-terminal;
in lock-step. What a study found is told by five walks of what it chose. The grid is walked by the
same robot without its bus (`hardware_agent.virtual.walks`), whose readings are the same to the last
bit; how far both agree is told from the walks of the study, each walked there too.
`--simulated` gives rollouts of `pup replay --landscape`: a second, shorter study begins with them.

    python -m benchmarks.post_sysid forward/policy --simulated walk/simulated.json --out results

Robots that are done are kept in `--out`; the same command goes on.
"""

import argparse
import itertools
import json
import multiprocessing
import statistics
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hardware_agent.virtual.fleet import Fleet
from hardware_agent.virtual.walks import walk
from pup.errors import InputError
from pup.files import read_json, sha256, write_json
from pup.policy.bundle import CARD, NumpyPolicy
from pup.robot import RobotDescription
from pup.sysid.result import read_bounds
from services.laboratory import Laboratory, period_of
from services.transfer import read_simulated
from services.trials import Budget, fitted_eta, follow

Array = NDArray[np.float64]

ABREAST = 64
"""Robots that walk at once on the grid."""
BEST, DRAWS = 8, 5
"""Points of the grid that are walked again, and how often; the best of them is the grid's."""


@dataclass(frozen=True)
class Plan:
    """What is walked on each robot.

    Attributes:
      robot: its name.
      policy: its bundle.
      side: points of the grid along each entry of eta.
      simulated: rollouts for the second study; None leaves it out.
      trials: of the second study; the first has 25.
      out: folder of the results.
    """

    robot: str
    policy: Path
    side: int
    simulated: dict[str, Any] | None
    trials: int
    out: Path

    def file(self, seed: int) -> Path:
        """Of the results of a robot."""
        return self.out / f"robot{seed}.json"

    def one(self, seed: int) -> None:
        """All studies and the grid on the robot of a seed, or why it gives none, written down."""
        told = {"schema": 1, "policy": sha256(self.policy / CARD), "seed": seed}
        try:
            told |= self._walked(seed)
        except InputError as error:
            told["failed"] = str(error)
        write_json(self.file(seed), told)

    def _walked(self, seed: int) -> dict[str, Any]:
        robot = RobotDescription.load(self.robot)
        policy = NumpyPolicy.load(self.policy, robot)
        fitted = fitted_eta(policy, read_bounds(robot.identified_path, robot)).tolist()
        folder = self.out / f"robot{seed}"
        with Laboratory(folder, robot, self.policy, seed) as laboratory:

            def study(name: str, trials: int, **more: Any) -> dict[str, Any]:
                place = folder / name
                budget = Budget(trials, seed=seed)
                return follow(laboratory, name, budget, out=place, told=lambda _: None, **more)

            cold = study("cold", 25, compare=[fitted])
            told = {"cold": _mean(cold, "repeat"), "fitted": _mean(cold, "compare")}
            told["eta"] = cold["eta"]
            if self.simulated is not None:
                warm = study("warm", self.trials, compare=[], simulated=self.simulated)
                told["warm"] = _mean(warm, "repeat")
        grid = Grid(robot, policy, seed, cold["settings"]["horizon"])
        return told | {
            "grid": grid.best(self.side, self.out / f"landscape{seed}.json"),
            "agreement": grid.agreement(cold["trials"]),
        }


@dataclass(frozen=True)
class Grid:
    """Walks of one robot without its bus."""

    robot: RobotDescription
    policy: NumpyPolicy
    seed: int
    horizon: float

    def walked(self, eta: Array, draw: int) -> Array:
        """Distances of some etas, m, shape (n,)."""
        told, period = [], period_of(self.robot)
        for part in np.split(eta, range(ABREAST, len(eta), ABREAST)):
            fleet = Fleet(self.robot, [self.seed] * len(part))
            told.append(walk(fleet, self.policy, part, self.horizon, period, draw).distance)
        return np.concatenate(told)

    def best(self, side: int, record: Path) -> float:
        """Mean distance of the best eta of a grid, m, told too large rather than too small.

        One walk of each chooses some, and five more walks of each of these choose the best and tell
        its mean: that is chosen by the walks that tell it.

        Args:
          side: points along each entry of eta.
          record: file for the landscape, which `benchmarks.optimisers --recorded` takes.
        """
        card = self.policy.card
        ends = zip(card.eta_lower, card.eta_upper, strict=True)
        axes = [np.linspace(*both, side) for both in ends]
        eta = np.array(list(itertools.product(*axes)))
        distance = self.walked(eta, 0)
        told = {"axes": [axis.tolist() for axis in axes], "distance": distance.tolist()}
        write_json(record, {"schema": 1, "seed": self.seed} | told)
        chosen = eta[np.argsort(-distance)[:BEST]]
        again = [self.walked(chosen, draw) for draw in range(1, DRAWS + 1)]
        return float(np.mean(again, axis=0).max())

    def agreement(self, trials: Sequence[dict[str, Any]]) -> float:
        """Root mean square difference of a study's walks and the same without a bus, m."""
        done = [trial for trial in trials if trial["state"] == "succeeded"]
        here = self.walked(np.array([trial["eta"] for trial in done]), 0)
        return float(np.sqrt(np.mean((here - [trial["distance"] for trial in done]) ** 2)))


def _mean(study: dict[str, Any], purpose: str) -> float:
    told = [
        trial["distance"]
        for trial in study["trials"]
        if (trial["purpose"], trial["state"]) == (purpose, "succeeded")
    ]
    return statistics.mean(told) if told else 0.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policy", type=Path)
    parser.add_argument("--robot", default="darwin_op2")
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--first", type=int, default=1000, help="seed of the first robot")
    parser.add_argument("--side", type=int, default=7, help="points of the grid along each entry")
    parser.add_argument("--simulated", type=Path)
    parser.add_argument("--trials", type=int, default=10, help="of the study with a prior")
    parser.add_argument("--at-once", type=int, default=2, help="robots that walk at once")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    simulated = read_simulated(given.simulated) if given.simulated else None
    plan = Plan(given.robot, given.policy, given.side, simulated, given.trials, given.out)
    seeds = range(given.first, given.first + given.robots)
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(given.at_once, spawn) as pool:
        rows = []
        for seed, done in [
            (s, pool.submit(plan.one, s)) for s in seeds if not plan.file(s).exists()
        ]:
            done.result()
            print(json.dumps(read_json(plan.file(seed))), flush=True)
        rows = [read_json(plan.file(seed)) for seed in seeds]
    walked = [row for row in rows if "failed" not in row]
    print(f"{len(walked)} of {len(rows)} robots gave results; the others count as 0")
    if not walked:
        return
    for name in ("cold", "warm", "fitted"):
        if name in walked[0]:
            shares = [row[name] / row["grid"] if row in walked else 0.0 for row in rows]
            told = f"median {statistics.median(shares):.3f}, least {min(shares):.3f}"
            print(f"{name}: {told} of the best of the grid")
    if "warm" in walked[0]:
        both = [row["warm"] / row["cold"] for row in walked]
        print(f"warm of cold: median {statistics.median(both):.3f}, least {min(both):.3f}")
    print(f"with and without the bus: {max(row['agreement'] for row in walked):.3f} m at most")


if __name__ == "__main__":
    main()
