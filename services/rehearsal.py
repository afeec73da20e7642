"""Walks that a robot made, made again in simulation: whether the simulator walks as the robot does.

A replay says how well joints follow the same commands. A policy acts on what came of its own
actions, so that a simulator which replays well may still fall where the robot walks. What a study's
trials came to, and what the same etas come to in simulation, tells it before anything is trained
there (the correlation is Kadian et al. 2020's, of ranks).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr

from pup.errors import InputError
from pup.files import read_json, sha256, write_atomic, write_json
from pup.locomotion.landscape import walk_each
from pup.locomotion.sampling import ParameterSampler
from pup.locomotion.settings import TaskSettings
from pup.policy.bundle import CARD, NumpyPolicy
from pup.recording import load_recordings
from pup.robot import RobotDescription
from pup.sysid.figures import INK, SOFT, as_png, drawing_style, new_figure
from pup.sysid.result import read_bounds
from pup.transfer.trial import TrialState

Array = NDArray[np.float64]

SCHEMA = 1
FILE, PICTURE = "rehearsal.json", "rehearsal.png"
EPISODES = 8
"""Of each eta: readings are noisy, and starts differ."""
SHORT = 0.5
"""Share of the other's time before a fall below which a simulator and a robot do not walk alike."""


@dataclass(frozen=True)
class Walked:
    """What the trials of a study came to, by the etas that were walked.

    Attributes:
      eta: shape (n, n_eta).
      distance: means, m, shape (n,).
      time: means, before a fall, s, shape (n,).
      walks: of each, shape (n,).
      horizon: of the longest walk, s.
      recordings: names of those that were made of the walks.
    """

    eta: Array
    distance: Array
    time: Array
    walks: NDArray[np.int64]
    horizon: float
    recordings: tuple[str, ...]


def rehearse(
    robot: RobotDescription,
    policy: Path,
    bounds: Path,
    study: Path,
    out: Path,
    seed: int,
    threads: int,
    rate: float | None = None,
) -> dict[str, Any]:
    """Walk the trials of a study again, with the fitted parameters of a simulator.

    Args:
      robot: what is simulated.
      policy: the bundle that walked.
      bounds: whose nominal values are simulated.
      study: `study.json` of `pup transfer`.
      out: folder for `rehearsal.json` and `rehearsal.png`.
      seed: of everything random.
      threads: cores to use.
      rate: of control, Hz; None for that of the walks' recordings, which lie where a laboratory
        leaves them beside the study, and where none do for the policy's fastest, as agents have it.

    Returns:
      The document of `rehearsal.json`.

    Raises:
      InputError: the policy is not this robot's, the study is none of this policy, or the policy
        was not trained for the rate.
    """
    bundle, digest = NumpyPolicy.load(policy, robot), sha256(policy / CARD)
    walked = read_walked(study, bundle, digest)
    fitted = read_bounds(bounds, robot)
    if rate is None:
        rate = recorded_rate(study.parent, walked.recordings, robot) or bundle.card.rates[1]
    bundle.card.check_rate(rate)
    task = TaskSettings.of_policy(robot, bundle.card).evaluation(rate)
    # The error of an IMU is drawn anew for each walk in a training; a robot has the one it has.
    task = replace(task, horizon=walked.horizon, tilt_bias=0.0)
    eta = np.repeat(walked.eta, EPISODES, axis=0)
    rng = np.random.default_rng(seed)
    mu = ParameterSampler.nominal(fitted).draw(rng, np.arange(len(eta)))
    walks = walk_each(bundle.act, robot, fitted, task, mu, eta, rng, threads)
    distance = walks.distance.reshape(-1, EPISODES)
    time = walks.time.reshape(-1, EPISODES)
    document = {
        "schema": SCHEMA,
        "robot": robot.name,
        "robot_digest": robot.digest,
        "study_sha256": sha256(study),
        "policy_sha256": digest,
        "bounds_sha256": sha256(bounds),
        "control_rate": rate,
        "episodes": EPISODES,
        "etas": _etas(walked, distance, time),
        **_summary(walked, distance.mean(axis=1), time.mean(axis=1)),
    }
    write_json(out / FILE, document)
    with drawing_style():
        write_atomic(out / PICTURE, as_png(rehearsal_figure(document)))
    return document


