"""What a fit evaluates: recordings, a torque law, and the parameters that are free."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.metadata import version

import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.physics.mujoco_batch import MujocoSimulator
from pup.physics.parameters import ParameterSpace
from pup.physics.simulator import Trajectories
from pup.recording import Recording
from pup.robot import Actuator, RobotDescription
from pup.sysid.loss import ReplayLoss, Terms
from pup.sysid.memory import memory

Array = NDArray[np.float64]

MODEL = 13
"""Raised with every change of the physics or the loss, which makes old checkpoints another's."""
MEMORY = 256 * 2**20
"""Bytes that trajectories and what equation 1 makes of them may take at once, about."""
COPIES = 3.5
"""Arrays as large as the trajectories that equation 1 holds beside one another, with them."""
FEWEST = 5
"""Rows of a recording, after the first, in which its motion is read."""
SLOPES = 3
"""Arrays as large as the Jacobian that are needed beside one another to take it."""
_VERSIONS = (str(MODEL), *(version(p) for p in ("mujoco", "numpy", "numba", "nevergrad", "cma")))


@dataclass(frozen=True, eq=False)
class Problem:
    """Recordings and a model to be fitted to them.

    Candidates are given on the unit cube of the free parameters; the others keep the nominal
    values of the space.

    Attributes:
      robot: the robot.
      recordings: what is fitted.
      actuator: torque law.
      space: all parameters of the torque law.
      free: names of those to be fitted.
      threads: batches that run at once.
    """

    robot: RobotDescription
    recordings: tuple[Recording, ...]
    actuator: Actuator
    space: ParameterSpace
    free: tuple[str, ...]
    threads: int = 1

    def of(self, subset: Sequence[int]) -> "Problem":
        """The same model for some of the recordings."""
        return replace(self, recordings=tuple(self.recordings[i] for i in subset))

    @cached_property
    def digest(self) -> str:
        """Identifies what is evaluated, however many threads do it."""
        parts = [self.robot.digest, self.actuator, *self.free, *self.space.names, *_VERSIONS]
        parts += [
            repr(a.tolist()) for a in (self.space.nominal, self.space.lower, self.space.upper)
        ]
        parts += [recording.digest for recording in self.recordings]
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()

    @cached_property
    def free_space(self) -> ParameterSpace:
        """The free parameters."""
        return self.space.select(self.free)

    @cached_property
    def loss(self) -> ReplayLoss:
        """Equation 1 over the recordings."""
        return ReplayLoss(self.robot, self.recordings)

    @cached_property
    def _simulator(self) -> MujocoSimulator:
        return MujocoSimulator(self.robot, self.recordings, self.actuator, self.threads)

    def values(self, unit: Array) -> Array:
        """All parameters, physical (n, n_all), of candidates (n, n_free) on the unit cube."""
        values = np.tile(self.space.nominal, (len(unit), 1))
        values[:, [self.space.names.index(n) for n in self.free]] = self.free_space.denormalise(
            unit
        )
        return values

    def replay(self, unit: Array) -> Trajectories:
        """Replay candidates (n, n_free) on the unit cube."""
        return self._simulator.replay(self.space.candidates(self.values(unit)))

    def terms(self, unit: Array) -> Terms:
        """The sums of equation 1 of candidates (n, n_free), however many: some are in memory."""
        return Terms.joined([self.loss.terms(self.replay(piece)) for piece in self._pieces(unit)])

    def _pieces(self, unit: Array) -> list[Array]:
        """Candidates in parts whose trajectories fit in MEMORY."""
        return np.array_split(unit, -(-len(unit) // self.at_once))

    @cached_property
    def at_once(self) -> int:
        """Candidates whose trajectories fit in MEMORY."""
        numbers = len(self.robot.joints) + 2 + 3 * len(self.robot.feet)  # per tick
        candidate = COPIES * 8 * numbers * self.loss.ticks[-1].stop
        return max(1, int(MEMORY / candidate))

    def losses(self, unit: Array) -> Array:
        """Equation 1 of candidates (n, n_free), shape (n,)."""
        return self.loss.total(self.terms(unit))

    def errors(self, unit: Array) -> tuple[Array, NDArray[np.int64]]:
        """Weighted errors of candidates (n, n_free) and their blocks, see ReplayLoss.

        They are as long as the recordings, however few of them are replayed at once: see `check`.
        """
        parts = [self.loss.weighted_errors(self.replay(piece)) for piece in self._pieces(unit)]
        return np.concatenate([errors for errors, _ in parts]), parts[0][1]

    def check(self) -> None:
        """Refuse recordings that cannot be fitted.

        Raises:
          InputError: they are so short that they tell nothing, or so long that this computer could
            not hold their slopes by all free parameters.
        """
        self._check_readings()
        samples, free = self.loss.ticks[-1].stop, len(self.free)
        needed, there = SLOPES * 8 * self.loss.numbers * samples * free, memory()
        if needed > there:
            raise InputError(
                f"{samples} samples of {self.loss.numbers} errors, by {free} parameters, take "
                f"{needed / 2**30:.1f} GiB; this computer, or its container, has "
                f"{there / 2**30:.1f}: give fewer or shorter recordings"
            )

    def _check_readings(self) -> None:
        """Refuse recordings that all end where they begin, and fewer readings than parameters.

        A recording's first row tells where it starts, and nothing of what follows.
        """
        known = [~np.isnan(self.loss.position[part][1:]) for part in self.loss.ticks]
        if (rows := max(int(told.any(axis=1).sum()) for told in known)) < FEWEST:
            raise InputError(
                f"no recording has positions in more than {rows} rows after its first, and fewer "
                f"than {FEWEST} tell nothing of a motion; record longer"
            )
        if (readings := sum(int(told.sum()) for told in known)) < len(self.free):
            raise InputError(
                f"{readings} readings cannot tell {len(self.free)} parameters of the "
                f"{self.actuator} torque law; record longer, or give more recordings"
            )
