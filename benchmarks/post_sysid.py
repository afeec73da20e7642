"""Post-sysID on concealed virtual robots, against a dense grid over eta on the same robots.

Each robot is walked through the real chain: gateway, agent, Dynamixel packets on a pseudo-terminal;
in lock-step. The grid is walked through it too: twice everywhere, and where that is best five times
more, by which its best is both chosen and told. What a study found is told by five walks of what it
chose. `--simulated` gives rollouts of `pup replay --landscape`: a second, shorter study begins with
them.

    python -m benchmarks.post_sysid forward/policy --simulated walk/simulated.json --out results

Robots that are done are kept in `--out`; the same command goes on.
"""

import argparse
import itertools
import json
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pup.files import read_json, sha256, write_json
from pup.policy.bundle import CARD, NumpyPolicy
from pup.robot import RobotDescription
from pup.sysid.result import read_bounds
from services.laboratory import Laboratory
from services.transfer import read_simulated
from services.trials import Budget, fitted_eta, follow

AT_ONCE = 16
"""Etas that a study compares at most."""


@dataclass(frozen=True)
class Plan:
    """What is walked on each robot.

    Attributes:
      robot: the robot.
      policy: its bundle.
      side: points of the grid along each entry of eta.
      simulated: rollouts for the second study; None leaves it out.
      trials: of the second study; the first has 25.
      out: folder of the results.
    """

    robot: RobotDescription
    policy: Path
    side: int
    simulated: dict[str, Any] | None
    trials: int
    out: Path

    def grid(self) -> list[list[float]]:
        """Etas over the box of the policy."""
        card = NumpyPolicy.load(self.policy, self.robot).card
        box = zip(card.eta_lower, card.eta_upper, strict=True)
        axes = [np.linspace(low, high, self.side) for low, high in box]
        return [list(map(float, eta)) for eta in itertools.product(*axes)]

    def one(self, seed: int) -> dict[str, Any]:
        """All studies on the robot of a seed."""
        folder = self.out / f"robot{seed}"
        bounds = read_bounds(self.robot.identified_path, self.robot)
        fitted = fitted_eta(NumpyPolicy.load(self.policy, self.robot), bounds).tolist()
        with Laboratory(folder, self.robot, self.policy, seed) as laboratory:
            walks = _Walks(laboratory, folder, seed)
            cold = walks.study("cold", trials=25, compare=[fitted])
            told = {"seed": seed, "cold": _mean(cold, "repeat"), "fitted": _mean(cold, "compare")}
            told["eta"] = cold["eta"]
            if self.simulated is not None:
                warm = walks.study("warm", trials=self.trials, simulated=self.simulated)
                told["warm"] = _mean(warm, "repeat")
            told["grid"] = walks.best_of(self.grid())
        return told


class _Walks:
    def __init__(self, laboratory: Laboratory, folder: Path, seed: int) -> None:
        self.laboratory, self.folder, self.seed = laboratory, folder, seed

    def study(
        self,
        name: str,
        trials: int,
        repeats: int = 5,
        compare: Sequence[Sequence[float]] = (),
        simulated: dict[str, Any] | None = None,
    ) -> dict[str, Any]:
        """A study to its end."""
        budget, out = Budget(trials, repeats, self.seed), self.folder / name
        return follow(self.laboratory, name, budget, compare, out, lambda _: None, simulated)

    def best_of(self, grid: list[list[float]]) -> float:
        """Mean distance of the best eta of a grid, told too large rather than too small.

        Two walks of each choose five, and five more walks of each of these choose the best and tell
        its mean: that is chosen by the walks that tell it.
        """
        rough = [
            self.study(f"grid{i}", trials=1, repeats=2, compare=grid[i : i + AT_ONCE])
            for i in range(0, len(grid), AT_ONCE)
        ]
        means = {
            tuple(eta): _mean(study, "compare", eta)
            for study in rough
            for eta in study["settings"]["compare"]
        }
        best = sorted(means, key=lambda eta: -means[eta])[:5]
        again = self.study("best", trials=1, compare=best)
        return max(_mean(again, "compare", list(eta)) for eta in best)


def _mean(study: dict[str, Any], purpose: str, eta: list[float] | None = None) -> float:
    told = [
        trial["distance"]
        for trial in study["trials"]
        if (trial["purpose"], trial["state"]) == (purpose, "succeeded")
        and (eta is None or np.allclose(trial["eta"], eta))
    ]
    return statistics.mean(told) if told else 0.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policy", type=Path)
    parser.add_argument("--robot", default="darwin_op2")
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--first", type=int, default=1000, help="seed of the first robot")
    parser.add_argument("--side", type=int, default=4, help="points of the grid along each entry")
    parser.add_argument("--simulated", type=Path)
    parser.add_argument("--trials", type=int, default=10, help="of the study with a prior")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    simulated = read_simulated(given.simulated) if given.simulated else None
    robot = RobotDescription.load(given.robot)
    plan = Plan(robot, given.policy, given.side, simulated, given.trials, given.out)
    digest = sha256(given.policy / CARD)
    rows = []
    for seed in range(given.first, given.first + given.robots):
        file = given.out / f"robot{seed}.json"
        if not file.exists():
            write_json(file, {"schema": 1, "policy": digest} | plan.one(seed))
        rows.append(read_json(file))
        print(json.dumps(rows[-1]), flush=True)
    for name in ("cold", "warm", "fitted"):
        shares = [row[name] / row["grid"] for row in rows if row.get(name) is not None]
        if shares:
            print(f"{name}: {statistics.median(shares):.2f} of the best of the grid, median")


if __name__ == "__main__":
    main()