def read_walked(file: Path, policy: NumpyPolicy, digest: str) -> Walked:
    """The trials of a study that ended by themselves.

    Args:
      file: `study.json`.
      policy: that walked.
      digest: SHA-256 of its card.

    Raises:
      InputError: it is none, of another policy, or nothing was walked.
    """
    told = read_json(file)
    try:
        if told["schema"] != SCHEMA:
            raise ValueError(told["schema"])
        whose, horizon = told["policy"], float(told["settings"]["horizon"])
        ended = [t for t in told["trials"] if t["state"] == TrialState.SUCCEEDED]
        rows = [(tuple(map(float, t["eta"])), (t["distance"], t["time"])) for t in ended]
        values = np.array([row for _, row in rows], dtype=np.float64).reshape(-1, 2)
        recordings = tuple(name for t in ended if (name := t.get("recording")))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{file}: not a study.json of `pup transfer`") from error
    if whose != digest:
        raise InputError(f"{file}: a study of another policy; give the one that walked")
    if not rows:
        raise InputError(f"{file}: no walk has ended by itself yet; let the study go on first")
    sizes = {len(eta) for eta, _ in rows}
    etas = list(dict.fromkeys(eta for eta, _ in rows))
    finite = np.isfinite(values).all() and all(math.isfinite(x) for eta in etas for x in eta)
    if sizes != {policy.card.shape.eta} or not finite or not 0 < horizon < 1e4:
        raise InputError(f"{file}: its trials are none of this policy's")
    member = np.array([[eta == of for eta, _ in rows] for of in etas])
    count = member.sum(axis=1)
    distance, time = (member @ values / count[:, None]).T
    return Walked(np.array(etas), distance, time, count, horizon, recordings)


def recorded_rate(folder: Path, names: Sequence[str], robot: RobotDescription) -> float | None:
    """At which the control loop really went, Hz; None where no recording lies beside the study.

    Args:
      folder: of the study.
      names: of the recordings of its walks.
      robot: that walked.
    """
    files = [folder / "agent" / "recordings" / f"{name}.parquet" for name in names]
    if not (there := [file for file in files if file.is_file()]):
        return None
    ticks = [np.diff(recording.time) for recording in load_recordings(there, robot)]
    return float(1 / np.median(np.concatenate(ticks)))


def _etas(walked: Walked, distance: Array, time: Array) -> list[dict[str, Any]]:
    return [
        {
            "eta": walked.eta[i].tolist(),
            "walks": int(walked.walks[i]),
            "distance": float(walked.distance[i]),
            "time": float(walked.time[i]),
            "simulated_distance": float(distance[i].mean()),
            "simulated_deviation": float(distance[i].std(ddof=1)),
            "simulated_time": float(time[i].mean()),
        }
        for i in range(len(walked.eta))
    ]


def _summary(walked: Walked, distance: Array, time: Array) -> dict[str, Any]:
    """Over etas, each as often as it was walked."""

    def mean(values: Array) -> float:
        return float(np.average(values, weights=walked.walks))

    return {
        "distance": mean(walked.distance),
        "time": mean(walked.time),
        "simulated_distance": mean(distance),
        "simulated_time": mean(time),
        "apart": mean(np.abs(distance - walked.distance)),
        "rank_correlation": _rank_correlation(walked.distance, distance),
        "walks_alike": _alike(mean(time), mean(walked.time)),
    }


def _alike(simulated: float, walked: float) -> bool:
    """Whether neither falls in half of the time that the other stays up, both in s."""
    return min(simulated, walked) >= SHORT * max(simulated, walked)


def _rank_correlation(one: Array, other: Array) -> float | None:
    """Spearman's; None of fewer than three etas, or where all are alike."""
    if len(one) < 3 or np.ptp(one) == 0 or np.ptp(other) == 0:
        return None
    return float(spearmanr(one, other).statistic)


def rehearsal_words(told: Mapping[str, Any]) -> str:
    """What a rehearsal came to, in a sentence.

    Args:
      told: document of `rehearsal.json`.
    """
    words = (
        f"{len(told['etas'])} etas: {told['distance']:.2f} m in {told['time']:.1f} s by the robot, "
        f"{told['simulated_distance']:.2f} m in {told['simulated_time']:.1f} s in simulation, "
        f"{told['apart']:.2f} m apart"
    )
    if told["rank_correlation"] is not None:
        words += f", rank correlation {told['rank_correlation']:+.2f}"
    if told["walks_alike"]:
        return words
    if told["simulated_time"] < told["time"]:
        return words + "; this simulator falls where the robot walks: trust no policy trained in it"
    return words + "; this simulator walks where the robot falls: trust no walk that it foretells"


def rehearsal_figure(told: Mapping[str, Any]) -> Any:
    """Distances in simulation over those of the robot, a dot for each eta.

    Args:
      told: document of `rehearsal.json`.
    """
    of = {name: np.array([eta[name] for eta in told["etas"]]) for name in told["etas"][0]}
    axes = (drawn := new_figure(3.6, 3.3)).subplots()
    most = max(of["distance"].max(), of["simulated_distance"].max(), 0.1)
    least = min(of["distance"].min(), of["simulated_distance"].min(), 0.0)
    axes.plot([least, most], [least, most], color=SOFT, linewidth=1.0)
    error = of["simulated_deviation"] / math.sqrt(told["episodes"])
    axes.errorbar(of["distance"], of["simulated_distance"], error, fmt="o", markersize=4, color=INK)
    axes.set_xlabel("the robot, m")
    axes.set_ylabel("in simulation, m")
    axes.grid()
    return drawn
