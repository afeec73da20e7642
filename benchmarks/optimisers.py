"""Regret of the optimiser of eta against Ax, Optuna's GP sampler and nevergrad's CMA.

Every optimiser walks the same robots: landscapes with a ridge, lower hills, a cliff and noise that
grows with distance (tests/landscapes.py), or those that `benchmarks.post_sysid` has recorded on
virtual robots. After 10 and after 25 walks each names the eta it would keep, by the means that it
has for that; regret is what that eta's expected distance falls short of the best one's, in percent
of it.

    python -m benchmarks.optimisers --robots 20 --out optimisers.json
    python -m benchmarks.optimisers --recorded results/landscape*.json --noise 0.02
"""

import argparse
import json
import logging
import sys
import time
import warnings
from collections.abc import Callable, Generator
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
import landscapes

Array = NDArray[np.float64]
Session = Generator[tuple[Array, Array | None], Any, None]
"""Gives an eta to walk and the one it would keep by now; is sent the distance."""
LOOKS = (10, 25)
LEAST = 0.3
"""Of the best eta, m; on a recorded landscape with less no eta walks, and no optimiser can tell."""


class Recorded:
    """A landscape that was walked on a grid, linear between its points.

    Args:
      file: of `benchmarks.post_sysid`.
      noise: of a walk, m.
    """

    def __init__(self, file: Path, noise: float) -> None:
        told = json.loads(file.read_text())
        sides = [len(axis) for axis in told["axes"]]
        table = np.reshape(told["distance"], sides)
        unit = [np.linspace(-1, 1, side) for side in sides]
        self.noise = noise
        self._between, self._best = RegularGridInterpolator(unit, table), float(table.max())

    def expected(self, eta: Array) -> Array:
        """Distance without noise, m; eta of shape (..., 3) over the box, each from -1 to 1."""
        return np.asarray(self._between(np.clip(eta, -1, 1))).reshape(np.shape(eta)[:-1])

    def walk(self, eta: Array, rng: np.random.Generator) -> Array:
        """Distance as measured, m."""
        mean = self.expected(eta)
        return np.asarray(mean + rng.normal(0, self.noise, mean.shape))

    def optimum(self) -> float:
        """Largest expected distance, m."""
        return self._best


def ours(
    seed: int,
    simulated: Any = None,
    least_gain: float = 0.0,
    trials: int | None = max(LOOKS),
) -> Session:
    from pup.transfer.optimizer import Search, choose, suggest

    def search(eta: Array, distance: Array) -> Search:
        box = (-1.0,) * 3, (1.0,) * 3
        return Search(*box, 5, seed, eta, distance, simulated, trials=trials)

    eta, distance = np.zeros((0, 3)), np.zeros(0)
    number = 0
    while True:
        number += 1
        decision = suggest(search(eta, distance), number)
        if not decision.is_worth(least_gain):
            break
        asked = np.array(decision.eta)
        kept = np.array(choose(search(eta, distance)).eta) if number - 1 in LOOKS else None
        walked = yield asked, kept
        eta, distance = np.vstack([eta, asked]), np.append(distance, walked)
    kept = np.array(choose(search(eta, distance)).eta)
    while True:
        yield kept, kept


def frugal(seed: int) -> Session:
    return ours(seed, least_gain=0.002)


def unsure(seed: int) -> Session:
    return ours(seed, trials=None)


def warm(seed: int) -> Session:
    return ours(seed, simulated())


def simulated() -> Any:
    """Rollouts in simulation of other robots of the family, one of each at each eta."""
    from pup.transfer.surrogate import Simulated

    rng = np.random.default_rng(99)
    eta = rng.uniform(-1, 1, (64, 3))
    made = [landscapes.Robot.draw(10_000 + i).walk(eta, rng) for i in range(48)]
    return Simulated(eta, np.array(made))


def cma(seed: int) -> Session:
    import nevergrad as ng

    space = ng.p.Array(shape=(3,), lower=-1.0, upper=1.0)
    space.random_state.seed(seed)
    optimiser = ng.optimizers.CMA(parametrization=space, budget=max(LOOKS) + 1)
    while True:
        asked = optimiser.ask()
        walked = yield asked.value, optimiser.provide_recommendation().value
        optimiser.tell(asked, -walked)


def optuna_gp(seed: int) -> Session:
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    sampler = optuna.samplers.GPSampler(seed=seed, n_startup_trials=5)
    study = optuna.create_study(direction="maximize", sampler=sampler)
    while True:
        trial = study.ask()
        asked = np.array([trial.suggest_float(name, -1.0, 1.0) for name in "abc"])
        kept = None
        with suppress(ValueError):  # nothing was told yet
            kept = np.array([study.best_params[name] for name in "abc"])
        walked = yield asked, kept
        study.tell(trial, walked)


