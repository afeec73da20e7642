"""The gait that a training from scratch begins with: searched, shown, and kept in its folder."""

import io
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pup.errors import InputError
from pup.files import read_json, write_atomic, write_json
from pup.locomotion.demonstration import HORIZON, PUPILS, ROUNDS, PatternSearch, imitate
from pup.locomotion.pattern import Patterns, PatternSpace
from pup.locomotion.settings import TaskSettings
from pup.locomotion.task import WalkingTask
from pup.physics.engine import Engine
from pup.policy.network import ProjectedPolicy
from pup.policy.shape import PolicyShape
from workers.walking import Walking

State = dict[str, NDArray[Any]]
LOSSES = "pattern.npz"
DOCUMENT = "pattern.json"
Said = Callable[[str, float], None]
"""Told what a training begins with, and the share of it that is done."""


@dataclass(frozen=True)
class FirstGait:
    """A search for a gait pattern and its imitation; see `pup.locomotion.demonstration`.

    A search that was interrupted goes on, and so does one that shall be longer, or that another
    training left in the folder which is like this one but for method and length; an imitation,
    which takes minutes, begins anew.

    Attributes:
      walking: makes the tasks; MuJoCo simulates them, whatever engine trains.
      shape: of the policy.
      generations: of the search.
      seed: of everything random.
      threads: of the simulations.
      out: the training's folder.
      digest: of what the search depends on but the number of its generations.
    """

    walking: Walking
    shape: PolicyShape
    generations: int
    seed: int
    threads: int
    out: Path
    digest: str

    def weights(self, said: Said) -> State:
        """Weights of a policy that walks as the best pattern does; see `read_gait` for the pattern.

        Raises:
          InputError: the folder holds the search of another robot, task or seed.
        """
        settings = self.walking.settings
        # Who strays goes on: a gait that does not yet go straight is worth more than none.
        walked = settings.evaluation()
        search = PatternSearch(
            PatternSpace(self.walking.robot, settings.direction),
            lambda n, seed, horizon: self._task(replace(walked, horizon=horizon), n, seed),
            self.seed,
        )
        identity = f"{self.digest} {search.identity}"
        losses, spent = self._kept(identity)
        begin = time.monotonic() - spent
        with threadpool_limits(limits=1):  # CMA-ES hangs on the order of BLAS' sums
            search.resume(losses[: self.generations])
            while len(search.losses) < self.generations:
                told = search.generation()
                self._keep(np.stack(search.losses), time.monotonic() - begin, identity)
                words = f"gait pattern, {told.distance:.2f} m in {told.time:.1f} s"
                said(words, told.index / self.generations)
            pattern, walks = search.chosen()
        weights = self._imitation(pattern, said)
        document = {
            "schema": 1,
            "generations": self.generations,
            "seconds": round(time.monotonic() - begin, 1),
            "horizon": HORIZON,
            **walks.summary(),
            "waves": pattern.waves[0].tolist(),
            "gains": pattern.gains[0].tolist(),
        }
        write_json(self.out / DOCUMENT, document)
        return weights

    def _imitation(self, pattern: Patterns, said: Said) -> State:
        task = self._task(self.walking.settings, PUPILS, self.seed)
        threads = torch.get_num_threads()
        torch.set_num_threads(1)  # as trainings have it: faster for networks of this size
        try:
            with torch.random.fork_rng():
                torch.manual_seed(self.seed)
                policy = ProjectedPolicy(self.shape)
            imitate(policy, pattern, task, self.seed, lambda turn: said("imitation", turn / ROUNDS))
        finally:
            torch.set_num_threads(threads)
        return {name: value.numpy() for name, value in policy.state_dict().items()}

    def _task(self, settings: TaskSettings, simulations: int, seed: int) -> WalkingTask:
        walking = replace(self.walking, settings=settings, engine=Engine.MUJOCO)
        return walking(simulations, seed, self.threads)

    def _kept(self, identity: str) -> tuple[NDArray[np.float64], float]:
        """Losses of a search that was interrupted, and the seconds that they took."""
        file = self.out / LOSSES
        if not file.exists():
            return np.empty((0, 0)), 0.0
        content = io.BytesIO(file.read_bytes())
        try:
            with np.load(content, allow_pickle=False) as packed:
                losses, told = np.array(packed["losses"]), str(packed["identity"])
                spent = float(packed["seconds"])
        except Exception as error:  # NumPy's reader raises what a torn file happens to hit
            raise InputError(f"{file}: not a search for a gait; use another --out") from error
        if told != identity:
            raise InputError(
                f"{file}: the search for another robot, task or seed; use another --out"
            )
        return losses, spent

    def _keep(self, losses: NDArray[np.float64], seconds: float, identity: str) -> None:
        packed = io.BytesIO()
        told = {"seconds": np.array(seconds), "identity": np.array(identity)}
        np.savez(packed, allow_pickle=False, losses=losses, **told)
        write_atomic(self.out / LOSSES, packed.getvalue())


def read_gait(out: Path) -> dict[str, Any]:
    """What a training in this folder began with: how far the pattern walks, and what it is.

    Raises:
      InputError: it is gone or cannot be read.
    """
    return dict(read_json(out / DOCUMENT))
