"""How far policies walk on parameters they have not met, all on the same draws of mu.

A policy that is conditioned (PUP, UP) is given, for each mu, the best of some conditions: the one
that it makes of mu itself, and others drawn from its box, as a search on that robot would find it.
What is best is decided by `--tries` episodes of each; the figures are of one episode more. Robust
and Nominal walk that one episode alone. Readings are noisy in all episodes, and the IMU's error is
drawn for each, as in training.

    python -m benchmarks.walks --mu 200 forward/policy robust/policy nominal/policy
"""

import argparse
import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.paired import CORES, ROBOT
from pup.locomotion.evaluation import Walks
from pup.locomotion.landscape import walk_each
from pup.locomotion.sampling import ParameterSampler
from pup.locomotion.settings import TaskSettings
from pup.policy.bundle import NumpyPolicy
from pup.robot import RobotDescription
from pup.sysid.result import FittedBounds, read_bounds

Array = NDArray[np.float64]


class Trial:
    """Episodes of one policy on given parameters.

    Args:
      policy: who walks.
      robot: on which robot.
      bounds: of its parameters.
    """

    def __init__(self, policy: NumpyPolicy, robot: RobotDescription, bounds: FittedBounds) -> None:
        self.policy, self.robot, self.bounds = policy, robot, bounds
        self.settings = TaskSettings.of_policy(robot, policy.card).evaluation()

    def walks(self, mu: Array, condition: Array, seed: int) -> Walks:
        """One episode for each row of mu, on the unit scale, and its condition."""
        act, rng = self.policy.act, np.random.default_rng(seed)
        return walk_each(act, self.robot, self.bounds, self.settings, mu, condition, rng, CORES)

    def best(self, mu: Array, conditions: int, tries: int, seed: int) -> Array:
        """The best condition of each mu, shape (n, n_eta)."""
        own = self.policy.project(mu)
        card, rng = self.policy.card, np.random.default_rng(seed)
        if conditions < 2 or not card.shape.eta:
            return own
        box = np.array(card.eta_lower), np.array(card.eta_upper)
        drawn = rng.uniform(*box, (len(mu), conditions - 1, card.shape.eta))
        all_of_them = np.concatenate([own[:, None], drawn], axis=1)
        flat = all_of_them.reshape(-1, card.shape.eta)
        rows = np.repeat(mu, conditions, axis=0)
        told = sum(self.walks(rows, flat, seed + 7919 * (1 + i)).distance for i in range(tries))
        choice = np.argmax(np.reshape(told, (len(mu), conditions)), axis=1)
        return np.asarray(all_of_them[np.arange(len(mu)), choice])


def figures(walks: Walks) -> dict[str, float]:
    """What the table shows."""
    quartiles = np.quantile(walks.distance, (0.25, 0.75))
    return {**walks.summary(), "distance_lower": quartiles[0], "distance_upper": quartiles[1]}


def whose_walks(parser: argparse.ArgumentParser, seed: int) -> None:
    """Add what says which policies walk on which robots."""
    parser.add_argument("policies", type=Path, nargs="+", help="folders of bundles")
    parser.add_argument("--mu", type=int, default=200, help="draws of the parameters")
    parser.add_argument("--seed", type=int, default=seed)
    parser.add_argument("--bounds", type=Path)
    parser.add_argument("--robot", default=ROBOT)
    parser.add_argument("--out", type=Path)


def drawn(given: argparse.Namespace) -> tuple[RobotDescription, FittedBounds, Array]:
    """The robot, its bounds and draws of its parameters on their unit scale."""
    robot = RobotDescription.load(given.robot)
    bounds = read_bounds(given.bounds or robot.identified_path, robot)
    rng = np.random.default_rng(given.seed)
    return robot, bounds, ParameterSampler(bounds).draw(rng, np.arange(given.mu))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    whose_walks(parser, seed=20_000)
    parser.add_argument("--conditions", type=int, default=16, help="tried for each mu")
    parser.add_argument("--tries", type=int, default=2, help="episodes of each condition")
    given = parser.parse_args()
    robot, bounds, mu = drawn(given)
    told = {}
    for folder in given.policies:
        trial = Trial(NumpyPolicy.load(folder, robot), robot, bounds)
        searched = trial.best(mu, given.conditions, given.tries, given.seed)
        own = trial.policy.project(mu)
        for name, condition in (("of mu", own), ("best", searched)):
            row = figures(trial.walks(mu, condition, given.seed + 1))
            told[f"{folder} ({name})"] = row
            print(
                f"{folder}, {trial.policy.card.method}, condition {name}: "
                f"{row['distance_median']:.2f} m ({row['distance_lower']:.2f} to "
                f"{row['distance_upper']:.2f}), {row['time_median']:.1f} s, "
                f"{row['upright_share']:.0%} without a fall",
                flush=True,
            )
            if not trial.policy.card.shape.eta:
                break
    if given.out:
        given.out.write_text(json.dumps({"schema": 1, "mu": given.mu, "policies": told}, indent=1))


if __name__ == "__main__":
    main()