def ax(seed: int) -> Session:
    from ax.api.client import Client
    from ax.api.configs import RangeParameterConfig

    client = Client(random_seed=seed)
    client.configure_experiment(
        parameters=[
            RangeParameterConfig(name=name, parameter_type="float", bounds=(-1.0, 1.0))
            for name in "abc"
        ]
    )
    client.configure_optimization(objective="distance")
    client.configure_generation_strategy(initialization_budget=5)
    walks = 0
    while True:
        ((index, told),) = client.get_next_trials(max_trials=1).items()
        kept = None
        if walks in LOOKS:
            best, *_ = client.get_best_parameterization()
            kept = np.array([best[name] for name in "abc"])
        walked = yield np.array([told[name] for name in "abc"]), kept
        client.complete_trial(trial_index=index, raw_data={"distance": float(walked)})
        walks += 1


RIVALS: dict[str, tuple[Callable[[int], Session], str]] = {
    "pup": (ours, "botorch"),
    "pup, no walk made sure": (unsure, "botorch"),
    "pup, as long as worth a walk": (frugal, "botorch"),
    "pup, simulated prior": (warm, "botorch"),
    "Ax": (ax, "ax"),
    "Optuna GP": (optuna_gp, "optuna"),
    "nevergrad CMA": (cma, "nevergrad"),
}


def regrets(
    make: Callable[[int], Session], seed: int, robot: landscapes.Robot | Recorded
) -> dict[str, Any]:
    """Regret in percent after each look, and the seconds that a suggestion took."""
    rng = np.random.default_rng((seed, 4))
    best, session = robot.optimum(), make(seed)
    found: dict[str, Any] = {}
    spent, tried = [], set()
    walked: Any = None
    for walks in range(max(LOOKS) + 1):
        began = time.process_time()
        asked, kept = session.send(walked)
        spent.append(time.process_time() - began)
        if walks in LOOKS:
            assert kept is not None
            found[str(walks)] = 100 * (1 - float(robot.expected(np.asarray(kept))) / best)
        if walks < max(LOOKS):
            tried.add(tuple(asked))
        walked = robot.walk(np.asarray(asked), rng)
    found["tried"] = len(tried)
    return found | {"seconds": float(np.quantile(spent[6:], 0.95))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--noise", type=float, default=0.05, help="m")
    parser.add_argument("--gap", type=float, default=0.0, help="of a robot to its family, in eta")
    parser.add_argument("--recorded", type=Path, nargs="+", help="landscapes of post_sysid")
    parser.add_argument("--repeats", type=int, default=1, help="of each robot, by another seed")
    parser.add_argument("--only", nargs="+", default=list(RIVALS))
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    import torch

    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)  # Ax tells of each trial
    seeds = range(options.first, options.first + options.robots)
    robots: list[landscapes.Robot | Recorded] = [
        landscapes.Robot.draw(seed, options.noise, options.gap) for seed in seeds
    ]
    if options.recorded:
        recorded = {file: Recorded(file, options.noise) for file in options.recorded}
        robots = [made for made in recorded.values() if made.optimum() > LEAST]
        for file in (f for f, made in recorded.items() if made.optimum() <= LEAST):
            print(f"{file}: left out, no eta walks {LEAST:g} m")
        options.only = [name for name in options.only if RIVALS[name][0] is not warm]
    robots = robots * options.repeats
    table: dict[str, Any] = {}
    for name in options.only:
        make, package = RIVALS[name]
        if find_spec(package) is None:
            print(f"{name}: skipped, {package} is not installed")
            continue
        runs = [regrets(make, options.first + i, robot) for i, robot in enumerate(robots)]
        row: dict[str, Any] = {}
        for look in map(str, LOOKS):
            found = np.array([r[look] for r in runs])
            error = found.std(ddof=1) / np.sqrt(len(found)) if len(found) > 1 else 0.0
            row[look] = {
                "mean": found.mean(),
                "error": error,
                "median": float(np.median(found)),
                "each": found.tolist(),
            }
        row["etas_tried"] = float(np.mean([r["tried"] for r in runs]))
        row["seconds_p95"] = float(np.median([r["seconds"] for r in runs]))
        table[name] = row
        told = "; ".join(
            f"{look} walks: {row[look]['mean']:.1f} ± {row[look]['error']:.1f} % (median "
            f"{row[look]['median']:.1f})"
            for look in map(str, LOOKS)
        )
        told += f"; {row['etas_tried']:.1f} etas tried"
        print(f"{name}: {told}; suggestion p95 {row['seconds_p95']:.2f} s", flush=True)
        if options.out:
            document = {
                "schema": 1,
                "robots": len(robots) // options.repeats,
                "repeats": options.repeats,
                "noise": options.noise,
                "gap": options.gap,
            }
            options.out.write_text(json.dumps(document | {"optimisers": table}, indent=1) + "\n")


if __name__ == "__main__":
    main()
