"""Post-sysID of a job: a virtual robot walks until eta is chosen, unattended (paper, section V)."""

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.files import read_json, sha256, write_json
from pup.locomotion.conditioning import fitted_eta
from pup.policy.bundle import CARD, NumpyPolicy
from pup.robot import RobotDescription
from pup.sysid.result import read_bounds
from pup.transfer.study import StudySettings
from services.laboratory import AGENT, Laboratory
from services.transfer import Gateway, Wanted, transfer

SCHEMA = 1
STUDY = "run"
CHARACTER = 0
"""Decides on the virtual robot's physics: those of the recordings that come with `darwin_op2`."""
ATTEMPTS = 3
"""To run a trial, before another one takes its place."""
HOPELESS = 10
"""Trials without a result, after which the robot is given up."""
LEASE = 600.0
"""Silence after which a trial is lost, s: the machine may be busy."""


@dataclass(frozen=True)
class Budget:
    """How many walks are made.

    Attributes:
      trials: until eta is chosen, at most (paper: 25).
      least_gain: that is expected of a further one, as a share of the best's distance.
      repeats: of the chosen eta afterwards, and of the fitted one (paper: 5).
      seed: of the search.
      horizon: the longest walk, s.
    """

    trials: int = StudySettings.trials
    least_gain: float = StudySettings.least_gain
    repeats: int = StudySettings.repeats
    seed: int = 0
    horizon: float = StudySettings.horizon


def try_out(
    robot: RobotDescription,
    policy: Path,
    bounds: Path,
    budget: Budget,
    out: Path,
    told: Callable[[str], None],
) -> dict[str, Any]:
    """Walk a virtual robot through a study; what was interrupted goes on with the same walks.

    Args:
      robot: the robot.
      policy: its bundle.
      bounds: what pre-sysID found; the eta of its fitted parameters is compared with the chosen.
      budget: how many walks.
      out: folder for `transfer.json`, `study.json`, `agent/recordings/`, stores and logs.
      told: hears how far it is.

    Returns:
      The document of `transfer.json`.

    Raises:
      InputError: the policy is not of this robot, or the robot gives no results.
      ChildProcessError: a process of the laboratory ends again and again.
    """
    bundle = NumpyPolicy.load(policy, robot)
    fitted = fitted_eta(bundle, read_bounds(bounds, robot))
    with Laboratory(out, robot, policy, CHARACTER) as laboratory:
        study = follow(laboratory, STUDY, budget, [fitted.tolist()], out, told)
    document = _document(study, fitted, budget, policy)
    write_json(out / "transfer.json", document)
    return document


def follow(
    laboratory: Laboratory,
    name: str,
    budget: Budget,
    compare: Sequence[Sequence[float]],
    out: Path,
    told: Callable[[str], None],
    simulated: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """A study in a laboratory to its end; both are looked after.

    Args:
      laboratory: where it is walked, by the policy that is there.
      name: of the study.
      budget: how many walks.
      compare: etas that are walked beside the chosen one.
      out: folder for `study.json`.
      told: hears how far it is.
      simulated: rollouts that it begins with.

    Returns:
      The document of `study.json`.

    Raises:
      InputError: as `try_out`.
      ChildProcessError: likewise.
    """
    settings = {
        "trials": budget.trials,
        "initial": min(StudySettings.initial, budget.trials),
        "least_gain": budget.least_gain,
        "repeats": budget.repeats,
        "compare": [list(eta) for eta in compare],
        "horizon": budget.horizon,
        "lease": LEASE,
        "failures": 1,  # each is looked at by `attend`
        "gate": "auto",
        "agent": AGENT,
        "seed": budget.seed,
    }

    progress = _Progress()

    def care() -> None:
        if progress.seconds_ago > laboratory.standstill:
            told(f"nothing has changed for {laboratory.standstill:g} s; all is started anew")
            progress.restart()
            laboratory.interrupt()
        laboratory.tend()

    def tell(line: str) -> None:
        care()  # also while the gateway does not answer
        told(line)

    def tend(gateway: Gateway, study: dict[str, Any]) -> None:
        progress.look(study)
        care()
        attend(gateway, study)

    place = laboratory.url, laboratory.token
    return transfer(Wanted(laboratory.policy, name, *place, settings, simulated), out, tell, tend)


class _Progress:
    """When a study changed last."""

    def __init__(self) -> None:
        self._study: dict[str, Any] = {}
        self.restart()

    @property
    def seconds_ago(self) -> float:
        return time.monotonic() - self._at

    def restart(self) -> None:
        self._at = time.monotonic()

    def look(self, study: dict[str, Any]) -> None:
        if study != self._study:
            self._study = study
            self.restart()


def recorded(folder: Path) -> list[Path]:
    """Recordings of a study's walks of the search that ended by themselves, in their order.

    Args:
      folder: with the study's `study.json`.
    """
    trials = read_json(folder / "study.json")["trials"]
    searched = [t for t in trials if t["purpose"] in ("initial", "search")]
    names = [t["recording"] for t in searched if t["state"] == "succeeded" and t["recording"]]
    return [folder / "agent" / "recordings" / f"{name}.parquet" for name in names]


def attend(gateway: Gateway, study: dict[str, Any]) -> None:
    """What an operator decides on a study that pauses: once more, or without that trial.

    A walk that the end of a process cut off is walked again under the same number, so that the
    study goes on as if nothing had happened.
    """
    if study["state"] != "paused":
        return
    place = f"/v1/studies/{study['name']}"
    trials = gateway.all(f"{place}/trials", "trials")
    failed = [t for t in trials if t["state"] in ("aborted", "lost")]
    if len(failed) > HOPELESS:
        raise InputError(
            f"the virtual robot gives no results: {failed[-1]['reason']}; try another --seed"
        )
    last = trials[-1]
    if last["attempt"] < ATTEMPTS:
        number, attempt = last["number"], last["attempt"] + 1
        gateway.post(f"{place}/trials/{number}:retry", {"attempt": attempt})
    else:
        gateway.post(f"{place}:resume", None)


def _document(
    study: dict[str, Any], fitted: NDArray[np.float64], budget: Budget, policy: Path
) -> dict[str, Any]:
    kept = ("number", "purpose", "eta", "state", "attempt", "distance", "time", "reason")
    walks = [{name: t[name] for name in (*kept, "recording", "digest")} for t in study["trials"]]
    return {
        "schema": SCHEMA,
        "robot": study["robot"],
        "policy_sha256": sha256(policy / CARD),
        "virtual_robot": CHARACTER,
        "horizon": study["settings"]["horizon"],
        "eta": study["eta"],
        "fitted_eta": fitted.tolist(),
        "chosen": _walked(walks, "repeat"),
        "fitted": _walked(walks, "compare"),
        "walks": walks,
    }


def _walked(walks: list[dict[str, Any]], purpose: str) -> dict[str, Any]:
    """Distances of the walks made for a purpose, m, with mean and sample standard deviation."""
    told = [w["distance"] for w in walks if (w["purpose"], w["state"]) == (purpose, "succeeded")]
    return {
        "distance": told,
        "mean": statistics.mean(told) if told else None,
        "std": statistics.stdev(told) if len(told) > 1 else None,
    }
