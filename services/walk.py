"""The job behind `pup replay --policy`: a trained policy walks in simulation."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from pup.errors import InputError
from pup.files import write_json
from pup.locomotion.conditioning import fitted_eta
from pup.locomotion.evaluation import evaluate
from pup.locomotion.landscape import landscape
from pup.locomotion.sampling import ParameterSampler
from pup.locomotion.settings import TaskSettings
from pup.locomotion.task import WalkingTask
from pup.policy.bundle import NumpyPolicy
from pup.robot import RobotDescription
from pup.sysid.result import FittedBounds, read_bounds
from services.footage import Footage, draw_gait, film

Array = NDArray[np.float64]
DRAWS = 16
"""Of the parameters, for a landscape."""


@dataclass(frozen=True)
class Shown:
    """What is let walk.

    Attributes:
      policy: folder of a bundle.
      bounds: file it was trained on; None for the robot's `identified.json`.
      eta: what the policy is conditioned on; None projects the true parameters.
      episodes: with parameters drawn anew, for the numbers.
      landscape: etas that are walked with 16 draws of the parameters, for `pup transfer
        --simulated`; 0 for none.
      seed: of everything random.
      rate: of control in these, Hz; None for the policy's fastest, as agents have it.
    """

    policy: Path
    bounds: Path | None = None
    eta: tuple[float, ...] | None = None
    episodes: int = 50
    landscape: int = 0
    seed: int = 0
    rate: float | None = None


def walk(robot: RobotDescription, shown: Shown, out: Path, threads: int) -> dict[str, Any]:
    """Let a policy walk; write `replay.json`, `gait.png`, a video and, if asked, `simulated.json`.

    One episode with the fitted parameters is shown. Others, with parameters drawn from the bounds,
    tell how far the policy gets.

    Args:
      robot: the robot.
      shown: what is let walk.
      out: folder for the files.
      threads: cores to use.

    Returns:
      The document of `replay.json`.

    Raises:
      InputError: the policy, the bounds, eta or the rate do not fit.
    """
    policy = NumpyPolicy.load(shown.policy, robot)
    bounds = read_bounds(shown.bounds or robot.identified_path, robot)
    _same_bounds(policy, bounds, shown)
    eta = None if shown.eta is None else _eta(policy, shown.eta)
    if shown.landscape and not policy.card.shape.eta:
        raise InputError(f"{shown.policy}: is conditioned on nothing; leave --landscape out")
    settings = TaskSettings.of_policy(robot, policy.card).evaluation()
    rate = shown.rate or policy.card.rates[1]
    policy.card.check_rate(rate)

    def act(seen: NDArray[np.float32], mu: NDArray[np.float32]) -> Array:
        return policy.act(seen, policy.project(mu) if eta is None else eta)

    def task(sampler: ParameterSampler, n: int) -> WalkingTask:
        rng = np.random.default_rng((shown.seed, n))
        return WalkingTask(robot, sampler, settings, n, rng, threads)

    footage = Footage.of(task(ParameterSampler.nominal(bounds), 1), act)
    walks = evaluate(act, task(ParameterSampler(bounds), shown.episodes))
    draw_gait(out / "gait.png", robot, footage)
    if shown.landscape:
        file, etas = out / "simulated.json", shown.landscape
        known = settings.evaluation(rate)
        write_landscape(file, robot, policy, bounds, known, etas, shown.seed, threads)
    video, drawn = film(out / "walk", robot, footage)
    document = {
        "schema": 1,
        "robot": robot.name,
        "robot_digest": robot.digest,
        "policy": str(shown.policy),
        "trained_on": policy.card.robot_digest,
        "method": policy.card.method,
        "direction": policy.card.direction,
        "eta": None if eta is None else eta.tolist(),
        "fitted_eta": fitted_eta(policy, bounds).tolist() if policy.card.shape.eta else None,
        "shown": {
            "distance": footage.distance,
            "time": float(footage.time[-1]),
            "fell": footage.fell,
        },
        "episodes": shown.episodes,
        **walks.summary(),
        "distance": walks.distance.tolist(),
        "fell": walks.fell.tolist(),
        "video": str(video),
        "drawn_by": drawn,
    }
    write_json(out / "replay.json", document)
    return document


def write_landscape(
    file: Path,
    robot: RobotDescription,
    policy: NumpyPolicy,
    bounds: FittedBounds,
    settings: TaskSettings,
    etas: int,
    seed: int,
    threads: int,
) -> None:
    """Write distances over eta's box, where the projections of the bounds are.

    Args:
      file: where to, as docs/transfer.md has it.
      robot: the robot.
      policy: that is conditioned on eta.
      bounds: of the robot's parameters.
      settings: of the task; its control rates are told in the file.
      etas: points of the box.
      seed: of everything random.
      threads: cores to use.
    """
    card = policy.card
    points = qmc.Sobol(card.shape.eta, seed=seed).random(etas)
    eta = qmc.scale(points, card.eta_lower, card.eta_upper)
    distance = landscape(policy.act, robot, bounds, settings, eta, DRAWS, seed, threads)
    told = {"schema": 1, "control_rate": list(settings.control_rate), "eta": eta.tolist()}
    write_json(file, told | {"distance": distance.tolist()})


def _eta(policy: NumpyPolicy, told: tuple[float, ...]) -> Array:
    try:
        policy.card.check_eta(told)
    except InputError as error:
        raise InputError(f"--eta: {error}") from error
    return np.array(told)


def _same_bounds(policy: NumpyPolicy, bounds: FittedBounds, shown: Shown) -> None:
    card = policy.card
    trained = replace(
        bounds,
        names=card.parameters,
        lower=np.array(card.parameter_lower),
        upper=np.array(card.parameter_upper),
    )
    same = bounds.names == trained.names and np.allclose(
        [bounds.lower, bounds.upper], [trained.lower, trained.upper], rtol=1e-9
    )
    if not same:
        raise InputError(f"{shown.policy}: was trained on other bounds; give those with --bounds")
