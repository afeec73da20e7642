"""What a policy's condition is made of, and what it is worth: the projection looked into.

Two questions about each policy that is conditioned on what the projection makes of mu (PUP), or on
mu itself (UP). How far does the condition move where one parameter crosses its bounds and the
others stay? And how far does the robot walk with the condition of its own mu, of the middle of the
bounds, of another robot's mu, and of its own mu but for some parameters that are another robot's?
All conditions walk the same episodes of the same robots, and differences are told with 90 %
intervals over the robots.

    python -m benchmarks.projection --mu 200 pup/robots/darwin_op2/policies/forward
"""

import argparse
import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.walks import Trial, drawn, figures, whose_walks
from pup.policy.bundle import NumpyPolicy
from services.experiment.statistics import Estimate, mean

Array = NDArray[np.float64]


def moved(policy: NumpyPolicy, mu: Array) -> Array:
    """How far the condition moves as each parameter crosses its bounds, shape (n, n_parameters).

    In units of the diagonal of all that the condition reaches over these mu.

    Args:
      policy: whose condition.
      mu: on the unit scale, shape (n, n_parameters).
    """
    whole = policy.project(mu)
    diagonal = float(np.linalg.norm(np.ptp(whole, axis=0)))
    told = []
    for i in range(mu.shape[1]):
        low, high = mu.copy(), mu.copy()
        low[:, i], high[:, i] = 0.0, 1.0
        told.append(np.linalg.norm(policy.project(high) - policy.project(low), axis=1))
    return np.stack(told, axis=1) / diagonal


def exchanged(mu: Array, columns: NDArray[np.bool_], rng: np.random.Generator) -> Array:
    """Robots with some parameters of another one: nobody keeps their own."""
    ring = rng.permutation(len(mu))
    other = np.empty_like(ring)
    other[ring] = np.roll(ring, 1)  # each takes from its neighbour in a ring of all
    out = mu.copy()
    out[:, columns] = mu[other][:, columns]
    return out


def average(differences: Array) -> Estimate:
    """The mean of a difference over robots, with its 90 % interval."""
    return mean(differences.tolist())


def analysed(trial: Trial, mu: Array, seed: int) -> dict[str, Any]:
    """Both answers for one policy, printed as they come."""
    policy, names = trial.policy, trial.policy.card.parameters
    sensitivity = moved(policy, mu)
    order = np.argsort(-sensitivity.mean(axis=0))
    print("  a parameter that crosses its bounds moves the condition by")
    for i in order:
        print(f"    {names[i]:16s} {sensitivity[:, i].mean():5.1%} of its reach", flush=True)
    head = np.array([name.endswith("/head") for name in names])
    first = np.isin(np.arange(len(names)), order[:3])
    rng = np.random.default_rng(seed)
    conditions = {
        "its own": mu,
        "of the bounds' middle": np.full_like(mu, 0.5),
        "of another robot": exchanged(mu, np.ones(len(names), dtype=bool), rng),
        "its own, the head of another": exchanged(mu, head, rng),
        f"its own, {', '.join(names[i] for i in order[:3])} of another": exchanged(mu, first, rng),
    }
    walked: dict[str, Any] = {}
    own: Array | None = None
    for name, of in conditions.items():
        walks = trial.walks(mu, policy.project(of), seed + 1)
        row: dict[str, Any] = figures(walks)
        own = walks.distance if own is None else own
        less = average(walks.distance - own)
        row |= {"less_own": less.document()}
        walked[name] = row
        print(
            f"  condition {name}: {row['distance_median']:.2f} m "
            f"({row['distance_lower']:.2f} to {row['distance_upper']:.2f}), "
            f"{row['upright_share']:.0%} without a fall; "
            f"{less.value:+.3f} m ({less.low:+.3f} to {less.high:+.3f}) on average",
            flush=True,
        )
    told = {names[i]: float(sensitivity[:, i].mean()) for i in order}
    return {"sensitivity": told, "walked": walked}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    whose_walks(parser, seed=30_000)
    given = parser.parse_args()
    robot, bounds, mu = drawn(given)
    told = {}
    for folder in given.policies:
        policy = NumpyPolicy.load(folder, robot)
        print(f"{folder}, {policy.card.method}", flush=True)
        if not policy.card.shape.eta:
            parser.error(f"{folder}: a policy of method {policy.card.method!r} is not conditioned")
        told[str(folder)] = analysed(Trial(policy, robot, bounds), mu, given.seed)
    if given.out:
        given.out.write_text(json.dumps({"schema": 1, "mu": given.mu, "policies": told}, indent=1))


if __name__ == "__main__":
    main()
